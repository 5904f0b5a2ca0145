//! What readers that stand for others, elsewhere, have taken over.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use super::Writer;
use crate::shm::PeerSession;

impl Writer {
    /// Waits until all that was published so far has been handed to those who carry it elsewhere;
    /// whether it has. One that has ended carries nothing, so nothing is waited for.
    pub(crate) fn wait_handed_over(&self, timeout: Duration) -> bool {
        if self.is_forked() {
            return true;
        }
        let end = Instant::now().checked_add(timeout);
        let published = self.lock().history.head();
        loop {
            let relays = {
                let mut state = self.lock();
                state.audience.mark_dead();
                if state.audience.handed_over(published) >= published {
                    return true;
                }
                state.audience.relays()
            };
            let left =
                end.map_or(Duration::MAX, |end| end.saturating_duration_since(Instant::now()));
            if left.is_zero() {
                return false;
            }
            self.await_handover(published, &relays, left);
        }
    }

    fn await_handover(&self, published: u64, relays: &[Arc<PeerSession>], left: Duration) {
        let ready = || {
            self.lock().audience.handed_over(published) >= published
                || relays.iter().any(|peer| peer.is_dead())
        };
        let pidfds: Vec<_> = relays.iter().map(|peer| peer.pidfd()).collect();
        self.session.wait_for_room(ready, &pidfds, left);
    }
}
