//! The acknowledgements of a peer, on their way to the outbound task: one entry for each stream, however
//! many messages the peer sends.

use std::{
    collections::HashMap,
    sync::{Arc, Mutex},
};

use tokio::sync::Notify;

use crate::{gateway::keyring::lock, ids::Gid, link::ReceivedOf};

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
    /// Streams whose samples are acknowledged, and up to which number they are.
    awaited: HashMap<Key, u64>,
    /// Acknowledgements that the outbound task has not taken up yet.
    due: HashMap<Key, Acknowledgement>,
}

/// What was acknowledged of one stream since it was taken up last.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Acknowledgement {
    /// Samples up to this number.
    pub(super) sequence: u64,
    /// But for so many, which the peer dropped.
    pub(super) dropped: u64,
}

/// Held by a stream whose samples are acknowledged. There is one at a time of each key.
pub(super) struct Awaited {
    of: Key,
    at: Arc<Acknowledged>,
}

impl Acknowledged {
    /// Notes what the peer says, and wakes the outbound task. What is of no stream is ignored.
    pub(in crate::gateway) fn note(&self, flows: &[ReceivedOf]) {
        let mut noted = lock(&self.noted);
        let Noted { awaited, due } = &mut *noted;
        let first = due.is_empty();
        for ReceivedOf { route, publisher, sequence, dropped } in flows {
            let key = (*route, *publisher);
            if let Some(last) = awaited.get_mut(&key) {
                let due = due.entry(key).or_default();
                // Of samples that this acknowledges, not of those of an entry that it is added to.
                due.dropped += (*dropped).min(sequence.saturating_sub(*last));
                *last = (*last).max(*sequence);
                due.sequence = due.sequence.max(*sequence);
            }
        }
        if first && !due.is_empty() {
            self.some.notify_one();
        }
    }

    /// Acknowledgements of this stream are noted from now on.
    pub(super) fn await_of(self: &Arc<Self>, route: u32, of: Gid) -> Awaited {
        lock(&self.noted).awaited.insert((route, of), 0);
        Awaited { of: (route, of), at: Arc::clone(self) }
    }

    /// Takes up what was noted.
    pub(super) fn take(&self) -> HashMap<Key, Acknowledgement> {
        std::mem::take(&mut lock(&self.noted).due)
    }

    /// Waits until something is noted.
    pub(super) async fn noted(&self) {
        self.some.notified().await;
    }
}

impl Drop for Awaited {
    fn drop(&mut self) {
        let mut noted = lock(&self.at.noted);
        noted.awaited.remove(&self.of);
        noted.due.remove(&self.of);
    }
}

#[cfg(test)]
mod tests {
    use std::{
        pin::pin,
        task::{Context, Waker},
    };

    use super::*;

    fn flow(route: u32, publisher: u8, sequence: u64, dropped: u64) -> ReceivedOf {
        ReceivedOf { route, publisher: Gid([publisher; 16]), sequence, dropped }
    }

    #[test]
    fn what_a_peer_acknowledges_takes_one_entry_a_stream_and_one_wake() {
        let acknowledged = Arc::new(Acknowledged::default());
        let stream = acknowledged.await_of(1, Gid([1; 16]));
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
        let all = Acknowledgement { sequence: 1000, dropped: 1000 };
        assert_eq!(due, HashMap::from([((1, Gid([1; 16])), all)]));

        acknowledged.note(&[flow(1, 1, 1001, 0)]);
        drop(stream);
        acknowledged.note(&[flow(1, 1, 1002, 0)]);
        assert!(acknowledged.take().is_empty(), "the stream is gone");
    }
}
