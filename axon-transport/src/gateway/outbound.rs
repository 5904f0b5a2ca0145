//! Samples to a peer: relay subscriptions in, data streams out.
//!
//! One task a peer moves samples from the rings into a queue per (route, publisher); one task a
//! queue seals and writes them. A peer that is slow fills its own queues and then leaves its
//! samples in the ring, where they hold back a KEEP_ALL publisher and nobody else.

use std::{
    collections::HashMap,
    sync::{Arc, Mutex},
    time::Duration,
};

use axon_envelope::{Delivery, Route};
use quinn::{Connection, SendStream, VarInt};
use tokio::sync::{Notify, mpsc, watch};

use super::{
    counters::Counters,
    inbound::stream_header,
    keyring::lock,
    pulse::Pulse,
    queue::{Offered, Queue, Sample},
    routes::{RelaySpec, serves},
    seal::{Protection, sample},
};
use crate::{
    ids::Gid,
    keys::NoKey,
    link::CloseCode,
    qos::{Qos, Reliability},
    session::Subscription,
};

/// Most that waits for one publisher.
const PUBLISHER_BYTES: usize = 8 << 20;
/// Samples taken from one relay before the next one has its turn.
const BATCH: usize = 64;
/// A reliable stream with nothing to send is finished after this.
const STREAM_IDLE: Duration = Duration::from_secs(30);
/// A best-effort sample that is not acknowledged by then is given up.
const BEST_EFFORT_LIFE: Duration = Duration::from_millis(200);

/// A route that the peer asked for.
pub(super) struct RouteOut {
    /// Topic and kind, for the envelope.
    pub(super) route: Route,
    /// Its relays, in the order of [`super::routes::relays`].
    pub(super) relays: Vec<(RelaySpec, Arc<Subscription>)>,
    /// Samples that the peer has already: the newest sequence number by publisher.
    pub(super) seen: HashMap<Gid, u64>,
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
}

/// What the streams of a peer share.
struct Shared {
    carrier: watch::Receiver<Carrier>,
    counters: Arc<Counters>,
    /// A queue has room again.
    room: Notify,
}

struct Stream {
    queue: Arc<Mutex<Queue>>,
    filled: Arc<Notify>,
    task: tokio::task::JoinHandle<()>,
}

impl Drop for Stream {
    fn drop(&mut self) {
        self.task.abort();
    }
}

struct Relay {
    subscription: Arc<Subscription>,
    /// A sample for which there was no room.
    pending: Option<Sample>,
}

struct Active {
    route: Route,
    specs: Vec<RelaySpec>,
    relays: Vec<Relay>,
    seen: HashMap<Gid, u64>,
    streams: HashMap<Gid, Stream>,
}

/// Serves one peer until the order channel closes. `offered` gives a local publisher's QoS.
pub(super) async fn run(
    first: Carrier,
    mut orders: mpsc::UnboundedReceiver<Order>,
    counters: Arc<Counters>,
    pulse: Pulse,
    offered: impl Fn(Gid) -> Option<Qos> + Send,
) {
    let (carrier, current) = watch::channel(first);
    let shared = Arc::new(Shared { carrier: current, counters, room: Notify::new() });
    let mut routes: HashMap<u32, Active> = HashMap::new();
    let mut beat = pulse.subscribe();
    loop {
        beat.mark_unchanged();
        let room = shared.room.notified();
        tokio::pin!(room);
        // Registered before the queues are looked at, so that no pop in between is missed.
        room.as_mut().enable();
        let mut moved = false;
        for (number, active) in &mut routes {
            moved |= active.move_samples(*number, &shared, &offered);
        }
        if moved {
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
            () = room => {}
        }
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
            let mut specs = Vec::new();
            let mut relays = Vec::new();
            for (spec, subscription) in route.relays {
                // A relay that goes on keeps the sample it holds.
                let pending = old.as_mut().and_then(|o| {
                    o.relays
                        .iter_mut()
                        .find(|r| Arc::ptr_eq(&r.subscription, &subscription))
                        .and_then(|r| r.pending.take())
                });
                specs.push(spec);
                relays.push(Relay { subscription, pending });
            }
            let streams = old.map(|o| o.streams).unwrap_or_default();
            let active = Active { route: route.route, specs, relays, seen: route.seen, streams };
            routes.insert(number, active);
        }
    }
}

impl Active {
    /// Moves what the rings hold into the queues; true when anything moved.
    fn move_samples(
        &mut self,
        number: u32,
        shared: &Arc<Shared>,
        offered: &impl Fn(Gid) -> Option<Qos>,
    ) -> bool {
        let mut moved = false;
        for index in 0..self.relays.len() {
            for _ in 0..BATCH {
                let relay = &mut self.relays[index];
                let next = relay.pending.take().or_else(|| {
                    let mut payload = Vec::new();
                    let info = relay.subscription.take(&mut payload)?;
                    Some(sample(info, payload))
                });
                let Some(sample) = next else { break };
                if self.wanted(index, &sample, offered)
                    && let Some(back) = self.offer(number, index, sample, shared)
                {
                    self.relays[index].pending = Some(back);
                    break;
                }
                moved = true;
            }
        }
        moved
    }

    /// Whether this relay is the one that sends the sample, and the peer lacks it.
    fn wanted(&self, index: usize, sample: &Sample, offered: &impl Fn(Gid) -> Option<Qos>) -> bool {
        let publisher = sample.info.publisher;
        let new = self.seen.get(&publisher).is_none_or(|last| sample.info.sequence > *last);
        // A publisher that is gone from the graph still drains through the relay that has it.
        new && offered(publisher).is_none_or(|qos| serves(&self.specs, &qos) == Some(index))
    }

    fn offer(
        &mut self,
        number: u32,
        index: usize,
        sample: Sample,
        shared: &Arc<Shared>,
    ) -> Option<Sample> {
        let publisher = sample.info.publisher;
        let (route, qos) = (self.route, self.specs[index].qos);
        let ended = self.streams.get(&publisher).is_some_and(|s| s.task.is_finished());
        if ended {
            self.streams.remove(&publisher);
        }
        let stream = self
            .streams
            .entry(publisher)
            .or_insert_with(|| Stream::start(number, route, publisher, &qos, Arc::clone(shared)));
        let offered = lock(&stream.queue).offer(sample);
        match offered {
            Offered::Full(sample) => Some(sample),
            Offered::Queued { dropped } => {
                shared.counters.dropped("queue", dropped);
                shared.carrier.borrow().protection.demand(1);
                stream.filled.notify_one();
                None
            }
        }
    }
}

impl Stream {
    fn start(number: u32, route: Route, publisher: Gid, qos: &Qos, shared: Arc<Shared>) -> Self {
        let queue = Arc::new(Mutex::new(Queue::new(qos, PUBLISHER_BYTES)));
        let filled = Arc::new(Notify::new());
        let reliable = qos.reliability == Reliability::Reliable;
        let writer = Writer {
            header: stream_header(reliable, number, publisher),
            route,
            queue: Arc::clone(&queue),
            filled: Arc::clone(&filled),
            shared,
            frame: Vec::new(),
        };
        let task = tokio::spawn(async move {
            if reliable { writer.reliable().await } else { writer.best_effort().await }
        });
        Self { queue, filled, task }
    }
}

/// Seals and writes the samples of one queue.
struct Writer {
    header: [u8; 24],
    route: Route,
    queue: Arc<Mutex<Queue>>,
    filled: Arc<Notify>,
    shared: Arc<Shared>,
    frame: Vec<u8>,
}

impl Writer {
    fn pop(&self) -> Option<Sample> {
        let sample = lock(&self.queue).pop()?;
        self.shared.room.notify_one();
        Some(sample)
    }

    async fn next(&self) -> Sample {
        loop {
            match self.pop() {
                Some(sample) => return sample,
                None => self.filled.notified().await,
            }
        }
    }

    /// Seals `sample` into the frame; waits for a key. False when the carrier changed meanwhile.
    async fn seal(&mut self, sample: &Sample, carrier: &Carrier, delivery: Delivery) -> bool {
        loop {
            let Protection::Envelope { keys, .. } = &carrier.protection else {
                let sealed =
                    carrier.protection.write(sample, self.route, delivery, &mut self.frame);
                return sealed.is_ok();
            };
            let changed = keys.changed.notified();
            tokio::pin!(changed);
            changed.as_mut().enable();
            let sealed = carrier.protection.write(sample, self.route, delivery, &mut self.frame);
            match sealed {
                Ok(()) => return true,
                Err(_) if delivery == Delivery::BestEffort => {
                    self.shared.counters.dropped("no_key", 1);
                    return false;
                }
                Err(NoKey::Detached) => return false,
                Err(_) if carrier.connection.close_reason().is_some() => return false,
                // The timeout only covers a connection that closes while no key comes.
                Err(_) => {
                    let _ = tokio::time::timeout(Duration::from_millis(250), changed).await;
                }
            }
        }
    }

    /// One long stream, in order. Ends when the connection is lost; a new carrier goes on after
    /// the old stream was acknowledged to its end, so that nothing is overtaken.
    async fn reliable(mut self) {
        let mut carriers = self.shared.carrier.clone();
        let mut held: Option<Sample> = None;
        loop {
            let carrier = carriers.borrow_and_update().clone();
            let mut stream: Option<SendStream> = None;
            loop {
                let sample = match held.take() {
                    Some(sample) => sample,
                    None => tokio::select! {
                        sample = self.next() => sample,
                        changed = carriers.changed() => {
                            if changed.is_err() { return }
                            break;
                        }
                        () = tokio::time::sleep(STREAM_IDLE), if stream.is_some() => {
                            if let Some(mut idle) = stream.take() { let _ = idle.finish(); }
                            continue;
                        }
                    },
                };
                if self.send(&mut stream, &carrier, &sample).await.is_err() {
                    // The link is gone. The sample goes over the next one, if there is one.
                    held = Some(sample);
                    if carriers.changed().await.is_err() {
                        return;
                    }
                    break;
                }
                self.shared.counters.sent(sample.payload.len());
            }
            if let Some(mut old) = stream
                && old.finish().is_ok()
            {
                let _ = old.stopped().await;
            }
        }
    }

    async fn send(
        &mut self,
        stream: &mut Option<SendStream>,
        carrier: &Carrier,
        sample: &Sample,
    ) -> Result<(), ()> {
        if !self.seal(sample, carrier, Delivery::Reliable).await {
            return Err(());
        }
        if stream.is_none() {
            let mut opened = carrier.connection.open_uni().await.map_err(|_| ())?;
            opened.write_all(&self.header).await.map_err(|_| ())?;
            *stream = Some(opened);
        }
        let Some(open) = stream.as_mut() else { return Err(()) };
        match open.write_all(&self.frame).await {
            Ok(()) => Ok(()),
            // The peer no longer has the route; it says so on the control stream too.
            Err(quinn::WriteError::Stopped(_)) => {
                *stream = None;
                self.shared.counters.dropped("no_route", 1);
                Ok(())
            }
            Err(_) => Err(()),
        }
    }

    /// A stream a message, reset when it is not acknowledged in time.
    async fn best_effort(mut self) {
        loop {
            let sample = self.next().await;
            let carrier = self.shared.carrier.borrow().clone();
            if carrier.connection.close_reason().is_some() {
                self.shared.counters.dropped("no_link", 1);
                continue;
            }
            if !self.seal(&sample, &carrier, Delivery::BestEffort).await {
                continue;
            }
            let opened = tokio::time::timeout(BEST_EFFORT_LIFE, carrier.connection.open_uni());
            let Ok(Ok(mut stream)) = opened.await else {
                self.shared.counters.dropped("late", 1);
                continue;
            };
            let write = async {
                stream.write_all(&self.header).await?;
                stream.write_all(&self.frame).await
            };
            if matches!(tokio::time::timeout(BEST_EFFORT_LIFE, write).await, Ok(Ok(()))) {
                let _ = stream.finish();
                self.shared.counters.sent(sample.payload.len());
                tokio::spawn(give_up_in_time(stream));
            } else {
                // Dropping it would finish it, as if the message were whole.
                let _ = stream.reset(VarInt::from_u32(CloseCode::Goodbye.code()));
                self.shared.counters.dropped("late", 1);
            }
        }
    }
}

/// Resets a finished stream that the peer has not acknowledged in time.
async fn give_up_in_time(mut stream: SendStream) {
    let acknowledged = tokio::time::timeout(BEST_EFFORT_LIFE, stream.stopped()).await;
    if acknowledged.is_err() {
        let _ = stream.reset(VarInt::from_u32(CloseCode::Goodbye.code()));
    }
}
