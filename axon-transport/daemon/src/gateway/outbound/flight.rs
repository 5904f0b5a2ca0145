//! Best-effort samples of one publisher that were handed to QUIC and are not acknowledged.
//!
//! QUIC sends everything handed to it, however late. So the gateway hands over only what fits the congestion
//! window, or two samples. The rest waits in the queue, where the history's depth and a sample's age decide
//! whether it is still sent.

use std::{
    collections::VecDeque,
    sync::{Arc, Mutex},
    time::{Duration, Instant},
};

use quinn::{SendStream, VarInt};
use tokio::sync::Notify;

use super::Carrier;
use crate::{
    gateway::{counters::Counting, keyring::lock},
    link::CloseCode,
};

/// So many are under way whatever their length: the next one leaves while the last one is acknowledged.
const ALWAYS: usize = 2;
/// One that is not acknowledged by then is given up: the peer does not read it, or is gone.
const LONGEST: Duration = Duration::from_secs(10);
/// Priority of one behind another of its publisher's: the older one leaves first.
const BEHIND: i32 = -1;

/// Those of one publisher.
#[derive(Clone, Default)]
pub(super) struct Flight(Arc<Inner>);

#[derive(Default)]
struct Inner {
    samples: Mutex<Samples>,
    landed: Notify,
}

#[derive(Default)]
struct Samples {
    next: u64,
    /// How long the last one took that was acknowledged.
    took: Duration,
    /// The oldest first: number, bytes, and what has it go first.
    under_way: VecDeque<(u64, u64, Arc<Notify>)>,
}

/// What is counted of a sample once it is known what came of it.
pub(super) struct Handed {
    pub(super) counters: Counting,
    pub(super) topic: Arc<str>,
    pub(super) payload: usize,
}

impl Flight {
    /// Whether one more may be handed over, where the congestion window is this long.
    pub(super) fn has_room(&self, window: impl FnOnce() -> u64) -> bool {
        let samples = lock(&self.0.samples);
        let under_way = &samples.under_way;
        under_way.len() < ALWAYS
            || under_way.iter().map(|(_, bytes, _)| bytes).sum::<u64>() < window()
    }

    /// How long the last one took until it was acknowledged.
    pub(super) fn took(&self) -> Duration {
        lock(&self.0.samples).took
    }

    /// Waits until there may be room.
    pub(super) async fn landed(&self) {
        self.0.landed.notified().await;
    }

    /// The priority of a stream for the next one.
    pub(super) fn priority(&self) -> i32 {
        if lock(&self.0.samples).under_way.is_empty() { 0 } else { BEHIND }
    }

    /// A finished stream of so many bytes is under way. It is reset after `life`, when the peer would
    /// drop the sample. Its carrier is in use until it is acknowledged; then it counts as sent.
    pub(super) fn add(
        &self,
        mut stream: SendStream,
        bytes: u64,
        life: Duration,
        carrier: Carrier,
        sample: Handed,
    ) {
        let (flight, begun) = (self.clone(), Instant::now());
        let (number, first) = {
            let mut samples = lock(&self.0.samples);
            let (number, first) = (samples.next, Arc::new(Notify::new()));
            samples.next += 1;
            samples.under_way.push_back((number, bytes, Arc::clone(&first)));
            (number, first)
        };
        tokio::spawn(async move {
            let over = async {
                let acknowledged = stream.stopped();
                tokio::pin!(acknowledged);
                tokio::select! {
                    over = &mut acknowledged => return over,
                    () = first.notified() => {}
                }
                // Nothing to change where it is acknowledged already.
                let _ = stream.set_priority(0);
                acknowledged.await
            };
            let Handed { counters, topic, payload } = sample;
            match tokio::time::timeout(LONGEST.min(life), over).await {
                // A peer that stops it has no such route any more, and counts it.
                Ok(Ok(_)) => counters.sent(payload),
                Ok(Err(_)) => counters.lost(&topic, "no_link", 1),
                Err(_) => {
                    let _ = stream.reset(VarInt::from_u32(CloseCode::Goodbye.code()));
                    counters.lost(&topic, "late", 1);
                }
            }
            flight.land(number, begun.elapsed());
            drop(carrier);
        });
    }

    fn land(&self, number: u64, took: Duration) {
        let mut samples = lock(&self.0.samples);
        samples.took = took;
        samples.under_way.retain(|(other, ..)| *other != number);
        if let Some((_, _, first)) = samples.under_way.front() {
            first.notify_one();
        }
        drop(samples);
        self.0.landed.notify_one();
    }
}
