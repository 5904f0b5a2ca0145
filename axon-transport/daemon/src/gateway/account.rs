//! Limits what one peer may make this daemon hold, over all of its daemon ids and links.
//!
//! A peer here is an identity: its proven SAE ID, pinned name or certificate host, else its address. A
//! [`Charge`] holds what counts for a [`Meter`], and gives it back when it is dropped.

use std::{
    collections::HashMap,
    sync::{
        Arc, Mutex, Weak,
        atomic::{AtomicUsize, Ordering},
    },
    time::Instant,
};

use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use super::{
    intake::Intake,
    keyring::lock,
    pace::{Bucket, Turns},
    routes::MAX_RELAYS,
};
use crate::{
    keys::KeyMessage,
    link::{MAX_FRAME, MAX_INFLATED, Message, is_known, unpacked_length},
};

/// Stand-ins of one identity. Each costs a ring.
pub(crate) const MAX_STAND_INS: usize = 1024;
/// Stream data of one identity that was not read, in bytes: beside it each of its links has
/// [`LINK_WINDOW`](super::endpoint::LINK_WINDOW).
const UNREAD: usize = 64 << 20;
/// Messages of one identity that are on their way in, in bytes; of one that is longer it is that one.
const INTAKE: usize = 64 << 20;
/// Control messages that wait for one identity to read them, in bytes.
const UNSENT: usize = 128 << 20;
/// Bytes that a unit of a semaphore stands for.
const UNIT: usize = 1024;
/// Control frames of one identity that are being read, in bytes.
const READING: usize = 2 * MAX_FRAME;
/// Control messages of one identity between decompression and the end of their handling, in bytes
/// before they are decoded.
const UNPACKED: usize = MAX_INFLATED;
/// What each of them counts for at least: so many may wait before another peer's.
const MESSAGE: usize = 64 << 10;
/// What one identity may say a second, and at once, by [`cost`] and [`cost_of_frame`].
const SAID: (u32, u32) = (4096, 16_384);
/// Bytes of a control message that cost as much as one change: what it takes to decompress and decode
/// them.
const BYTES: usize = 4096;
/// GIDs that cost as much as one change, where each is looked up and nothing else.
const LOOKED_UP: usize = 32;

/// Something that may be held up to a bound.
#[derive(Debug)]
pub(crate) struct Meter {
    most: usize,
    held: AtomicUsize,
}

/// A part of what a meter allows, until it is dropped.
#[derive(Debug)]
pub(crate) struct Charge {
    meter: Arc<Meter>,
    amount: usize,
}

impl Meter {
    pub(crate) fn new(most: usize) -> Arc<Self> {
        Arc::new(Self { most, held: AtomicUsize::new(0) })
    }

    /// Holds nothing yet.
    pub(crate) fn nothing(self: &Arc<Self>) -> Charge {
        Charge { meter: Arc::clone(self), amount: 0 }
    }

    /// Holds `amount` more, if that is within the bound.
    pub(crate) fn charge(self: &Arc<Self>, amount: usize) -> Option<Charge> {
        let more = |held: usize| held.checked_add(amount).filter(|sum| *sum <= self.most);
        // Relaxed: a bound, not a hand-over.
        self.held.fetch_update(Ordering::Relaxed, Ordering::Relaxed, more).ok()?;
        Some(Charge { meter: Arc::clone(self), amount })
    }

    /// Has `charge` hold half of what it holds and nobody else does, if that is more than it holds: so
    /// something is left for those that come later. Whether it is more.
    pub(crate) fn share(self: &Arc<Self>, charge: &mut Charge) -> bool {
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

    /// How much is held.
    pub(crate) fn held(&self) -> usize {
        self.held.load(Ordering::Relaxed)
    }

    /// The bound.
    pub(crate) fn most(&self) -> usize {
        self.most
    }
}

impl Charge {
    /// How much it holds.
    pub(crate) fn amount(&self) -> usize {
        self.amount
    }
}

impl Drop for Charge {
    fn drop(&mut self) {
        self.meter.held.fetch_sub(self.amount, Ordering::Relaxed);
    }
}

/// The account of one identity.
#[derive(Debug)]
pub(crate) struct Account {
    /// Bytes of its graph.
    pub(crate) graph: Arc<Meter>,
    /// Bytes of the routes that it asks for: as many again, so that one whose graph is full is served.
    pub(crate) routes: Arc<Meter>,
    /// Relays for the routes that it asks for.
    pub(crate) relays: Arc<Meter>,
    /// Control messages that it has not read.
    pub(crate) unsent: Arc<Meter>,
    /// Its publishers, servers and clients that are shown here.
    pub(crate) stand_ins: Arc<Meter>,
    /// Stream data that it may send and that was not read.
    pub(crate) unread: Arc<Meter>,
    /// Memory for its messages.
    pub(crate) intake: Arc<Intake>,
    /// Memory for its long messages, in bytes.
    pub(crate) messages: Arc<Meter>,
    /// When its changes are followed up.
    pub(crate) turns: Mutex<Turns>,
    reading: Arc<Semaphore>,
    unpacked: Arc<Semaphore>,
    said: Mutex<Bucket>,
}

/// Room for a control message, until it is dropped.
#[derive(Debug)]
pub(crate) struct Unpacked {
    _room: Option<OwnedSemaphorePermit>,
}

impl Account {
    fn new(graph: usize) -> Self {
        Self {
            graph: Meter::new(graph),
            routes: Meter::new(graph),
            relays: Meter::new(MAX_RELAYS),
            unsent: Meter::new(UNSENT),
            stand_ins: Meter::new(MAX_STAND_INS),
            unread: Meter::new(UNREAD),
            intake: Arc::new(Intake::new(INTAKE)),
            messages: Meter::new(INTAKE),
            reading: Arc::new(Semaphore::new(READING / UNIT)),
            unpacked: Arc::new(Semaphore::new(UNPACKED / UNIT)),
            turns: Mutex::default(),
            said: Mutex::new(Bucket::new(SAID.0, SAID.1)),
        }
    }

    /// Room to read a frame of `length` bytes.
    pub(crate) async fn reading(&self, length: usize) -> Unpacked {
        room(&self.reading, length, READING).await
    }

    /// Room for a message of `length` bytes once it is decompressed.
    pub(crate) async fn unpacked(&self, length: usize) -> Unpacked {
        room(&self.unpacked, length.max(MESSAGE), UNPACKED).await
    }

    /// Counts a control message of this cost. Returns how long the identity has to wait before its next one.
    pub(crate) fn owe(&self, cost: u32, now: Instant) -> std::time::Duration {
        lock(&self.said).owe(cost, now)
    }

    /// Takes this much of what the identity may say, and waits for as long as that is more than it may.
    pub(crate) async fn pace(&self, cost: u32) {
        let wait = lock(&self.said).owe(cost, Instant::now());
        if !wait.is_zero() {
            tokio::time::sleep(wait).await;
        }
    }
}

/// What a frame costs before it is decompressed, by the length that its map will have; one of unknown
/// type, which is not decompressed, by its own.
pub(crate) fn cost_of_frame(frame: &[u8]) -> u32 {
    let unpacked = if is_known(frame) { unpacked_length(frame).min(MAX_INFLATED) } else { 0 };
    costs(unpacked.max(frame.len()) / BYTES)
}

/// What a message costs: about as many changes as it says.
pub(crate) fn cost(message: &Message) -> u32 {
    costs(match message {
        Message::Graph(graph) => {
            let toward = [&graph.localhost, &graph.listing].into_iter().flatten();
            let toward = toward.map(Vec::len).sum::<usize>() / LOOKED_UP;
            graph.added.len() + graph.removed.len() + toward
        }
        Message::Subscribe(subscribe) => 7 + subscribe.subscribers.len() + subscribe.last.len(),
        Message::Unsubscribe(_) | Message::RouteRefused(_) => 7,
        Message::Asserted(asserted) => asserted.publishers.len() / 8,
        Message::Owners(owners) => 7 * owners.proofs.len(),
        Message::Received(received) => received.flows.len() / LOOKED_UP,
        Message::RouteReady(ready) => ready.publishers.len() / LOOKED_UP,
        // Keys are bounded where they are kept.
        Message::Keys(KeyMessage::Announce(key_ids)) => key_ids.len() / 8,
        Message::Keys(
            KeyMessage::Ready { .. } | KeyMessage::Failed { .. } | KeyMessage::Retire { .. },
        ) => 0,
        Message::Hello(_)
        | Message::Elected(_)
        | Message::GraphResync(_)
        | Message::Keepalive
        | Message::LinkClosed(_) => 0,
    })
}

/// That of a message with so many elements: it costs something itself.
fn costs(elements: usize) -> u32 {
    u32::try_from(1 + elements).unwrap_or(u32::MAX)
}

/// Waits for its turn and for room. What is longer than all the room takes all of it.
async fn room(semaphore: &Arc<Semaphore>, length: usize, all: usize) -> Unpacked {
    let units = u32::try_from(length.clamp(1, all).div_ceil(UNIT)).unwrap_or(u32::MAX);
    // It is never closed.
    Unpacked { _room: Arc::clone(semaphore).acquire_many_owned(units).await.ok() }
}

/// The accounts of all peers, each for as long as it is used.
#[derive(Debug)]
pub(crate) struct Accounts {
    graph: usize,
    open: Mutex<HashMap<String, Weak<Account>>>,
}

impl Accounts {
    /// `graph` bytes are what the graph of one identity may take.
    pub(crate) fn new(graph: usize) -> Self {
        Self { graph, open: Mutex::default() }
    }

    /// The account of an identity.
    pub(crate) fn of(&self, identity: &str) -> Arc<Account> {
        let mut open = lock(&self.open);
        if let Some(account) = open.get(identity).and_then(Weak::upgrade) {
            return account;
        }
        open.retain(|_, account| account.strong_count() > 0);
        let account = Arc::new(Account::new(self.graph));
        open.insert(identity.to_owned(), Arc::downgrade(&account));
        account
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        gateway::played::block_on,
        link::{Received, ReceivedOf, RouteReady},
    };
    use axon_shm::ids::Gid;

    #[test]
    fn an_identity_has_one_account_and_what_is_dropped_is_given_back() {
        let accounts = Accounts::new(100);
        let (one, again, other) = (accounts.of("a"), accounts.of("a"), accounts.of("b"));
        let charge = one.graph.charge(60).unwrap();
        assert!(again.graph.charge(41).is_none(), "of the same identity");
        assert!(other.graph.charge(100).is_some());
        assert!(again.graph.charge(usize::MAX).is_none());
        assert_eq!(again.graph.held(), 60);
        drop(charge);
        assert!(again.graph.charge(100).is_some());
        drop((one, again));
        assert_eq!(accounts.of("a").graph.held(), 0);
        assert_eq!(lock(&accounts.open).len(), 2);
    }

    #[test]
    fn each_that_shares_leaves_as_much_and_takes_up_what_others_leave() {
        let meter = Meter::new(64);
        let [mut one, mut two, mut three] = [0; 3].map(|_| meter.nothing());
        assert!(meter.share(&mut one) && meter.share(&mut two) && meter.share(&mut three));
        assert_eq!([one.amount(), two.amount(), three.amount()], [32, 16, 8]);
        assert!(!meter.share(&mut one) && !meter.share(&mut three), "it has its share");
        drop(one);
        assert!(meter.share(&mut two));
        assert_eq!((two.amount(), meter.held()), (28, 36));
        drop((two, three));
        assert_eq!(meter.held(), 0);
    }

    #[test]
    fn a_message_costs_what_it_says_and_a_frame_what_it_is_unpacked() {
        let flow = ReceivedOf { route: 1, publisher: Gid::default(), sequence: 1, dropped: 0 };
        let received = |count| Message::Received(Received { flows: vec![flow; count] });
        let publishers = vec![Gid::default(); 65_536];
        let ready = Message::RouteReady(RouteReady { route: 1, publishers });
        assert_eq!((cost(&received(65_536)), cost(&ready)), (2049, 2049));
        // An honest peer sends one after each few samples, and one of a thousand topics at once.
        assert_eq!((cost(&received(1)), cost(&received(1024))), (1, 33));

        let frame = |kind: u8, unpacked: u32| [&[kind][..], &unpacked.to_be_bytes()].concat();
        assert_eq!(cost_of_frame(&frame(0x83, 4 << 20)), 1025);
        // Nobody unpacks more than that, and nobody what is of unknown type.
        assert_eq!(cost_of_frame(&frame(0x83, u32::MAX)), 1025);
        assert_eq!(cost_of_frame(&frame(0xff, 4 << 20)), 1);
        assert_eq!(cost_of_frame(&vec![0x7f; 1 << 20]), 257);
        assert_eq!(cost_of_frame(&[8, 0xa0]), 1);
    }

    #[test]
    fn a_message_waits_until_those_before_it_are_handled() {
        block_on(async {
            let account = Accounts::new(0).of("a");
            let first = account.unpacked(MAX_INFLATED).await;
            let mut second = std::pin::pin!(account.unpacked(1));
            let waits = std::future::poll_fn(|context| {
                std::task::Poll::Ready(second.as_mut().poll(context).is_pending())
            });
            assert!(waits.await);
            drop(first);
            second.await;
            account.unpacked(10 * MAX_INFLATED).await;
        });
    }
}
