//! Samples to a peer: relay subscriptions and stand-ins in, data streams out.
//!
//! One task a peer moves samples from the rings into a queue per (route, publisher), or client where
//! it is of a service; one task a queue seals and writes them. A peer that is slow fills its own
//! queues and then leaves its samples in the ring, where they hold back a KEEP_ALL publisher and
//! nobody else.

mod feed;
mod stream;
#[cfg(test)]
mod tests;

use std::{
    collections::{BTreeSet, HashMap},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::Instant,
};

use axon_envelope::Route;
use quinn::Connection;
use tokio::sync::{Notify, mpsc, watch};

use self::feed::Feed;
use super::{
    counters::Counters,
    pulse::Pulse,
    queue::Sample,
    room::Room,
    routes::RelaySpec,
    seal::{Protection, sample},
    stand_in::StandIn,
};
use crate::{ids::Gid, qos::Qos, session::Subscription};

/// A route that the peer asked for.
pub(super) struct RouteOut {
    /// Topic and kind, for the envelope.
    pub(super) route: Route,
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
    /// Send over this connection from now on.
    Connection(Carrier),
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
    counters: Arc<Counters>,
    /// What may wait in the queues.
    queues: Arc<Room>,
    /// A queue has room again, or is over.
    popped: Notify,
    /// A queue is over.
    ended: AtomicBool,
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
    number: u32,
    route: Route,
    sources: Vec<Source>,
    /// The newest sequence number by publisher that the peer had when it asked.
    seen: HashMap<Gid, u64>,
    /// What goes out, by publisher or client.
    feeds: HashMap<Gid, Feed>,
}

/// Serves one peer until the order channel closes.
pub(super) async fn run(
    first: Carrier,
    mut orders: mpsc::UnboundedReceiver<Order>,
    counters: Arc<Counters>,
    queues: Arc<Room>,
    pulse: Pulse,
) {
    let (carrier, current) = watch::channel(first);
    let (popped, ended) = (Notify::new(), AtomicBool::new(false));
    let shared = Arc::new(Shared { carrier: current, counters, queues, popped, ended });
    let mut routes: HashMap<u32, Active> = HashMap::new();
    let mut beat = pulse.subscribe();
    loop {
        beat.mark_unchanged();
        let (popped, freed) = (shared.popped.notified(), shared.queues.freed());
        tokio::pin!(popped, freed);
        // Registered before the queues are looked at, so that nothing in between is missed.
        popped.as_mut().enable();
        freed.as_mut().enable();
        // Relaxed: `popped`, which whoever stores it notifies afterwards, orders them.
        if shared.ended.swap(false, Ordering::Relaxed) {
            routes.values_mut().for_each(Active::prune);
        }
        let mut moved = Moved::default();
        for active in routes.values_mut() {
            active.move_samples(&shared, &mut moved);
        }
        if moved.queued > 0 {
            shared.carrier.borrow().protection.demand(moved.queued);
        }
        if moved.any {
            // More may wait; let the streams and orders run in between.
            tokio::task::yield_now().await;
            while let Ok(order) = orders.try_recv() {
                apply(order, &mut routes, &carrier);
            }
            continue;
        }
        tokio::select! {
            order = orders.recv() => match order {
                Some(order) => apply(order, &mut routes, &carrier),
                None => return,
            },
            changed = beat.changed() => if changed.is_err() { return },
            () = popped => {}
            () = freed => {}
            () = rested(moved.again) => {}
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

fn apply(order: Order, routes: &mut HashMap<u32, Active>, carrier: &watch::Sender<Carrier>) {
    match order {
        Order::Connection(next) => {
            let _ = carrier.send(next);
        }
        Order::End(number) => {
            routes.remove(&number);
        }
        Order::Route(number, RouteOut { route, sources, seen }) => {
            let feeds = HashMap::new();
            let new = Active { number, route, sources: Vec::new(), seen: HashMap::new(), feeds };
            let active = routes.entry(number).or_insert(new);
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
            feed.turn((self.number, self.route), &self.sources, shared, moved);
        }
    }

    /// Forgets those that nothing will come of.
    fn prune(&mut self) {
        let sources = &self.sources;
        let read = |of: &Gid| sources.iter().any(|source| source.reads(of));
        self.feeds.retain(|of, feed| feed.is_in_use() || read(of));
    }
}
