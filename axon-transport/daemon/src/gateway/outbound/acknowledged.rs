//! Applies a peer's acknowledgements to the queues of samples sent to it. The results wait for the outbound
//! task: one entry for each stream, however many messages the peer sends.

use std::{
    collections::HashMap,
    sync::{Arc, Mutex},
};

use axon_shm::ids::Gid;
use tokio::sync::Notify;

use crate::{
    gateway::{keyring::lock, queue::Queue},
    link::ReceivedOf,
};

/// A route and a publisher, or client.
type Key = (u32, Gid);

/// The acknowledgements of one peer.
#[derive(Default)]
pub(in crate::gateway) struct Acknowledged {
    noted: Mutex<Noted>,
    some: Notify,
}

#[derive(Default)]
struct Noted {
    /// Streams whose samples are acknowledged.
    awaited: HashMap<Key, Arc<Mutex<Queue>>>,
    /// Acknowledgements that the outbound task has not taken up yet.
    due: HashMap<Key, Acknowledgement>,
}

/// What was acknowledged of one stream since it was taken up last.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Acknowledgement {
    /// Samples up to this number.
    pub(super) sequence: u64,
    /// So many of them were sent.
    pub(super) samples: u64,
    /// So many of these the peer dropped.
    pub(super) dropped: u64,
}

/// Held by a stream whose samples are acknowledged. There is one at a time of each key.
pub(super) struct Awaited {
    of: Key,
    at: Arc<Acknowledged>,
}

impl Acknowledged {
    /// Takes what the peer acknowledges out of the queues, and wakes the outbound task. The rest of what
    /// it says is ignored: samples that were not sent to it, and more drops than samples.
    pub(in crate::gateway) fn note(&self, flows: &[ReceivedOf]) {
        let mut noted = lock(&self.noted);
        let Noted { awaited, due } = &mut *noted;
        let first = due.is_empty();
        for ReceivedOf { route, publisher, sequence, dropped } in flows {
            let key = (*route, *publisher);
            if let Some(queue) = awaited.get(&key)
                && let (samples, Some(newest)) = lock(queue).acknowledge(*sequence)
            {
                let due = due.entry(key).or_default();
                due.sequence = due.sequence.max(newest);
                due.samples += samples;
                due.dropped += samples.min(*dropped);
            }
        }
        if first && !due.is_empty() {
            self.some.notify_one();
        }
    }

    /// Acknowledgements of this stream are held against its queue from now on.
    pub(super) fn await_of(
        self: &Arc<Self>,
        route: u32,
        of: Gid,
        queue: &Arc<Mutex<Queue>>,
    ) -> Awaited {
        lock(&self.noted).awaited.insert((route, of), Arc::clone(queue));
        Awaited { of: (route, of), at: Arc::clone(self) }
    }

    /// Takes up what was noted.
    pub(super) fn take(&self) -> HashMap<Key, Acknowledgement> {
        std::mem::take(&mut lock(&self.noted).due)
    }

    /// A route is over: nothing more comes of what was noted for it.
    pub(super) fn forget(&self, route: u32) {
        lock(&self.noted).due.retain(|(of, _), _| *of != route);
    }

    /// Waits until something is noted.
    pub(super) async fn noted(&self) {
        self.some.notified().await;
    }
}

impl Drop for Awaited {
    fn drop(&mut self) {
        lock(&self.at.noted).awaited.remove(&self.of);
    }
}

#[cfg(test)]
mod tests {
    use std::{
        collections::VecDeque,
        pin::pin,
        task::{Context, Waker},
    };

    use bytes::Bytes;

    use super::*;
    use crate::gateway::{
        queue::{Offered, Sample},
        queue_budget::QueueBudget,
    };
    use axon_shm::qos::Qos;
    use axon_transport::MessageInfo;

    fn flow(route: u32, publisher: u8, sequence: u64, dropped: u64) -> ReceivedOf {
        ReceivedOf { route, publisher: Gid([publisher; 16]), sequence, dropped }
    }

    /// The queue of a stream with these samples.
    fn queue(numbers: std::ops::RangeInclusive<u64>) -> Arc<Mutex<Queue>> {
        let queue = Queue::new(&Qos::keep_all(), QueueBudget::new(1 << 30).of_peer(), true);
        let queue = Arc::new(Mutex::new(queue));
        numbers.for_each(|number| offer(&queue, number));
        queue
    }

    fn offer(queue: &Mutex<Queue>, sequence: u64) {
        let info = MessageInfo::of(Gid([1; 16]), sequence);
        let since = std::time::Instant::now();
        let offered =
            lock(queue).offer(Sample { info, client: None, payload: Bytes::new(), since });
        assert!(matches!(offered, Offered::Queued { dropped: 0 }));
    }

    fn send(queue: &Mutex<Queue>) {
        lock(queue).pop_together(usize::MAX, &mut VecDeque::new());
    }

    #[test]
    fn what_a_peer_acknowledges_takes_one_entry_a_stream_and_one_wake() {
        let acknowledged = Arc::new(Acknowledged::default());
        let queue = queue(1..=1001);
        send(&queue);
        let stream = acknowledged.await_of(1, Gid([1; 16]), &queue);
        let is_woken = || {
            let woken = pin!(acknowledged.noted());
            woken.poll(&mut Context::from_waker(Waker::noop())).is_ready()
        };
        acknowledged.note(&[flow(2, 1, 9, 9), flow(1, 2, 9, 9)]);
        assert!(!is_woken(), "there are no such streams");
        for sequence in 1..=1000 {
            let others = (0..100).map(|route| flow(100 + route, 1, sequence, 1));
            let of_stream = [flow(1, 1, sequence, 1), flow(1, 1, sequence - 1, u64::MAX / 3)];
            acknowledged.note(&others.chain(of_stream).collect::<Vec<_>>());
        }
        assert!(is_woken() && !is_woken());
        let due = acknowledged.take();
        // One for each number: what is said again of samples that are acknowledged adds nothing.
        let all = Acknowledgement { sequence: 1000, samples: 1000, dropped: 1000 };
        assert_eq!(due, HashMap::from([((1, Gid([1; 16])), all)]));

        // What was noted counts though the stream, with nothing left to send, is gone: until the route is.
        acknowledged.note(&[flow(1, 1, 1001, 0)]);
        drop(stream);
        acknowledged.note(&[flow(1, 1, 1002, 0)]);
        acknowledged.forget(2);
        assert_eq!(lock(&acknowledged.noted).due.len(), 1);
        acknowledged.forget(1);
        assert!(acknowledged.take().is_empty());
    }

    #[test]
    fn an_acknowledgement_before_its_sample_was_sent_takes_nothing_from_the_next_one() {
        let acknowledged = Arc::new(Acknowledged::default());
        let (queue, of) = (queue(1..=2), Gid([1; 16]));
        let _stream = acknowledged.await_of(1, of, &queue);
        acknowledged.note(&[flow(1, 1, 2, u64::MAX)]);
        assert!(acknowledged.take().is_empty());
        send(&queue);
        acknowledged.note(&[flow(1, 1, 2, u64::MAX)]);
        let dropped = Acknowledgement { sequence: 2, samples: 2, dropped: 2 };
        assert_eq!(acknowledged.take().get(&(1, of)), Some(&dropped));
    }
}
