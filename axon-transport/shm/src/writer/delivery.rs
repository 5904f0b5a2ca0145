//! Delivery watermarks of relays and the number of samples they gave up; `wait_acknowledged` uses both.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use super::{Writer, WriterState};
use crate::{ids::Gid, ring::types::Grant, session::peer::PeerSession};

impl Writer {
    /// Returns the number up to which all published samples have been handed to the carriers.
    pub fn delivered_up_to(&self) -> u64 {
        let mut state = self.lock();
        let WriterState { history, reader_set, .. } = &mut *state;
        let position = reader_set.delivered_up_to(history.head());
        state.number_before(position)
    }

    /// Waits for at most `timeout` until the carriers have delivered or given up all samples published so far. Returns
    /// false if the time is over, and once after samples were given up.
    pub fn wait_handed_over(&self, timeout: Duration) -> bool {
        if self.is_forked() {
            return true;
        }
        let end = Instant::now().checked_add(timeout);
        let published = self.lock().history.head();
        loop {
            let (relays, absent) = {
                let mut state = self.lock();
                let WriterState { history, reader_set, known_given_up, .. } = &mut *state;
                reader_set.mark_dead(history.head());
                // In this order: samples that count as handed over because they were given up are counted by then.
                let delivered_up_to = reader_set.delivered_up_to(published) >= published;
                let given_up = reader_set.given_up(history.head());
                if std::mem::replace(known_given_up, given_up) != given_up {
                    return false;
                }
                if delivered_up_to {
                    return true;
                }
                (reader_set.relays(), reader_set.absent_for())
            };
            let left =
                end.map_or(Duration::MAX, |end| end.saturating_duration_since(Instant::now()));
            if left.is_zero() {
                return false;
            }
            let left = left.min(absent.unwrap_or(Duration::MAX));
            self.await_handover(published, &relays, left);
        }
    }

    /// Returns whether a KEEP_ALL reader of another session has samples to take and has not taken up its grant, which
    /// may not have reached it.
    pub fn expects_readers(&self) -> bool {
        if self.is_forked() {
            return false;
        }
        let state = self.lock();
        state.reader_set.expects_readers(state.history.head())
    }

    /// Returns the readers of other sessions that have not taken up their grant, and the number of samples for each.
    pub fn unmet(&self) -> Vec<(Gid, u64)> {
        if self.is_forked() {
            return Vec::new();
        }
        let state = self.lock();
        state.reader_set.unmet(state.history.head())
    }

    /// Returns the grants that readers of other sessions have not taken up, each with the number in front of its first
    /// sample.
    pub fn untaken_grants(&self) -> Vec<(Gid, Grant, u64)> {
        if self.is_forked() {
            return Vec::new();
        }
        let state = self.lock();
        let untaken_grants = state.reader_set.untaken_grants().into_iter();
        untaken_grants.map(|(gid, grant)| (gid, grant, state.number_before(grant.first))).collect()
    }

    /// Returns the number of samples that the carriers have neither delivered nor given up.
    pub fn under_way(&self) -> u64 {
        if self.is_forked() {
            return 0;
        }
        let mut state = self.lock();
        let WriterState { history, reader_set, .. } = &mut *state;
        let head = history.head();
        reader_set.mark_dead(head);
        head.saturating_sub(reader_set.delivered_up_to(head))
    }

    /// Returns the number of samples that the carriers gave up.
    pub fn given_up(&self) -> u64 {
        if self.is_forked() {
            return 0;
        }
        let mut state = self.lock();
        let WriterState { history, reader_set, .. } = &mut *state;
        reader_set.given_up(history.head())
    }

    /// Counts samples that a carrier reports as given up.
    pub fn give_up(&self, reader: Gid, samples: u64) {
        if !self.is_forked() {
            let mut state = self.lock();
            let WriterState { history, reader_set, .. } = &mut *state;
            reader_set.give_up(reader, samples, history.head());
        }
    }

    fn await_handover(&self, published: u64, relays: &[Arc<PeerSession>], left: Duration) {
        let ready = || {
            let mut state = self.lock();
            let WriterState { history, reader_set, known_given_up, .. } = &mut *state;
            reader_set.delivered_up_to(published) >= published
                || reader_set.given_up(history.head()) != *known_given_up
                || relays.iter().any(|peer| peer.is_dead())
        };
        let pidfds: Vec<_> = relays.iter().map(|peer| peer.pidfd()).collect();
        self.session.wait_for_room(ready, &pidfds, left);
    }
}
