//! Limits what one peer may make this daemon hold, over all of its daemon ids and links.
//!
//! A peer here is an identity: its proven SAE ID, pinned name or certificate host, else its address. Addresses of one IPv6
//! network share what they may take, as a host may have any of them. A [`Charge`] holds what counts for a [`Meter`], and
//! gives it back when it is dropped.

pub(in crate::engine) mod change_turns;
#[cfg(test)]
mod tests;

use std::{
    cell::{Cell, RefCell},
    collections::HashMap,
    iter,
    rc::{Rc, Weak},
    sync::{Arc, Weak as SharedWeak},
    time::Duration,
};

use axon_shm::internal::MemoryBudget;

use self::change_turns::ChangeTurns;
use super::{limits::IdentityLimits, peer::routes::RouteKey};
use crate::{
    keys::KeyMessage,
    link::{LinkMessage, MAX_INFLATED, is_known, unpacked_length},
    token_bucket::TokenBucket,
};

/// Relays that one identity may have here: those of 20,000 topics, and more. Each takes some 4 KiB, and a lane for each
/// publisher here that it reads.
pub(crate) const MAX_RELAYS: usize = 1 << 15;
/// Stand-ins of one identity. Each costs a ring: with all that belongs to it some 6 KiB.
pub(crate) const MAX_STAND_INS: usize = 1 << 15;
/// Lanes of the relays and stand-ins of one identity.
const MAX_LANES: usize = 1 << 16;
/// Relays of all identities, and as many stand-ins, and lanes. The registry lets the engine's session have all three. An
/// identity may take half of what the others leave, so that none takes the last.
const OF_ALL: usize = 1 << 17;
/// How much more an identity's routes may take than its graph: three copies of names and subscribers are held, and a
/// route has more to it than an endpoint.
const ROUTES_TO_GRAPH: usize = 4;
/// Unread stream data of one identity, in bytes. Each of its links has
/// [`LINK_WINDOW`](super::quic::transport::LINK_WINDOW) more.
const UNREAD: usize = 64 << 20;
/// Messages of one identity that are being read, in bytes: long ones, of which one may always be read, and short ones,
/// which therefore never wait for those.
pub(crate) const MESSAGES: (usize, usize) = (64 << 20, 16 << 20);
/// Control messages that wait for one identity to read them, in bytes.
const UNSENT: usize = 128 << 20;
/// How many times what one identity may hold all may hold together.
const HELD_BY_ALL: u64 = 2;
/// Names and reasons of refused routes of one identity that are remembered for status, in bytes.
const REFUSALS: usize = 2 << 20;
/// Sessions of one identity that are taken for proven.
pub(crate) const MAX_PROVEN: usize = 8192;
/// Publishers, or clients, of one identity that one route shows here: a reader looks at all of its publishers.
const MAX_WRITERS_OF_ROUTE: usize = 1024;
/// Identities of which it is remembered how much passed.
const LIMITED: usize = 128;
/// Control messages of one identity that are decompressed and not handled, in bytes: one of the largest length.
pub(crate) const DECODED: usize = DECODED_TO_UNPACKED * MAX_INFLATED;
/// What a control message takes while it is decoded, to its length once it is decompressed: that length, and up to six
/// times as much.
const DECODED_TO_UNPACKED: usize = 7;
/// Uses of one identity that are denied here and remembered.
const DENIED: usize = 1024;
/// What one identity may say a second, and at once, by [`cost`] and [`cost_of_frame`].
const SAID: (u32, u32) = (16_384, 65_536);
/// Bytes of a control message that cost as much as one change: what it takes to decompress and decode
/// them.
const BYTES: usize = 4096;
/// GIDs that cost as much as one change, where each is looked up and nothing else.
const LOOKED_UP: usize = 32;

/// Something that may be held up to a bound.
#[derive(Debug)]
pub(crate) struct Meter {
    most: usize,
    /// What all identities share.
    pool: Option<Rc<Meter>>,
    held: Cell<usize>,
    /// What was given back since the start.
    released: Cell<usize>,
    /// The most that was held.
    #[cfg(test)]
    peak: Cell<usize>,
}

/// A part of what a [`Meter`] allows.
#[derive(Debug)]
pub(crate) struct Charge {
    meter: Rc<Meter>,
    amount: usize,
}

impl Meter {
    /// Allows up to `most`.
    pub(crate) fn new(most: usize) -> Rc<Self> {
        Rc::new(Self::with(most, None))
    }

    fn with(most: usize, pool: Option<Rc<Self>>) -> Self {
        Self {
            most,
            pool,
            held: Cell::new(0),
            released: Cell::new(0),
            #[cfg(test)]
            peak: Cell::new(0),
        }
    }

    /// The most that was held.
    #[cfg(test)]
    pub(crate) fn peak(&self) -> usize {
        self.peak.get()
    }

    /// Allows up to `most`, and half of what others leave in a pool.
    pub(crate) fn within(pool: &Rc<Self>, most: usize) -> Rc<Self> {
        Rc::new(Self::with(most, Some(Rc::clone(pool))))
    }

    /// What it allows besides what is held.
    pub(crate) fn left(&self) -> usize {
        let own = self.most.saturating_sub(self.held());
        let shared = self.pool.as_ref().map_or(usize::MAX, |pool| {
            let others = pool.held().saturating_sub(self.held());
            (pool.most.saturating_sub(others) / 2).saturating_sub(self.held())
        });
        own.min(shared)
    }

    /// A charge of nothing.
    pub(crate) fn nothing(self: &Rc<Self>) -> Charge {
        Charge { meter: Rc::clone(self), amount: 0 }
    }

    /// Charges `amount`, if it fits.
    pub(crate) fn charge(self: &Rc<Self>, amount: usize) -> Option<Charge> {
        if amount > self.left() {
            return None;
        }
        self.held.set(self.held.get() + amount);
        #[cfg(test)]
        self.peak.set(self.peak.get().max(self.held.get()));
        if let Some(pool) = &self.pool {
            pool.held.set(pool.held.get() + amount);
        }
        Some(Charge { meter: Rc::clone(self), amount })
    }

    fn give_back(&self, amount: usize) {
        for meter in iter::once(self).chain(self.pool.as_deref()) {
            meter.held.set(meter.held.get() - amount);
        }
    }

    /// Takes what was given back a moment ago, and what nobody took meanwhile.
    fn take_again(&self, amount: usize) {
        for meter in iter::once(self).chain(self.pool.as_deref()) {
            meter.held.set(meter.held.get() + amount);
        }
    }

    /// Raises a charge to half of what the others leave. Returns whether it grew.
    pub(crate) fn share(self: &Rc<Self>, charge: &mut Charge) -> bool {
        let others = self.held().saturating_sub(charge.amount);
        let share = self.most.saturating_sub(others) / 2;
        let more = share.checked_sub(charge.amount).filter(|more| *more > 0);
        match more.and_then(|more| self.charge(more)) {
            Some(mut more) => {
                charge.amount += std::mem::take(&mut more.amount);
                true
            }
            None => false,
        }
    }

    /// What is held now.
    pub(crate) fn held(&self) -> usize {
        self.held.get()
    }

    /// What was given back since the start. It changes when a charge that did not fit may fit now.
    pub(crate) fn released(&self) -> usize {
        self.released.get()
    }

    /// What may be held.
    pub(crate) fn most(&self) -> usize {
        self.most
    }
}

impl Charge {
    /// Takes `amount` of it, or all, as a charge of its own.
    pub(crate) fn split(&mut self, amount: usize) -> Self {
        let amount = amount.min(self.amount);
        self.amount -= amount;
        Self { meter: Rc::clone(&self.meter), amount }
    }

    /// Another one of the same meter, if it fits.
    pub(crate) fn more(&self, amount: usize) -> Option<Self> {
        self.meter.charge(amount)
    }

    /// Adds another one of the same meter.
    pub(crate) fn add(&mut self, mut other: Self) {
        debug_assert!(Rc::ptr_eq(&self.meter, &other.meter), "charges of two meters");
        self.amount += std::mem::take(&mut other.amount);
    }

    /// Exchanges it for one of `amount` of a meter. What it holds makes room for that.
    ///
    /// # Errors
    /// There is not so much. Returns it as it was.
    pub(crate) fn exchange(mut self, meter: &Rc<Meter>, amount: usize) -> Result<Self, Self> {
        self.meter.give_back(self.amount);
        let Some(other) = meter.charge(amount) else {
            self.meter.take_again(self.amount);
            return Err(self);
        };
        let before = std::mem::take(&mut self.amount);
        self.meter.released.set(self.meter.released.get().wrapping_add(before));
        Ok(other)
    }

    /// What it is of.
    pub(crate) fn meter(&self) -> &Rc<Meter> {
        &self.meter
    }

    /// What it holds.
    pub(crate) fn amount(&self) -> usize {
        self.amount
    }
}

impl Drop for Charge {
    fn drop(&mut self) {
        self.meter.give_back(self.amount);
        self.meter.released.set(self.meter.released.get().wrapping_add(self.amount));
    }
}

/// Memory for messages that have not come whole, or wait for a reader, in bytes.
#[derive(Clone, Debug)]
pub(crate) struct MessageMemory {
    /// For long messages.
    pub(crate) long: Rc<Meter>,
    /// For short ones.
    pub(crate) short: Rc<Meter>,
}

impl MessageMemory {
    /// Memory of these lengths.
    pub(crate) fn new(long: usize, short: usize) -> Self {
        Self { long: Meter::new(long), short: Meter::new(short) }
    }

    /// What was given back since the start. It changes when a message that found no room may find some.
    pub(crate) fn released(&self) -> usize {
        self.long.released().wrapping_add(self.short.released())
    }
}

/// The account of one identity. Those that share a budget have all but their `limits` in common: rules tell them apart.
#[derive(Clone, Debug)]
pub(crate) struct Account {
    /// Whose budget it is.
    pub(crate) budget: Rc<str>,
    /// Bytes of its graph.
    pub(crate) graph: Rc<Meter>,
    /// Bytes of the routes that it asks for: on their own, so that one whose graph is full is served.
    pub(crate) routes: Rc<Meter>,
    /// Relays for the routes that it asks for.
    pub(crate) relays: Rc<Meter>,
    /// Lanes that these, and stand-ins of services, take.
    pub(crate) lanes: Rc<Meter>,
    /// Control messages that it has not read.
    pub(crate) unsent: Rc<Meter>,
    /// Control messages of it that are decompressed and not handled.
    pub(crate) decoded: Rc<Meter>,
    /// Uses of its endpoints that are denied here.
    pub(crate) denied: Rc<Meter>,
    /// Its publishers, servers and clients that are shown here.
    pub(crate) stand_ins: Rc<Meter>,
    /// Stream data that it may send and that was not read.
    pub(crate) unread: Rc<Meter>,
    /// Memory for its messages that have not come whole, in bytes.
    pub(crate) messages: MessageMemory,
    /// Memory for the samples, requests and responses that its stand-ins hold, in bytes.
    pub(crate) held: Arc<MemoryBudget>,
    /// Bytes of refused routes that are remembered.
    pub(crate) refusals: Rc<Meter>,
    /// Sessions that it proved to be its own.
    pub(crate) sessions: Rc<Meter>,
    /// Its publishers, or clients, that each route shows.
    writers: Rc<RefCell<HashMap<RouteKey, Weak<Meter>>>>,
    /// How much of which topic may pass.
    pub(crate) limits: Rc<IdentityLimits>,
    /// When its changes are followed up.
    pub(crate) turns: Rc<RefCell<ChangeTurns>>,
    said: Rc<RefCell<TokenBucket>>,
}

impl Account {
    fn new(
        budget: &str,
        graph: usize,
        [relays, lanes, stand_ins]: [&Rc<Meter>; 3],
        held: Arc<MemoryBudget>,
        limits: Rc<IdentityLimits>,
    ) -> Self {
        Self {
            budget: budget.into(),
            graph: Meter::new(graph),
            routes: Meter::new(ROUTES_TO_GRAPH.saturating_mul(graph)),
            relays: Meter::within(relays, MAX_RELAYS),
            lanes: Meter::within(lanes, MAX_LANES),
            unsent: Meter::new(UNSENT),
            decoded: Meter::new(DECODED),
            denied: Meter::new(DENIED),
            stand_ins: Meter::within(stand_ins, MAX_STAND_INS),
            unread: Meter::new(UNREAD),
            messages: MessageMemory::new(MESSAGES.0, MESSAGES.1),
            held,
            refusals: Meter::new(REFUSALS),
            sessions: Meter::new(MAX_PROVEN),
            writers: Rc::default(),
            limits,
            turns: Rc::default(),
            said: Rc::new(RefCell::new(TokenBucket::new(SAID.1, SAID.0))),
        }
    }

    /// Its publishers, or clients, that a route shows, over all of its daemon ids.
    pub(crate) fn writers_of(&self, key: &RouteKey) -> Rc<Meter> {
        let mut writers = self.writers.borrow_mut();
        if let Some(meter) = writers.get(key).and_then(Weak::upgrade) {
            return meter;
        }
        // Once for as many as there are.
        if writers.len() == writers.capacity() {
            writers.retain(|_, meter| meter.strong_count() > 0);
        }
        let meter = Meter::new(MAX_WRITERS_OF_ROUTE);
        writers.insert(key.clone(), Rc::downgrade(&meter));
        meter
    }

    /// Counts a control message of this cost. Returns how long the identity has to wait before its next one.
    pub(crate) fn owe(&self, cost: u32, now: Duration) -> Duration {
        self.said.borrow_mut().owe(cost, now)
    }
}

/// What a frame costs before it is decompressed, by the length that its map will have; one of unknown
/// type, which is not decompressed, by its own.
pub(crate) fn cost_of_frame(frame: &[u8]) -> u32 {
    let unpacked = if is_known(frame) { unpacked_length(frame).min(MAX_INFLATED) } else { 0 };
    costs(unpacked.max(frame.len()) / BYTES)
}

/// What a message costs: about as many changes as it says.
pub(crate) fn cost(message: &LinkMessage) -> u32 {
    costs(match message {
        LinkMessage::Graph(graph) => {
            let toward = [&graph.localhost, &graph.listing, &graph.denied].into_iter().flatten();
            let toward = toward.map(Vec::len).sum::<usize>() / LOOKED_UP;
            graph.added.len() + graph.removed.len() + toward
        }
        LinkMessage::Subscribe(subscribe) => 7 + subscribe.subscribers.len() + subscribe.last.len(),
        // Flows that wait are tried again.
        LinkMessage::Intake(_) => 63,
        LinkMessage::Unsubscribe(_)
        | LinkMessage::RouteRefused(_)
        | LinkMessage::RouteUnasked(_) => 7,
        LinkMessage::Denied(uses) => 7 * (uses.denied.len() + uses.lifted.len()),
        LinkMessage::AccessCheck(check) => 7 + 7 * check.uses.len(),
        LinkMessage::AccessDecisions(decisions) => decisions.decisions.len(),
        LinkMessage::Asserted(asserted) => asserted.publishers.len() / 8,
        LinkMessage::Owners(owners) => 7 * owners.proofs.len(),
        LinkMessage::Received(received) => received.flows.len() / LOOKED_UP,
        LinkMessage::RouteReady(ready) => ready.publishers.len() / LOOKED_UP,
        // Keys are bounded where they are kept.
        LinkMessage::Keys(KeyMessage::Announce(key_ids)) => key_ids.len() / 8,
        LinkMessage::Keys(
            KeyMessage::Ready { .. } | KeyMessage::Failed { .. } | KeyMessage::Retire { .. },
        ) => 0,
        LinkMessage::Hello(_)
        | LinkMessage::Elected(_)
        | LinkMessage::GraphResync(_)
        | LinkMessage::Keepalive
        | LinkMessage::LinkClosed(_) => 0,
    })
}

/// What a frame takes while it is decoded and handled, in bytes.
pub(crate) fn decoded_length(frame: &[u8]) -> usize {
    if is_known(frame) {
        DECODED_TO_UNPACKED * unpacked_length(frame).max(frame.len()).min(MAX_INFLATED)
    } else {
        0
    }
}

/// That of a message with so many elements: it costs something itself.
fn costs(elements: usize) -> u32 {
    u32::try_from(1 + elements).unwrap_or(u32::MAX)
}

/// The accounts of all identities that have a link.
#[derive(Debug)]
pub(crate) struct Accounts {
    /// Bytes of a graph.
    graph: usize,
    relays: Rc<Meter>,
    lanes: Rc<Meter>,
    stand_ins: Rc<Meter>,
    /// What all stand-ins hold, and what one identity's may.
    held: (Arc<MemoryBudget>, u64),
    open: HashMap<String, Weak<Account>>,
    /// What passed of late, also of identities without a link: a new link gives them no more.
    limits: HashMap<String, Rc<IdentityLimits>>,
    /// What the stand-ins of a budget hold. Readers may be at it when its last link is over.
    held_by: HashMap<String, SharedWeak<MemoryBudget>>,
}

impl Accounts {
    /// Accounts whose graphs may take so many bytes, and whose stand-ins may hold so many.
    pub(crate) fn new(graph: usize, held: u64) -> Self {
        let [relays, lanes, stand_ins] = [(); 3].map(|()| Meter::new(OF_ALL));
        let held = (MemoryBudget::new(held.saturating_mul(HELD_BY_ALL)), held);
        let (open, limits, held_by) = Default::default();
        Self { graph, relays, lanes, stand_ins, held, open, limits, held_by }
    }

    /// The account of an identity that has a budget of its own.
    #[cfg(test)]
    pub(crate) fn of_one(&mut self, identity: &str) -> Rc<Account> {
        self.of(identity, identity)
    }

    /// The account of an identity, which takes from this `budget`.
    pub(crate) fn of(&mut self, identity: &str, budget: &str) -> Rc<Account> {
        if let Some(account) = self.open.get(identity).and_then(Weak::upgrade) {
            return account;
        }
        self.open.retain(|_, account| account.strong_count() > 0);
        if self.limits.len() >= LIMITED && !self.limits.contains_key(identity) {
            self.limits.retain(|_, limits| Rc::strong_count(limits) > 1);
        }
        let limits = Rc::clone(self.limits.entry(identity.to_owned()).or_default());
        let mut open = self.open.values().filter_map(Weak::upgrade);
        let account = match open.find(|account| *account.budget == *budget) {
            Some(account) => Account { limits, ..(*account).clone() },
            None => {
                let held = self.held_by(budget);
                let pools = [&self.relays, &self.lanes, &self.stand_ins];
                Account::new(budget, self.graph, pools, held, limits)
            }
        };
        let account = Rc::new(account);
        self.open.insert(identity.to_owned(), Rc::downgrade(&account));
        account
    }

    fn held_by(&mut self, budget: &str) -> Arc<MemoryBudget> {
        if let Some(held) = self.held_by.get(budget).and_then(SharedWeak::upgrade) {
            return held;
        }
        self.held_by.retain(|_, held| held.strong_count() > 0);
        let held = MemoryBudget::within(&self.held.0, self.held.1);
        self.held_by.insert(budget.to_owned(), Arc::downgrade(&held));
        held
    }
}
