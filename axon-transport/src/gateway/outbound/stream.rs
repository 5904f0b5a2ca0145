//! A queue's samples, sealed and written to data streams.

use std::{
    collections::VecDeque,
    sync::{Arc, Mutex},
    time::Duration,
};

use axon_envelope::{Delivery, Kind, Route};
use bytes::Bytes;
use quinn::{SendStream, VarInt};
use tokio::sync::Notify;

use super::{Carrier, Shared};
use crate::{
    gateway::{
        frames::Frames,
        inbound::stream_header,
        keyring::lock,
        queue::{Queue, Sample},
        seal::Protection,
    },
    ids::Gid,
    keys::NoKey,
    link::CloseCode,
    qos::{Qos, Reliability},
};

/// Bytes of samples that are written at once, where so many wait. A lone one waits for no other.
const TOGETHER: usize = 64 << 10;
/// So many bytes a single sample always has.
const ONE: usize = 1;
/// The priority of requests and responses above samples.
const SERVICES: i32 = 1;
/// A reliable stream with nothing to send is finished after this.
const STREAM_IDLE: Duration = Duration::from_secs(30);
/// A best-effort sample that is not acknowledged by then is given up.
const BEST_EFFORT_LIFE: Duration = Duration::from_millis(200);

/// What waits for one publisher, or client of a service, and the task that sends it.
pub(super) struct Stream {
    pub(super) queue: Arc<Mutex<Queue>>,
    pub(super) filled: Arc<Notify>,
    pub(super) task: tokio::task::JoinHandle<()>,
}

impl Drop for Stream {
    fn drop(&mut self) {
        self.task.abort();
    }
}

impl Stream {
    pub(super) fn start(
        number: u32,
        route: Route,
        of: Gid,
        qos: &Qos,
        shared: Arc<Shared>,
    ) -> Self {
        let queue = Arc::new(Mutex::new(Queue::new(qos, Arc::clone(&shared.queues))));
        let filled = Arc::new(Notify::new());
        let reliable = qos.reliability == Reliability::Reliable;
        let writer = Writer {
            header: stream_header(reliable, number, of),
            route,
            queue: Arc::clone(&queue),
            filled: Arc::clone(&filled),
            shared,
            batch: VecDeque::new(),
            frames: Frames::default(),
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
    /// What was taken from the queue and is not known to be written.
    batch: VecDeque<Sample>,
    /// What of it is sealed.
    frames: Frames,
}

/// The link is gone. What it did not carry goes over the next one, if there is one.
struct Gone;

impl Writer {
    /// Fills the batch with what waits, up to `bytes`; whether there is anything in it.
    fn gather(&mut self, bytes: usize) -> bool {
        if self.batch.is_empty() {
            lock(&self.queue).pop_together(bytes, &mut self.batch);
            if !self.batch.is_empty() {
                self.shared.popped.notify_one();
            }
        }
        !self.batch.is_empty()
    }

    /// As [`gather`](Self::gather), once something waits.
    async fn next(&mut self, bytes: usize) {
        while !self.gather(bytes) {
            self.filled.notified().await;
        }
    }

    /// Seals the batch, or as much of it as there are keys for; of RELIABLE one sample at least, for
    /// whose key it waits. How many samples.
    async fn seal(&mut self, carrier: &Carrier, delivery: Delivery) -> Result<usize, Gone> {
        loop {
            let Protection::Envelope { keys, .. } = &carrier.protection else {
                return self.seal_now(carrier, delivery).map_err(|_| Gone);
            };
            let changed = keys.changed.notified();
            tokio::pin!(changed);
            changed.as_mut().enable();
            match self.seal_now(carrier, delivery) {
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
    fn seal_now(&mut self, carrier: &Carrier, delivery: Delivery) -> Result<usize, NoKey> {
        let mut sealed = 0;
        for sample in &self.batch {
            match carrier.protection.write(sample, self.route, delivery, &mut self.frames) {
                Ok(()) => sealed += 1,
                Err(why) if sealed == 0 => return Err(why),
                Err(_) => break,
            }
        }
        Ok(sealed)
    }

    /// One long stream, in order. Ends when the connection is lost; a new carrier goes on after
    /// the old stream was acknowledged to its end, so that nothing is overtaken.
    async fn reliable(mut self) {
        let mut carriers = self.shared.carrier.clone();
        loop {
            let carrier = carriers.borrow_and_update().clone();
            let mut stream: Option<SendStream> = None;
            loop {
                match carriers.has_changed() {
                    Ok(false) => {}
                    Ok(true) => break,
                    Err(_) => return,
                }
                if !self.gather(TOGETHER) {
                    tokio::select! {
                        () = self.next(TOGETHER) => {}
                        changed = carriers.changed() => {
                            if changed.is_err() { return }
                            carriers.mark_changed();
                        }
                        () = tokio::time::sleep(STREAM_IDLE), if stream.is_some() => {
                            if let Some(mut idle) = stream.take() { let _ = idle.finish(); }
                        }
                    }
                    continue;
                }
                if let Err(Gone) = self.send(&mut stream, &carrier).await {
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
    async fn send(
        &mut self,
        stream: &mut Option<SendStream>,
        carrier: &Carrier,
    ) -> Result<(), Gone> {
        let sealed = self.seal(carrier, Delivery::Reliable).await?;
        let mut pieces = self.frames.take();
        if stream.is_none() {
            let opened = carrier.connection.open_uni().await.map_err(|_| Gone)?;
            let _ = opened.set_priority(if self.route.kind == Kind::Topic { 0 } else { SERVICES });
            pieces.insert(0, Bytes::copy_from_slice(&self.header));
            *stream = Some(opened);
        }
        let Some(open) = stream.as_mut() else { return Err(Gone) };
        match open.write_all_chunks(&mut pieces).await {
            Ok(()) => {
                for sample in self.batch.drain(..sealed) {
                    self.shared.counters.sent(sample.payload.len());
                }
                Ok(())
            }
            // The peer no longer has the route; it says so on the control stream too.
            Err(quinn::WriteError::Stopped(_)) => {
                *stream = None;
                self.batch.drain(..sealed);
                self.shared.counters.dropped("no_route", sealed as u64);
                Ok(())
            }
            Err(_) => Err(Gone),
        }
    }

    /// A stream a message, reset when it is not acknowledged in time.
    async fn best_effort(mut self) {
        loop {
            self.batch.clear();
            self.next(ONE).await;
            let carrier = self.shared.carrier.borrow().clone();
            if carrier.connection.close_reason().is_some() {
                self.shared.counters.dropped("no_link", 1);
                continue;
            }
            match self.seal(&carrier, Delivery::BestEffort).await {
                Ok(1) => {}
                Ok(_) => {
                    self.shared.counters.dropped("no_key", 1);
                    continue;
                }
                Err(Gone) => continue,
            }
            let mut pieces = self.frames.take();
            pieces.insert(0, Bytes::copy_from_slice(&self.header));
            let opened = tokio::time::timeout(BEST_EFFORT_LIFE, carrier.connection.open_uni());
            let Ok(Ok(mut stream)) = opened.await else {
                self.shared.counters.dropped("late", 1);
                continue;
            };
            let write = stream.write_all_chunks(&mut pieces);
            if matches!(tokio::time::timeout(BEST_EFFORT_LIFE, write).await, Ok(Ok(()))) {
                let _ = stream.finish();
                self.batch.iter().for_each(|s| self.shared.counters.sent(s.payload.len()));
                tokio::spawn(give_up_in_time(stream, carrier));
            } else {
                // Dropping it would finish it, as if the message were whole.
                let _ = stream.reset(VarInt::from_u32(CloseCode::Goodbye.code()));
                self.shared.counters.dropped("late", 1);
            }
        }
    }
}

/// Resets a finished stream that the peer has not acknowledged in time. Until then its carrier is in use.
async fn give_up_in_time(mut stream: SendStream, _carrier: Carrier) {
    let acknowledged = tokio::time::timeout(BEST_EFFORT_LIFE, stream.stopped()).await;
    if acknowledged.is_err() {
        let _ = stream.reset(VarInt::from_u32(CloseCode::Goodbye.code()));
    }
}
