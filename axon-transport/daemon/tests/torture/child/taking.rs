//! Takes samples, holds some of them for a while, and notes what is missing.

use std::{
    collections::{HashMap, VecDeque},
    sync::atomic::Ordering,
    time::{Duration, Instant},
};

use axon_shm::Sample;
use axon_transport::{MessageInfo, Subscription};

use super::{Child, Kind, stamp};
use crate::sample::{Random, is_whole};

/// Maximum number of samples that a subscription holds.
const HELD: usize = 4;
/// Maximum time for which it holds one, in milliseconds.
const HOLD_MS: u64 = 2000;

impl Child {
    pub(super) fn take_all(&self, subscription: &Subscription, gapless: bool, random: &mut Random) {
        let mut last = HashMap::new();
        let mut held: VecDeque<(Instant, MessageInfo, Sample)> = VecDeque::new();
        let mut bytes = Vec::new();
        let mut all_missed = 0;
        while !self.over.load(Ordering::Relaxed) {
            let ready = || subscription.has_data() || self.over.load(Ordering::Relaxed);
            self.session.wait(ready, Some(Duration::from_millis(50)));
            // A held sample must be unchanged when the publisher is far ahead of it.
            let now = Instant::now();
            while held.len() > HELD || held.front().is_some_and(|(until, ..)| *until <= now) {
                let (_, info, sample) = held.pop_front().expect("just looked");
                check(&info, &sample);
            }
            let info = if random.below(2) == 0 {
                let Some(info) = subscription.take(&mut bytes) else { continue };
                assert!(is_whole(stamp(info.publisher), info.sequence, 0, &bytes), "{info:?}");
                info
            } else {
                let Some((info, sample)) = subscription.take_sample() else { continue };
                check(&info, &sample);
                if random.below(4) == 0 {
                    let hold = Duration::from_millis(random.below(HOLD_MS));
                    held.push_back((now + hold, info, sample));
                }
                info
            };
            if let Some(before) = last.insert(info.publisher, info.sequence) {
                assert!(info.sequence > before, "{info:?} after {before}");
                let missed = info.sequence - before - 1;
                if gapless && missed > 0 {
                    all_missed += missed;
                    // Losses of publishers that were never met left no gap.
                    let unmet = self.pair_log.unmet(&self.gapless, None).unwrap_or(0);
                    let lost = subscription.lost().saturating_sub(unmet);
                    let counted = all_missed <= lost;
                    // Each miss that is not counted is reported once.
                    all_missed = all_missed.min(lost);
                    // A publisher does not wait for subscriptions of its own session.
                    if !info.publisher.is_of(&self.session.id()) {
                        self.missed(Kind::Sample { counted }, &info, missed);
                    }
                }
            }
            self.taken.fetch_add(1, Ordering::Relaxed);
            if gapless {
                self.last.lock().expect("no panic").insert(info.publisher, info.sequence);
                // Wakes the thread that waits for the last sample of all publishers.
                self.session.segment().notify();
            }
        }
    }
}

fn check(info: &MessageInfo, sample: &Sample) {
    let mut piece = vec![0; (64 << 10).min(sample.len())];
    let mut at = 0;
    while at < sample.len() {
        let read = sample.read_at(at, &mut piece);
        assert!(is_whole(stamp(info.publisher), info.sequence, at, &piece[..read]), "{info:?}");
        at += read;
    }
}
