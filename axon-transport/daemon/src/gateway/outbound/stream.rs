//! A queue's samples, sealed and written to data streams.

use std::{
    collections::VecDeque,
    sync::{
        Arc, Mutex,
        atomic::{AtomicU64, AtomicUsize, Ordering},
    },
    time::Duration,
};

use axon_envelope::{Delivery, Kind};
use axon_shm::{ids::Gid, qos::Qos};
use bytes::Bytes;
use quinn::{SendStream, VarInt};
use tokio::sync::Notify;

use super::{
    Carrier, Done, Flow, Shared,
    acknowledged::Awaited,
    flight::{Flight, Handed},
};
use crate::{
    gateway::{
        frames::Frames,
        inbound::stream_header,
        keyring::lock,
        protection::Protection,
        queue::{Offered, Queue, Sample},
    },
    keys::NoKey,
    link::CloseCode,
};

/// Bytes of samples that are written at once, where so many wait. A lone one waits for no other.
const TOGETHER: usize = 64 << 10;
/// The priority of requests and responses above samples.
const SERVICES: i32 = 1;
/// With nothing to send a stream is over after this.
const STREAM_IDLE: Duration = Duration::from_millis(if cfg!(test) { 50 } else { 30_000 });
/// A best-effort sample that cannot have arrived by then gives way to a newer one, and one for which no
/// stream can be had by then is dropped.
const BEST_EFFORT_LIFE: Duration = Duration::from_millis(200);

/// QUIC takes a whole best-effort sample within this, or none of it: others fill the link.
const BEST_EFFORT_WRITE: Duration = Duration::from_secs(2);

/// What waits for one publisher, or client of a service, and the task that sends it.
pub(super) struct Stream {
    queue: Arc<Mutex<Queue>>,
    filled: Arc<Notify>,
    /// Bytes that QUIC took over.
    moved: Arc<AtomicU64>,
    /// Samples that the task had taken from the queue and not written when it ended.
    left: Arc<AtomicUsize>,
    task: tokio::task::JoinHandle<()>,
    /// As long as there is something that the peer may acknowledge.
    _awaited: Option<Awaited>,
}

impl Drop for Stream {
    fn drop(&mut self) {
        self.task.abort();
    }
}

impl Stream {
    pub(super) fn new(flow: Flow, of: Gid, qos: &Qos, shared: Arc<Shared>) -> Self {
        let queue = Queue::new(qos, Arc::clone(&shared.queues), flow.acknowledged);
        let queue = Arc::new(Mutex::new(queue));
        let filled = Arc::new(Notify::new());
        let (moved, left) = (Arc::default(), Arc::default());
        let awaited =
            flow.acknowledged.then(|| shared.acknowledged.await_of(flow.number, of, &queue));
        let writer = Writer {
            flow,
            of,
            queue: Arc::clone(&queue),
            filled: Arc::clone(&filled),
            moved: Arc::clone(&moved),
            left: Arc::clone(&left),
            shared,
            batch: VecDeque::new(),
            delivery: Delivery::Reliable,
            flight: Flight::default(),
            frames: Frames::default(),
        };
        let task = tokio::spawn(writer.run());
        Self { queue, filled, moved, left, task, _awaited: awaited }
    }

    /// Queues a sample as `qos` says, unless the stream [is over](Self::is_over).
    pub(super) fn offer(&self, sample: Sample, qos: &Qos) -> Offered {
        // The lock under which it ends.
        let mut queue = lock(&self.queue);
        queue.serve(qos);
        let offered = queue.offer(sample);
        drop(queue);
        if matches!(offered, Offered::Queued { .. }) {
            self.filled.notify_one();
        }
        offered
    }

    /// The peer acknowledged samples: there may be room for more to be under way.
    pub(super) fn has_room(&self) {
        self.filled.notify_one();
    }

    /// Bytes that QUIC took over.
    pub(super) fn moved(&self) -> u64 {
        // Relaxed: a count that is compared with itself.
        self.moved.load(Ordering::Relaxed)
    }

    /// Ends it. How many samples were not written.
    pub(super) async fn end(mut self) -> u64 {
        self.task.abort();
        // An error: it was aborted.
        let _ = (&mut self.task).await;
        // Relaxed: the end of the task comes before it.
        lock(&self.queue).waiting() + self.left.load(Ordering::Relaxed) as u64
    }

    /// Whether it has ended, with nothing left to send.
    pub(super) fn is_over(&self) -> bool {
        lock(&self.queue).is_over()
    }
}

/// Seals and writes the samples of one queue.
struct Writer {
    flow: Flow,
    of: Gid,
    queue: Arc<Mutex<Queue>>,
    filled: Arc<Notify>,
    moved: Arc<AtomicU64>,
    left: Arc<AtomicUsize>,
    shared: Arc<Shared>,
    /// What was taken from the queue and is not known to be written.
    batch: VecDeque<Sample>,
    /// How it is to be delivered.
    delivery: Delivery,
    /// Best effort that is not acknowledged.
    flight: Flight,
    /// What of it is sealed.
    frames: Frames,
}

impl Drop for Writer {
    fn drop(&mut self) {
        // Relaxed as where it is read.
        self.left.store(self.batch.len(), Ordering::Relaxed);
    }
}

/// The link is gone. What it did not carry goes over the next one, if there is one.
struct Gone;

impl Writer {
    /// Fills the batch with what waits; whether there is anything in it.
    fn gather(&mut self) -> bool {
        if self.batch.is_empty() {
            let mut queue = lock(&self.queue);
            self.delivery = queue.delivery();
            if self.delivery == Delivery::BestEffort {
                let window = || self.shared.carrier.borrow().connection.stats().path.cwnd;
                if !self.flight.has_room(window) {
                    return false;
                }
                // What would arrive too late gives way to what is newer.
                let late = queue.drop_late(BEST_EFFORT_LIFE, self.flight.took());
                self.shared.counters.lost(&self.flow.topic, "late", late);
            }
            queue.pop_together(TOGETHER, &mut self.batch);
            drop(queue);
            if !self.batch.is_empty() {
                self.shared.popped.notify_one();
            }
        }
        !self.batch.is_empty()
    }

    /// As [`gather`](Self::gather), once something waits.
    async fn next(&mut self) {
        while !self.gather() {
            tokio::select! {
                () = self.filled.notified() => {}
                () = self.flight.landed() => {}
            }
        }
    }

    /// Seals the batch, or as much of it as there are keys for; of RELIABLE one sample at least, for
    /// whose key it waits. How many samples.
    async fn seal(&mut self, carrier: &Carrier) -> Result<usize, Gone> {
        let delivery = self.delivery;
        loop {
            let Protection::Envelope { keys, .. } = &carrier.protection else {
                return self.seal_now(carrier).map_err(|_| Gone);
            };
            let changed = keys.changed.notified();
            tokio::pin!(changed);
            changed.as_mut().enable();
            match self.seal_now(carrier) {
                Ok(sealed) => return Ok(sealed),
                Err(_) if delivery == Delivery::BestEffort => return Ok(0),
                Err(NoKey::Detached) => return Err(Gone),
                Err(_) if carrier.connection.close_reason().is_some() => return Err(Gone),
                // The timeout only covers a connection that closes while no key comes.
                Err(_) => {
                    let _ = tokio::time::timeout(Duration::from_millis(250), changed).await;
                }
            }
        }
    }

    /// As [`seal`](Self::seal), without waiting.
    fn seal_now(&mut self, carrier: &Carrier) -> Result<usize, NoKey> {
        let mut sealed = 0;
        for sample in &self.batch {
            match carrier.protection.write(sample, self.flow.route, self.delivery, &mut self.frames)
            {
                Ok(()) => sealed += 1,
                Err(why) if sealed == 0 => return Err(why),
                Err(_) => break,
            }
        }
        Ok(sealed)
    }

    /// The header of its streams, for what is in the batch.
    fn header(&self) -> Bytes {
        let reliable = self.delivery == Delivery::Reliable;
        Bytes::copy_from_slice(&stream_header(reliable, self.flow.number, self.of))
    }

    /// Sends what comes until nothing has come for a while. What is reliable goes over one long stream,
    /// in order. When the connection is lost, a new carrier goes on after the old stream was
    /// acknowledged to its end, so that nothing is overtaken; it begins with what the peer has not
    /// acknowledged, which drops what it has.
    async fn run(mut self) {
        let mut carriers = self.shared.carrier.clone();
        loop {
            let carrier = carriers.borrow_and_update().clone();
            let mut stream: Option<SendStream> = None;
            if self.flow.acknowledged {
                self.batch.clear();
                lock(&self.queue).rewind();
            }
            loop {
                match carriers.has_changed() {
                    Ok(false) => {}
                    Ok(true) => break,
                    Err(_) => return,
                }
                if !self.gather() {
                    tokio::select! {
                        () = self.next() => {}
                        changed = carriers.changed() => {
                            if changed.is_err() { return }
                            carriers.mark_changed();
                        }
                        () = tokio::time::sleep(STREAM_IDLE) => {
                            if lock(&self.queue).end() {
                                finish(&mut stream, &carrier);
                                // Relaxed as where it is read.
                                self.shared.ended.store(true, Ordering::Relaxed);
                                return self.shared.popped.notify_one();
                            }
                        }
                    }
                    continue;
                }
                if self.delivery == Delivery::BestEffort {
                    // The peer reads one stream of a publisher after the other.
                    finish(&mut stream, &carrier);
                    self.best_effort(&carrier).await;
                } else if let Err(Gone) = self.reliable(&mut stream, &carrier).await {
                    if carriers.changed().await.is_err() {
                        return;
                    }
                    carriers.mark_changed();
                }
            }
            if let Some(mut old) = stream
                && old.finish().is_ok()
            {
                let _ = old.stopped().await;
            }
        }
    }

    /// Writes what of the batch can be sealed.
    async fn reliable(
        &mut self,
        stream: &mut Option<SendStream>,
        carrier: &Carrier,
    ) -> Result<(), Gone> {
        let sealed = self.seal(carrier).await?;
        let mut pieces = self.frames.take();
        if stream.is_none() {
            let opened = carrier.connection.open_uni().await.map_err(|_| Gone)?;
            let _ =
                opened.set_priority(if self.flow.route.kind == Kind::Topic { 0 } else { SERVICES });
            pieces.insert(0, self.header());
            *stream = Some(opened);
        }
        let Some(open) = stream.as_mut() else { return Err(Gone) };
        match write(open, &mut pieces, &self.moved).await {
            Ok(()) => {
                let mut newest = None;
                for sample in self.batch.drain(..sealed) {
                    self.shared.counters.sent(sample.payload.len());
                    newest = Some(sample.info.sequence);
                }
                if let (Some(sequence), false) = (newest, self.flow.acknowledged) {
                    self.done(Done { sequence, given_up: 0 });
                }
                Ok(())
            }
            // The peer no longer has the route; it says so on the control stream too.
            Err(quinn::WriteError::Stopped(_)) => {
                *stream = None;
                let newest = self.batch.drain(..sealed).map(|sample| sample.info.sequence).last();
                let acknowledged = lock(&self.queue).acknowledge(newest.unwrap_or(0)).0;
                // Of those that the peer acknowledges some may have been.
                let all = sealed as u64;
                let given_up = if self.flow.acknowledged { acknowledged } else { all };
                self.shared.counters.lost(&self.flow.topic, "no_route", given_up);
                if let Some(sequence) = newest {
                    self.done(Done { sequence, given_up });
                }
                Ok(())
            }
            Err(_) => Err(Gone),
        }
    }

    /// Nothing more is done for these.
    fn done(&self, done: Done) {
        self.shared.done(self.flow.number, self.of, done);
    }

    /// A stream of its own for the sample, reset when it is not acknowledged in time.
    async fn best_effort(&mut self, carrier: &Carrier) {
        if let Err(cause) = self.try_best_effort(carrier).await {
            self.shared.counters.lost(&self.flow.topic, cause, self.batch.len() as u64);
        }
        let newest = self.batch.drain(..).next_back().map(|sample| sample.info.sequence);
        if let Some(sequence) = newest {
            self.done(Done { sequence, given_up: 0 });
        }
    }

    /// As [`best_effort`](Self::best_effort); why the sample was dropped.
    async fn try_best_effort(&mut self, carrier: &Carrier) -> Result<(), &'static str> {
        if carrier.connection.close_reason().is_some() {
            return Err("no_link");
        }
        match self.seal(carrier).await {
            Ok(1) => {}
            Ok(_) => return Err("no_key"),
            Err(Gone) => return Err("no_link"),
        }
        let mut pieces = self.frames.take();
        pieces.insert(0, self.header());
        let left = self.batch.front().and_then(Sample::left).unwrap_or(Duration::MAX);
        let patience = BEST_EFFORT_LIFE.min(left);
        let opened = tokio::time::timeout(patience, carrier.connection.open_uni());
        let Ok(Ok(mut stream)) = opened.await else { return Err("late") };
        let _ = stream.set_priority(self.flight.priority());
        let bytes = pieces.iter().map(|piece| piece.len() as u64).sum();
        let write = stream.write_all_chunks(&mut pieces);
        if !matches!(tokio::time::timeout(BEST_EFFORT_WRITE.min(left), write).await, Ok(Ok(()))) {
            // Dropping it would finish it, as if the message were whole.
            let _ = stream.reset(VarInt::from_u32(CloseCode::Goodbye.code()));
            return Err("late");
        }
        let _ = stream.finish();
        let payload = self.batch.iter().map(|sample| sample.payload.len()).sum();
        let (counters, topic) = (self.shared.counters.clone(), Arc::clone(&self.flow.topic));
        let sample = Handed { counters, topic, payload };
        self.flight.add(stream, bytes, left, carrier.clone(), sample);
        Ok(())
    }
}

/// Writes all `pieces`, and counts what QUIC took over.
async fn write(
    stream: &mut SendStream,
    pieces: &mut [Bytes],
    moved: &AtomicU64,
) -> Result<(), quinn::WriteError> {
    let mut left = pieces;
    while !left.is_empty() {
        let written = stream.write_chunks(left).await?;
        // Relaxed as where it is read.
        moved.fetch_add(written.bytes as u64, Ordering::Relaxed);
        left = &mut left[written.chunks..];
    }
    Ok(())
}

/// Finishes a stream: nothing more goes over it. Until it is acknowledged to its end its carrier is in use.
fn finish(stream: &mut Option<SendStream>, carrier: &Carrier) {
    if let Some(mut stream) = stream.take()
        && stream.finish().is_ok()
    {
        let carrier = carrier.clone();
        tokio::spawn(async move {
            let _ = stream.stopped().await;
            drop(carrier);
        });
    }
}
