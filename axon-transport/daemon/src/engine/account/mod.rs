//! Limits the resources that one peer may make this daemon hold, over all of its daemon ids and links.
//!
//! A peer here is an identity: its proven SAE ID, pinned name or certificate host, or else its address. Addresses of
//! one IPv6 network share their limits, because a host may have any of them. A [`Charge`] holds an amount of a
//! [`Meter`], and gives it back when it is dropped.

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
use super::limits::IdentityLimits;
use crate::engine::route::RouteKey;
use crate::{
    keys::KeyMessage,
    link::{LinkMessage, MAX_INFLATED, is_known, unpacked_length},
    token_bucket::TokenBucket,
};

/// The most relays of one identity on this host: enough for 20,000 topics and more. Each takes some 4 KiB,
/// and a lane for each publisher here that it reads.
pub(crate) const MAX_RELAYS: usize = 1 << 15;
/// The most stand-ins of one identity. Each costs a ring, which takes some 6 KiB altogether.
pub(crate) const MAX_STAND_INS: usize = 1 << 15;
/// The most lanes of the relays and stand-ins of one identity.
const MAX_LANES: usize = 1 << 16;
/// The most relays of all identities together; the same number bounds the stand-ins, and the lanes. The
/// registry lets the engine's session have all three. One identity may take half of the rest, so that no
/// identity takes the last.
const OF_ALL: usize = 1 << 17;
/// Memory of an identity's routes as a multiple of its graph: three copies of names and subscribers are held,
/// and a route has more data than an endpoint.
const ROUTES_TO_GRAPH: usize = 4;
/// Unread stream data of one identity, in bytes. Each of its links has
/// [`LINK_WINDOW`](super::quic::transport::LINK_WINDOW) more.
const UNREAD: usize = 64 << 20;
/// Bytes of one identity's messages that are being read: long ones, of which one may always be read, and
/// short ones. The two are separate, so short messages never wait for long ones.
pub(crate) const MESSAGES: (usize, usize) = (64 << 20, 16 << 20);
/// Control messages for one identity that it has not read yet, in bytes.
const UNSENT: usize = 128 << 20;
/// Memory that all identities may hold together, as a multiple of the memory of one.
const HELD_BY_ALL: u64 = 2;
/// Names and reasons of one identity's refused routes that are kept for status, in bytes.
const REFUSALS: usize = 2 << 20;
/// The most sessions of one identity that count as proven.
pub(crate) const MAX_PROVEN: usize = 8192;
/// The most publishers, or clients, of one identity that one route shows here: a reader checks all of its
/// publishers.
const MAX_WRITERS_OF_ROUTE: usize = 1024;
/// The most identities whose recent traffic is remembered for the limits.
const LIMITED: usize = 128;
/// Control messages of one identity that are decompressed and not handled, in bytes: room for one of the
/// largest length.
pub(crate) const DECODED: usize = DECODED_TO_UNPACKED * MAX_INFLATED;
/// Memory of a control message while it is decoded, as a multiple of its decompressed length: that length,
/// and up to six times as much.
const DECODED_TO_UNPACKED: usize = 7;
/// The most denied uses of one identity that are remembered.
const DENIED: usize = 1024;
/// The control messages that one identity may send in a second, and in a burst, as measured by [`cost`] and
/// [`cost_of_frame`].
const SAID: (u32, u32) = (16_384, 65_536);
/// Bytes of a control message that cost as much to decompress and decode as one change.
const BYTES: usize = 4096;
/// GIDs that cost as much as one change if each is only looked up.
const LOOKED_UP: usize = 32;

/// A resource that may be held up to a bound.
#[derive(Debug)]
pub(crate) struct Meter {
    most: usize,
    /// The meter that all identities share.
    pool: Option<Rc<Meter>>,
    held: Cell<usize>,
    /// The amount that was released since the start.
    released: Cell<usize>,
    /// The most that was held.
    #[cfg(test)]
    peak: Cell<usize>,
}

/// A held part of a [`Meter`]'s bound. Dropping it releases the part.
#[derive(Debug)]
pub(crate) struct Charge {
    meter: Rc<Meter>,
    amount: usize,
}

impl Meter {
    /// Creates a meter that allows up to `most`.
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

    /// Returns the maximum amount that was held.
    #[cfg(test)]
    pub(crate) fn peak(&self) -> usize {
        self.peak.get()
    }

    /// Creates a meter that allows up to `most`, and at most half of the rest of a pool.
    pub(crate) fn within(pool: &Rc<Self>, most: usize) -> Rc<Self> {
        Rc::new(Self::with(most, Some(Rc::clone(pool))))
    }

    /// Returns the amount that may still be charged.
    pub(crate) fn left(&self) -> usize {
        let own = self.most.saturating_sub(self.held());
        let shared = self.pool.as_ref().map_or(usize::MAX, |pool| {
            let others = pool.held().saturating_sub(self.held());
            (pool.most.saturating_sub(others) / 2).saturating_sub(self.held())
        });
        own.min(shared)
    }

    /// Creates a charge of 0.
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

    /// Charges an amount again that was just released and that nothing else has taken meanwhile.
    fn take_again(&self, amount: usize) {
        for meter in iter::once(self).chain(self.pool.as_deref()) {
            meter.held.set(meter.held.get() + amount);
        }
    }

    /// Raises a charge to half of the amount that other charges leave. Returns whether it grew.
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

    /// Returns the amount that is held now.
    pub(crate) fn held(&self) -> usize {
        self.held.get()
    }

    /// Returns the amount that was released since the start. When it changes, a charge that did not fit may
    /// fit.
    pub(crate) fn released(&self) -> usize {
        self.released.get()
    }

    /// Returns the bound.
    pub(crate) fn most(&self) -> usize {
        self.most
    }
}

impl Charge {
    /// Splits off `amount`, or everything, as a charge of its own.
    pub(crate) fn split(&mut self, amount: usize) -> Self {
        let amount = amount.min(self.amount);
        self.amount -= amount;
        Self { meter: Rc::clone(&self.meter), amount }
    }

    /// Creates another charge of the same meter if it fits.
    pub(crate) fn more(&self, amount: usize) -> Option<Self> {
        self.meter.charge(amount)
    }

    /// Adds another charge of the same meter.
    pub(crate) fn add(&mut self, mut other: Self) {
        debug_assert!(Rc::ptr_eq(&self.meter, &other.meter), "charges of two meters");
        self.amount += std::mem::take(&mut other.amount);
    }

    /// Exchanges the charge for one of `amount` of a meter. The old charge is released first, to make room.
    ///
    /// # Errors
    /// The amount does not fit. Returns the old charge.
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

    /// Returns the charge's meter.
    pub(crate) fn meter(&self) -> &Rc<Meter> {
        &self.meter
    }

    /// Returns the charged amount.
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

/// Memory for messages that have not arrived completely or that wait for a reader, in bytes.
#[derive(Clone, Debug)]
pub(crate) struct MessageMemory {
    /// Memory for long messages.
    pub(crate) long: Rc<Meter>,
    /// Memory for short messages.
    pub(crate) short: Rc<Meter>,
}

impl MessageMemory {
    /// Creates memory of these sizes.
    pub(crate) fn new(long: usize, short: usize) -> Self {
        Self { long: Meter::new(long), short: Meter::new(short) }
    }

    /// Returns the amount that was released since the start. When it changes, a message that found no room
    /// may find some.
    pub(crate) fn released(&self) -> usize {
        self.long.released().wrapping_add(self.short.released())
    }
}

/// The account of one identity. Identities with the same budget share all fields but `limits`, because limit
/// rules distinguish them.
#[derive(Clone, Debug)]
pub(crate) struct Account {
    /// The name of the budget.
    pub(crate) budget: Rc<str>,
    /// Bytes of the identity's graph.
    pub(crate) graph: Rc<Meter>,
    /// Bytes of the routes that the identity asks for. They are separate from the graph, so an identity with
    /// a full graph is still served.
    pub(crate) routes: Rc<Meter>,
    /// Relays for the routes that the identity asks for.
    pub(crate) relays: Rc<Meter>,
    /// Lanes of these relays, and of stand-ins of services.
    pub(crate) lanes: Rc<Meter>,
    /// Control messages that the identity has not read.
    pub(crate) unsent: Rc<Meter>,
    /// Control messages of the identity that are decompressed and not handled.
    pub(crate) decoded: Rc<Meter>,
    /// Uses of the identity's endpoints that are denied here.
    pub(crate) denied: Rc<Meter>,
    /// The identity's publishers, servers and clients that are shown here.
    pub(crate) stand_ins: Rc<Meter>,
    /// Stream data that the identity may send and that this host has not read.
    pub(crate) unread: Rc<Meter>,
    /// Memory for the identity's messages that have not arrived completely, in bytes.
    pub(crate) messages: MessageMemory,
    /// Memory for the samples, requests and responses in the identity's stand-ins, in bytes.
    pub(crate) held: Arc<MemoryBudget>,
    /// Bytes of refused routes that are remembered.
    pub(crate) refusals: Rc<Meter>,
    /// Sessions that the identity proved to own.
    pub(crate) sessions: Rc<Meter>,
    /// The identity's publishers, or clients, that each route shows.
    writers: Rc<RefCell<HashMap<RouteKey, Weak<Meter>>>>,
    /// The limits on the traffic of each topic.
    pub(crate) limits: Rc<IdentityLimits>,
    /// The turns in which the identity's changes are processed.
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

    /// Returns the meter of the identity's publishers, or clients, that a route shows, over all of its daemon
    /// IDs.
    pub(crate) fn writers_of(&self, key: &RouteKey) -> Rc<Meter> {
        let mut writers = self.writers.borrow_mut();
        if let Some(meter) = writers.get(key).and_then(Weak::upgrade) {
            return meter;
        }
        // Cleaning only when the map is full keeps the cost per entry constant.
        if writers.len() == writers.capacity() {
            writers.retain(|_, meter| meter.strong_count() > 0);
        }
        let meter = Meter::new(MAX_WRITERS_OF_ROUTE);
        writers.insert(key.clone(), Rc::downgrade(&meter));
        meter
    }

    /// Charges a control message of this cost. Returns how long the identity must wait before its next
    /// message.
    pub(crate) fn owe(&self, cost: u32, now: Duration) -> Duration {
        self.said.borrow_mut().owe(cost, now)
    }
}

/// Returns the cost of a frame before it is decompressed, from its decompressed length. A frame of unknown
/// type is not decompressed, so its own length counts.
pub(crate) fn cost_of_frame(frame: &[u8]) -> u32 {
    let unpacked = if is_known(frame) { unpacked_length(frame).min(MAX_INFLATED) } else { 0 };
    costs(unpacked.max(frame.len()) / BYTES)
}

/// Returns the cost of a message: about the number of changes that it contains.
pub(crate) fn cost(message: &LinkMessage) -> u32 {
    costs(match message {
        LinkMessage::Graph(graph) => {
            let toward = [&graph.localhost, &graph.listing, &graph.denied].into_iter().flatten();
            let toward = toward.map(Vec::len).sum::<usize>() / LOOKED_UP;
            graph.added.len() + graph.removed.len() + toward
        }
        LinkMessage::Subscribe(subscribe) => 7 + subscribe.subscribers.len() + subscribe.last.len(),
        // Waiting flows are tried again.
        LinkMessage::ReceiveLimits(_) | LinkMessage::SwitchOver => 63,
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
        // The key store bounds the number of keys.
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

/// Returns the memory in bytes that a frame takes while it is decoded and handled.
pub(crate) fn decoded_length(frame: &[u8]) -> usize {
    if is_known(frame) {
        DECODED_TO_UNPACKED * unpacked_length(frame).max(frame.len()).min(MAX_INFLATED)
    } else {
        0
    }
}

/// Returns the cost of a message with so many elements: 1 for the message, and 1 for each.
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
    /// The memory of all stand-ins, and the bound for one identity's.
    held: (Arc<MemoryBudget>, u64),
    open: HashMap<String, Weak<Account>>,
    /// The recent traffic of identities, also of those without a link, so that a new link does not reset the
    /// limits.
    limits: HashMap<String, Rc<IdentityLimits>>,
    /// The memory of the stand-ins of each budget. Readers may still use it after the budget's last link has
    /// ended.
    held_by: HashMap<String, SharedWeak<MemoryBudget>>,
}

impl Accounts {
    /// Creates accounts. A graph may take `graph` bytes, and an identity's stand-ins may hold `held` bytes.
    pub(crate) fn new(graph: usize, held: u64) -> Self {
        let [relays, lanes, stand_ins] = [(); 3].map(|()| Meter::new(OF_ALL));
        let held = (MemoryBudget::new(held.saturating_mul(HELD_BY_ALL)), held);
        let (open, limits, held_by) = Default::default();
        Self { graph, relays, lanes, stand_ins, held, open, limits, held_by }
    }

    /// Returns the account of an identity with a budget of its own.
    #[cfg(test)]
    pub(crate) fn of_one(&mut self, identity: &str) -> Rc<Account> {
        self.of(identity, identity)
    }

    /// Returns the account of an identity that takes from `budget`.
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
