//! Samples to a peer: relay subscriptions and stand-ins in, data streams out.
//!
//! One task a peer moves samples from the rings into a queue per (route, publisher), or client where
//! it is of a service; one task a queue seals and writes them. A peer that is slow fills its own
//! queues and then leaves its samples in the ring, where they hold back a KEEP_ALL publisher and
//! nobody else.

mod stream;

use std::{
    collections::HashMap,
    sync::Arc,
    time::{Duration, Instant},
};

use axon_envelope::{Kind, Route};
use quinn::Connection;
use tokio::sync::{Notify, mpsc, watch};

use self::stream::Stream;
use super::{
    counters::Counters,
    keyring::lock,
    pulse::Pulse,
    queue::{Offered, Sample},
    room::Room,
    routes::{Offered as Offer, RelaySpec, serves},
    seal::{Protection, sample},
    stand_in::StandIn,
};
use crate::{
    ids::Gid,
    qos::{Qos, Reliability},
    session::Subscription,
};

/// Samples taken from one relay before the next one has its turn, and bytes.
const BATCH: (usize, usize) = (64, 256 << 10);
/// After a turn in which most samples took the room of others a relay is left alone for so long: what
/// its publisher writes over meanwhile nobody has copied in vain. That is longer where they are long,
/// by so many nanoseconds a byte.
const REST: (Duration, u64) = (Duration::from_millis(1), 2);

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
    fn take(&self) -> Option<Sample> {
        match self {
            Self::Relay(_, subscription) => {
                let mut payload = Vec::new();
                let info = subscription.take(&mut payload)?;
                Some(sample(info, payload))
            }
            Self::StandIn(stand_in) => stand_in.take(),
        }
    }

    /// How what is taken there is queued: of a service nothing is dropped.
    fn qos(&self) -> Qos {
        match self {
            Self::Relay(spec, _) => spec.qos,
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
    /// A queue has room again.
    popped: Notify,
}

/// A source, and a sample of it for which there was no room.
struct Tap {
    source: Source,
    pending: Option<Sample>,
    /// Until when it is left alone.
    rests: Option<Instant>,
}

/// What came of looking for samples.
#[derive(Default)]
struct Moved {
    /// Some were taken: there may be more.
    any: bool,
    queued: u32,
    /// When a source that rests is to be looked at again.
    again: Option<Instant>,
}

struct Active {
    route: Route,
    taps: Vec<Tap>,
    /// The newest sequence number by publisher, or client that asks, that need not be sent.
    seen: HashMap<Gid, u64>,
    streams: HashMap<Gid, Stream>,
}

/// Serves one peer until the order channel closes. `offered` says what a local publisher offers.
pub(super) async fn run(
    first: Carrier,
    mut orders: mpsc::UnboundedReceiver<Order>,
    counters: Arc<Counters>,
    queues: Arc<Room>,
    pulse: Pulse,
    offered: impl Fn(Gid) -> Option<Offer> + Send,
) {
    let (carrier, current) = watch::channel(first);
    let shared = Arc::new(Shared { carrier: current, counters, queues, popped: Notify::new() });
    let mut routes: HashMap<u32, Active> = HashMap::new();
    let mut beat = pulse.subscribe();
    loop {
        beat.mark_unchanged();
        let (popped, freed) = (shared.popped.notified(), shared.queues.freed());
        tokio::pin!(popped, freed);
        // Registered before the queues are looked at, so that nothing in between is missed.
        popped.as_mut().enable();
        freed.as_mut().enable();
        let mut moved = Moved::default();
        for (number, active) in &mut routes {
            active.move_samples(*number, &shared, &offered, &mut moved);
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
        Order::Route(number, route) => {
            let mut old = routes.remove(&number);
            let mut taps = Vec::new();
            for source in route.sources {
                // One that goes on keeps the sample it holds.
                let pending = old.as_mut().and_then(|o| {
                    let tap = o.taps.iter_mut().find(|tap| tap.source.is(&source));
                    tap.and_then(|tap| tap.pending.take())
                });
                taps.push(Tap { source, pending, rests: None });
            }
            let mut seen = route.seen;
            let mut streams = HashMap::new();
            if let Some(old) = old {
                if route.route.kind != Kind::Topic {
                    seen.extend(old.seen);
                }
                streams = old.streams;
            }
            routes.insert(number, Active { route: route.route, taps, seen, streams });
        }
    }
}

impl Active {
    /// Moves what the rings hold into the queues.
    fn move_samples(
        &mut self,
        number: u32,
        shared: &Arc<Shared>,
        offered: &impl Fn(Gid) -> Option<Offer>,
        moved: &mut Moved,
    ) {
        for index in 0..self.taps.len() {
            let tap = &mut self.taps[index];
            if let Some(until) = tap.rests {
                if until > Instant::now() {
                    moved.again = moved.again.into_iter().chain([until]).min();
                    continue;
                }
                tap.rests = None;
            }
            let (mut samples, mut bytes, mut dropped) = (0, 0, 0);
            while samples < BATCH.0 && bytes < BATCH.1 {
                let tap = &mut self.taps[index];
                let next = tap.pending.take().or_else(|| tap.source.take());
                let Some(sample) = next else { break };
                samples += 1;
                bytes += sample.payload.len();
                if !self.wanted(index, &sample, offered) {
                    moved.any = true;
                    continue;
                }
                match self.offer(number, index, sample, shared) {
                    Offered::Queued { dropped: older } => {
                        dropped += older;
                        moved.queued += 1;
                        moved.any = true;
                    }
                    Offered::Full(sample) => {
                        self.taps[index].pending = Some(sample);
                        break;
                    }
                }
            }
            // Of BEST_EFFORT little waits, which is gone before such a rest is over, unless the
            // publisher is far ahead.
            let whole = samples >= BATCH.0 || bytes >= BATCH.1;
            let reliable = self.taps[index].source.qos().reliability == Reliability::Reliable;
            if 2 * dropped >= samples as u64 && dropped > 0 && (whole || reliable) {
                let rest = REST.0.max(Duration::from_nanos(bytes as u64 * REST.1));
                self.taps[index].rests = Some(Instant::now() + rest);
            }
        }
    }

    /// Whether this source is the one that sends the sample, and the peer lacks it.
    fn wanted(
        &self,
        index: usize,
        sample: &Sample,
        offered: &impl Fn(Gid) -> Option<Offer>,
    ) -> bool {
        let publisher = sample.info.publisher;
        let new = || self.seen.get(&publisher).is_none_or(|last| sample.info.sequence > *last);
        let specs = self.taps.iter().filter_map(|tap| match &tap.source {
            Source::Relay(spec, _) => Some(spec),
            Source::StandIn(_) => None,
        });
        match self.route.kind {
            // A publisher that is gone from the graph still drains through the relay that has it.
            Kind::Topic => {
                new() && offered(publisher).is_none_or(|o| serves(specs, &o) == Some(index))
            }
            // It comes by way of each server there is on the other side.
            Kind::Request => new(),
            Kind::Response => true,
        }
    }

    fn offer(
        &mut self,
        number: u32,
        index: usize,
        sample: Sample,
        shared: &Arc<Shared>,
    ) -> Offered {
        let (publisher, sequence) = (sample.info.publisher, sample.info.sequence);
        let of = sample.client.unwrap_or(publisher);
        let (route, qos) = (self.route, self.taps[index].source.qos());
        let ended = self.streams.get(&of).is_some_and(|s| s.task.is_finished());
        if ended {
            self.streams.remove(&of);
        }
        let stream = self
            .streams
            .entry(of)
            .or_insert_with(|| Stream::start(number, route, of, &qos, Arc::clone(shared)));
        let offered = lock(&stream.queue).offer(sample);
        if let Offered::Queued { dropped } = offered {
            if route.kind == Kind::Request {
                self.seen.insert(publisher, sequence);
            }
            shared.counters.dropped("queue", dropped);
            stream.filled.notify_one();
        }
        offered
    }
}
