//! Samples to a peer: relay subscriptions and stand-ins in, data streams out.
//!
//! One task a peer moves samples from the rings into a queue per (route, publisher), or client where
//! it is of a service; one task a queue seals and writes them. A peer that is slow fills its own
//! queues and then leaves its samples in the ring, where they hold back a KEEP_ALL publisher and
//! nobody else.

mod acknowledged;
mod ending;
mod feed;
mod flight;
mod stalling;
mod stream;
#[cfg(test)]
mod tests;

use std::{
    collections::{BTreeSet, HashMap},
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use axon_envelope::Route;
use axon_shm::{
    ids::{DaemonId, Gid},
    qos::{Qos, Reliability},
};
use axon_transport::Subscription;
use quinn::Connection;
use tokio::sync::{Notify, mpsc, oneshot, watch};

pub(super) use self::acknowledged::Acknowledged;
use self::{acknowledged::Acknowledgement, ending::Endings, feed::Feed, stalling::Stalling};
use super::{
    counters::Counting,
    hub::Event,
    keyring::lock,
    protection::{Protection, sample},
    queue::Sample,
    queue_budget::QueueBudget,
    ring_wakeups::RingWakeups,
    routes::RelaySpec,
    stand_in::StandIn,
};

/// A route that the peer asked for.
pub(super) struct RouteOut {
    /// The topic's name.
    pub(super) topic: Arc<str>,
    /// Topic and kind, for the envelope.
    pub(super) route: Route,
    /// Whether the peer acknowledges what comes over it.
    pub(super) acknowledged: bool,
    /// Where its samples come from; relays in the order of [`super::routes::relays`].
    pub(super) sources: Vec<Source>,
    /// Samples that the peer has already: the newest sequence number by publisher.
    pub(super) seen: HashMap<Gid, u64>,
}

/// Where the samples of a route are taken.
#[derive(Clone)]
pub(super) enum Source {
    /// A topic's.
    Relay(RelaySpec, Arc<Subscription>),
    /// A service's: what stands in for the peer's server or client.
    StandIn(Arc<StandIn>),
}

impl Source {
    /// The publishers, or clients, of which there is something to be taken there.
    fn with_data(&self) -> Vec<Gid> {
        match self {
            Self::Relay(_, subscription) => subscription.with_data(),
            Self::StandIn(stand_in) => stand_in.with_calls(),
        }
    }

    /// Whether what is of this publisher or client is taken there.
    fn reads(&self, of: &Gid) -> bool {
        match self {
            Self::Relay(_, subscription) => subscription.reads(of),
            Self::StandIn(stand_in) => stand_in.reads(of),
        }
    }

    /// Who reads there.
    fn gid(&self) -> Gid {
        match self {
            Self::Relay(_, subscription) => subscription.gid(),
            Self::StandIn(stand_in) => stand_in.gid(),
        }
    }

    fn take_of(&self, of: &Gid) -> Option<Sample> {
        match self {
            Self::Relay(_, subscription) => {
                let (info, payload) = subscription.take_of(of)?;
                Some(sample(info, payload))
            }
            Self::StandIn(stand_in) => stand_in.take_of(of),
        }
    }

    /// How what is taken there is queued: of a service nothing is dropped.
    fn qos(&self) -> Qos {
        match self {
            Self::Relay(spec, _) => spec.queued(),
            Self::StandIn(_) => Qos::keep_all(),
        }
    }

    /// Samples of this publisher up to this number have come where they were to go, or need not.
    fn acknowledge_of(&self, of: &Gid, sequence: u64) {
        if let Self::Relay(_, subscription) = self {
            subscription.acknowledge_of(of, sequence);
        }
    }

    /// Samples that were to be delivered reliably and are not acknowledged, by publisher.
    fn unacknowledged(&self) -> HashMap<Gid, u64> {
        match self {
            Self::Relay(spec, subscription) if spec.qos.reliability == Reliability::Reliable => {
                subscription.unacknowledged()
            }
            _ => HashMap::new(),
        }
    }

    /// Whether there are such of this publisher.
    pub(super) fn has_unacknowledged(&self, of: &Gid) -> bool {
        self.reads(of) && self.unacknowledged().contains_key(of)
    }

    /// Tells a publisher that so many of its samples do not get there.
    fn give_up(&self, of: Gid, samples: u64) {
        if let Self::Relay(_, subscription) = self {
            subscription.give_up(of, samples);
        }
    }

    /// Those whose samples are taken there.
    pub(super) fn writers(&self) -> Vec<Gid> {
        match self {
            Self::Relay(_, subscription) => subscription.matched(),
            Self::StandIn(stand_in) => stand_in.partners(),
        }
    }

    /// Whether it is the same as `other`.
    pub(super) fn is(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Relay(_, one), Self::Relay(_, other)) => Arc::ptr_eq(one, other),
            (Self::StandIn(one), Self::StandIn(other)) => Arc::ptr_eq(one, other),
            _ => false,
        }
    }
}

/// What the hub tells a peer's outbound task.
pub(super) enum Order {
    /// Serve this route from now on, or change it.
    Route(u32, RouteOut),
    /// The peer no longer wants it.
    End(u32),
    /// The peer does not read it: as [`End`](Self::End), but what is not acknowledged is given up. How
    /// many samples that were is told.
    GiveUp(u32, oneshot::Sender<u64>),
    /// Send over this connection from now on.
    Connection(Carrier),
    /// This publisher has ended: what it left is carried, and then the hub is told.
    Ending(Gid),
}

/// What an outbound task hears.
pub(super) struct Inbox {
    /// What the hub tells it.
    pub(super) orders: mpsc::UnboundedReceiver<Order>,
    /// What the peer acknowledges.
    pub(super) acknowledged: Arc<Acknowledged>,
}

/// Whose outbound task it is, and who is told what came of it.
pub(super) struct Owner {
    /// The peer.
    pub(super) daemon: DaemonId,
    /// Who it proved to be.
    pub(super) identity: String,
    /// To the hub.
    pub(super) events: mpsc::Sender<Event>,
}

/// A route as its streams know it.
#[derive(Clone)]
struct Flow {
    number: u32,
    /// The topic's name.
    topic: Arc<str>,
    route: Route,
    /// Whether the peer acknowledges what comes over it.
    acknowledged: bool,
}

/// Up to which sample a publisher's are done with, and how many of them did not get there.
#[derive(Clone, Copy)]
struct Done {
    sequence: u64,
    given_up: u64,
}

/// A connection and how its messages are protected.
#[derive(Clone)]
pub(super) struct Carrier {
    /// The connection.
    pub(super) connection: Connection,
    /// How its messages are protected.
    pub(super) protection: Protection,
    /// Held for as long as something that it carried, or may carry still, is not acknowledged.
    #[expect(dead_code, reason = "what counts is that it is there")]
    pub(super) in_use: watch::Receiver<()>,
}

/// What the streams of a peer share.
struct Shared {
    carrier: watch::Receiver<Carrier>,
    counters: Counting,
    /// What may wait in the queues.
    queues: Arc<QueueBudget>,
    /// A queue has room again, or is over.
    popped: Notify,
    /// A queue is over.
    ended: AtomicBool,
    /// What the peer acknowledges.
    acknowledged: Arc<Acknowledged>,
    /// What was sent, or dropped, to a peer that acknowledges nothing, by route and publisher.
    done: Mutex<HashMap<(u32, Gid), Done>>,
}

impl Shared {
    fn done(&self, route: u32, of: Gid, done: Done) {
        lock(&self.done)
            .entry((route, of))
            .and_modify(|known| {
                known.sequence = known.sequence.max(done.sequence);
                known.given_up += done.given_up;
            })
            .or_insert(done);
        self.popped.notify_one();
    }
}

/// What came of looking for samples.
#[derive(Default)]
struct Moved {
    /// Some were taken: there may be more.
    any: bool,
    queued: u32,
    /// When a feed that rests is to be looked at again.
    again: Option<Instant>,
}

struct Active {
    flow: Flow,
    /// Its peer reads nothing, as the hub knows.
    stalled: bool,
    sources: Vec<Source>,
    /// The newest sequence number by publisher that the peer had when it asked.
    seen: HashMap<Gid, u64>,
    /// What goes out, by publisher or client.
    feeds: HashMap<Gid, Feed>,
}

/// Serves one peer until the order channel closes.
pub(super) async fn run(
    first: Carrier,
    inbox: Inbox,
    counters: Counting,
    queues: Arc<QueueBudget>,
    ring_wakeups: RingWakeups,
    owner: Owner,
    stalled_after: Duration,
) {
    let Inbox { mut orders, acknowledged } = inbox;
    let (carrier, current) = watch::channel(first);
    let (popped, ended) = (Notify::new(), AtomicBool::new(false));
    let shared = Arc::new(Shared {
        carrier: current,
        counters,
        queues,
        popped,
        ended,
        acknowledged,
        done: Mutex::default(),
    });
    let (mut endings, mut stalling) = (Endings::new(owner), Stalling::new(stalled_after));
    let mut routes: HashMap<u32, Active> = HashMap::new();
    let mut wakeups = ring_wakeups.subscribe();
    loop {
        wakeups.mark_unchanged();
        let (popped, freed) = (shared.popped.notified(), shared.queues.freed());
        tokio::pin!(popped, freed);
        // Registered before the queues are looked at, so that nothing in between is missed.
        popped.as_mut().enable();
        freed.as_mut().enable();
        // Relaxed: `popped`, which whoever stores it notifies afterwards, orders them.
        if shared.ended.swap(false, Ordering::Relaxed) {
            routes.values_mut().for_each(Active::prune);
        }
        take_up(&mut routes, &shared);
        let ending = endings.look(&mut routes, &shared);
        let stalling = stalling.look(&mut routes, &shared, endings.owner());
        let again = ending.into_iter().chain(stalling).min();
        let mut moved = Moved { again, ..Moved::default() };
        for active in routes.values_mut() {
            active.move_samples(&shared, &mut moved);
        }
        if moved.queued > 0 {
            shared.carrier.borrow().protection.demand(moved.queued);
        }
        if moved.any {
            // More may wait; let the streams and orders run in between.
            tokio::task::yield_now().await;
        } else {
            let over = tokio::select! {
                order = orders.recv() => match order {
                    Some(order) => {
                        take_up(&mut routes, &shared);
                        apply(order, &mut routes, &shared, &carrier, &mut endings);
                        false
                    }
                    None => true,
                },
                changed = wakeups.changed() => changed.is_err(),
                () = shared.acknowledged.noted() => false,
                () = popped => false,
                () = freed => false,
                () = rested(moved.again) => false,
            };
            if over {
                take_up(&mut routes, &shared);
                return endings.link_over(&mut routes, &shared).await;
            }
        }
        // All that there are: a peer that asks and takes back all the time has none wait.
        take_up(&mut routes, &shared);
        while let Ok(order) = orders.try_recv() {
            apply(order, &mut routes, &shared, &carrier, &mut endings);
        }
    }
}

/// Takes up what is done with and what the peer acknowledged, which was before any order that waits.
fn take_up(routes: &mut HashMap<u32, Active>, shared: &Shared) {
    for ((route, of), done) in std::mem::take(&mut *lock(&shared.done)) {
        if let Some(active) = routes.get(&route) {
            active.done(of, done);
        }
    }
    for ((route, of), acknowledged) in shared.acknowledged.take() {
        if let Some(active) = routes.get_mut(&route) {
            active.acknowledge(of, acknowledged);
        }
    }
}

/// Waits until then; without a time for ever.
async fn rested(again: Option<Instant>) {
    match again {
        Some(again) => tokio::time::sleep_until(again.into()).await,
        None => std::future::pending().await,
    }
}

fn apply(
    order: Order,
    routes: &mut HashMap<u32, Active>,
    shared: &Shared,
    carrier: &watch::Sender<Carrier>,
    endings: &mut Endings,
) {
    match order {
        Order::Connection(next) => {
            let _ = carrier.send(next);
        }
        Order::End(number) => {
            routes.remove(&number);
            shared.acknowledged.forget(number);
        }
        Order::GiveUp(number, told) => {
            let given_up = routes.remove(&number).map_or(0, |active| active.give_up());
            shared.acknowledged.forget(number);
            // An error: the hub is gone.
            let _ = told.send(given_up);
        }
        Order::Ending(of) => endings.add(of),
        Order::Route(number, RouteOut { topic, route, acknowledged, sources, seen }) => {
            let active = routes.entry(number).or_insert_with(|| Active {
                flow: Flow { number, topic, route, acknowledged },
                stalled: false,
                sources: Vec::new(),
                seen: HashMap::new(),
                feeds: HashMap::new(),
            });
            active.sources = sources;
            for (of, feed) in &mut active.feeds {
                feed.set(&active.sources, seen.get(of).copied());
            }
            active.seen = seen;
        }
    }
}

impl Active {
    /// Moves what the rings hold into the queues.
    fn move_samples(&mut self, shared: &Arc<Shared>, moved: &mut Moved) {
        let held = self.feeds.iter().filter(|(_, feed)| feed.holds()).map(|(of, _)| *of);
        let there = self.sources.iter().flat_map(Source::with_data);
        let waiting: BTreeSet<Gid> = held.chain(there).collect();
        for of in waiting {
            let feed = self.feeds.entry(of).or_insert_with(|| {
                let mut feed = Feed::new(of);
                feed.set(&self.sources, self.seen.get(&of).copied());
                feed
            });
            feed.turn(&self.flow, &self.sources, shared, moved);
        }
    }

    /// The peer acknowledged samples of a publisher that were sent to it, and dropped some of them.
    fn acknowledge(&mut self, of: Gid, acknowledged: Acknowledgement) {
        let Acknowledgement { sequence, samples, dropped } = acknowledged;
        if let Some(feed) = self.feeds.get_mut(&of) {
            feed.acknowledge(samples);
        }
        self.done(of, Done { sequence, given_up: dropped });
    }

    fn done(&self, of: Gid, Done { sequence, given_up }: Done) {
        let sources = self.sources.iter().filter(|source| source.reads(&of));
        for (number, source) in sources.enumerate() {
            if number == 0 && given_up > 0 {
                source.give_up(of, given_up);
            }
            source.acknowledge_of(&of, sequence);
        }
    }

    /// Samples that are not acknowledged, by publisher.
    fn unacknowledged(&self) -> HashMap<Gid, u64> {
        let mut most = HashMap::new();
        for (of, samples) in self.sources.iter().flat_map(Source::unacknowledged) {
            let known: &mut u64 = most.entry(of).or_default();
            *known = samples.max(*known);
        }
        most
    }

    /// Forgets those that nothing will come of.
    fn prune(&mut self) {
        let sources = &self.sources;
        let read = |of: &Gid| sources.iter().any(|source| source.reads(of));
        self.feeds.retain(|of, feed| feed.is_in_use() || read(of));
    }
}
