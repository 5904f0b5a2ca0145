//! A queue's samples, sealed and written to data streams.

use std::{
    sync::{Arc, Mutex},
    time::Duration,
};

use axon_envelope::{Delivery, Kind, Route};
use quinn::{SendStream, VarInt};
use tokio::sync::Notify;

use super::{Carrier, Shared};
use crate::{
    gateway::{
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

/// Most that waits for one publisher.
const PUBLISHER_BYTES: usize = 8 << 20;
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
        let queue = Arc::new(Mutex::new(Queue::new(qos, PUBLISHER_BYTES)));
        let filled = Arc::new(Notify::new());
        let reliable = qos.reliability == Reliability::Reliable;
        let writer = Writer {
            header: stream_header(reliable, number, of),
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
            let _ = opened.set_priority(if self.route.kind == Kind::Topic { 0 } else { SERVICES });
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
