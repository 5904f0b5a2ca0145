//! The session's own memory: announces new and closed segments to the daemon, and frees unused memory.

use std::time::{Duration, Instant};

use super::Control;
use crate::{
    session::core::SegmentChange,
    wire::session::{SegmentName, SegmentOpened, SessionMessage},
};

/// How often the memory of large samples is looked after.
const TEND: Duration = Duration::from_secs(1);

impl Control {
    /// Takes what changed in the session's memory, and what its readers lack of others'.
    pub(super) fn tell_segments(&mut self) {
        for number in self.segments.untold() {
            self.tell_segment(SegmentChange::Opened(number));
        }
        for change in self.shared.core.memory.take() {
            self.tell_segment(change);
        }
    }

    pub(super) fn tell_segment(&mut self, change: SegmentChange) {
        let session = self.shared.core.id;
        match change {
            // Found here and noted there.
            SegmentChange::Opened(number) if self.segments.is_told(number) => {}
            SegmentChange::Opened(number) => match self.shared.core.segment.segment(number) {
                Ok(Some((info, descriptor))) => {
                    self.segments.tell(number);
                    let opened = SegmentOpened { session, segment: info.into() };
                    self.outbox
                        .push_back((SessionMessage::Segment(opened), vec![descriptor.into()]));
                }
                // It is gone again.
                Ok(None) => self.segments.remove(number),
                Err(error) => {
                    if self.segments.fail(number) {
                        tracing::error!(
                            %error,
                            "no free file descriptor: new samples stay invisible to other processes until one is free"
                        );
                    }
                }
            },
            SegmentChange::Gone(number) => {
                self.segments.remove(number);
                let gone = SegmentName { session, number };
                self.outbox.push_back((SessionMessage::SegmentGone(gone), Vec::new()));
            }
            SegmentChange::Low(gid) => {
                self.low.insert(gid);
            }
            SegmentChange::Wanted(session) => {
                for number in self.peers.take_wanted(&session) {
                    let need = SegmentName { session, number };
                    self.outbox.push_back((SessionMessage::Need(need), Vec::new()));
                }
            }
        }
    }

    /// Has memory ready for those that publish large samples.
    pub(super) fn prepare(&mut self) {
        for gid in std::mem::take(&mut self.low) {
            let publisher = self.shared.state().endpoints.publishers.get(&gid).cloned();
            if let Some(publisher) = publisher {
                // What lacks then, its next publish says.
                publisher.rings.prepare();
                self.look_after_memory();
            }
        }
    }

    /// There is memory that may have to be given back.
    pub(super) fn look_after_memory(&mut self) {
        self.reclaim_idle.get_or_insert_with(|| Instant::now() + TEND);
    }

    /// Looks after the memory of large samples and of publishers that are gone. Memory that is given up may have to be opened anew,
    /// and only a daemon can say so to the readers: so not while there is none.
    pub(super) fn reclaim_idle(&mut self) {
        let now = Instant::now();
        if !self.is_linked() || self.reclaim_idle.is_none_or(|due| now < due) {
            return;
        }
        let publishers: Vec<_> =
            self.shared.state().endpoints.publishers.values().cloned().collect();
        let more = publishers.iter().filter(|publisher| publisher.rings.reclaim_idle(now)).count();
        let more = self.shared.core.segment.tidy() || more > 0;
        self.reclaim_idle = more.then(|| now + TEND);
    }
}
