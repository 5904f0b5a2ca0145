//! The session's own memory: announces new and closed segments to the daemon, and frees unused memory.

use std::{
    collections::BTreeSet,
    sync::Arc,
    time::{Duration, Instant},
};

use super::{Outbox, announced::AnnouncedSegments, peers::Peers};
use crate::{
    ids::Gid,
    session::{core::SegmentChange, state::SessionShared},
    wire::session::{SegmentName, SegmentOpened, SessionMessage},
};

/// The time between two checks of the memory of large samples.
const CHECK_INTERVAL: Duration = Duration::from_secs(1);

/// The segments of the session's own memory.
pub(super) struct AnnouncedMemory {
    shared: Arc<SessionShared>,
    /// The segments that were sent over this connection.
    announced: AnnouncedSegments,
    /// Publishers without prepared memory for their next large sample.
    low: BTreeSet<Gid>,
    /// The time of the next check of the memory of large samples. `None` if no check is scheduled.
    check: Option<Instant>,
}

impl AnnouncedMemory {
    /// Creates the memory of a session that has announced no segments.
    pub(super) fn new(shared: Arc<SessionShared>) -> Self {
        Self { shared, announced: AnnouncedSegments::default(), low: BTreeSet::new(), check: None }
    }

    /// Announces all segments to a new daemon.
    pub(super) fn handle_connected(&mut self, outbox: &mut Outbox, peers: &Peers) {
        self.announced = AnnouncedSegments::default();
        self.shared.core.memory.begins_anew();
        for info in self.shared.core.segment.segments() {
            self.handle_change(SegmentChange::Opened(info.number), outbox, peers);
        }
    }

    /// Returns whether the daemon was sent all segments.
    pub(super) fn is_announced(&self) -> bool {
        self.announced.are_complete()
    }

    /// Announces changes of the session's memory, and requests segments of other sessions that readers lack.
    pub(super) fn announce(&mut self, outbox: &mut Outbox, peers: &Peers) {
        for number in self.announced.untold() {
            self.handle_change(SegmentChange::Opened(number), outbox, peers);
        }
        for change in self.shared.core.memory.take() {
            self.handle_change(change, outbox, peers);
        }
    }

    fn handle_change(&mut self, change: SegmentChange, outbox: &mut Outbox, peers: &Peers) {
        let session = self.shared.core.id;
        match change {
            // Both the list of segments and the list of changes have it.
            SegmentChange::Opened(number) if self.announced.is_told(number) => {}
            SegmentChange::Opened(number) => match self.shared.core.segment.segment(number) {
                Ok(Some((info, descriptor))) => {
                    self.announced.tell(number);
                    let opened = SegmentOpened { session, segment: info.into() };
                    outbox.push_back((SessionMessage::Segment(opened), vec![descriptor.into()]));
                }
                // The segment is already closed.
                Ok(None) => self.announced.remove(number),
                Err(error) => {
                    if self.announced.fail(number) {
                        tracing::error!(
                            %error,
                            "no free file descriptor: new samples stay invisible to other processes until one is free"
                        );
                    }
                }
            },
            SegmentChange::Gone(number) => {
                self.announced.remove(number);
                let gone = SegmentName { session, number };
                outbox.push_back((SessionMessage::SegmentGone(gone), Vec::new()));
            }
            SegmentChange::Low(gid) => {
                self.low.insert(gid);
            }
            SegmentChange::Wanted(session) => {
                for number in peers.take_wanted(&session) {
                    let need = SegmentName { session, number };
                    outbox.push_back((SessionMessage::Need(need), Vec::new()));
                }
            }
        }
    }

    /// Prepares memory for publishers of large samples.
    pub(super) fn prepare(&mut self) {
        for gid in std::mem::take(&mut self.low) {
            let publisher = self.shared.state().endpoints.publishers.get(&gid).cloned();
            if let Some(publisher) = publisher {
                // The publisher's next publish detects memory that is still missing.
                publisher.rings.prepare();
                self.check_later();
            }
        }
    }

    /// Schedules a check of the memory, because some of it may have to be freed.
    pub(super) fn check_later(&mut self) {
        self.check.get_or_insert_with(|| Instant::now() + CHECK_INTERVAL);
    }

    /// Returns when [`handle_timeout`](Self::handle_timeout) is due.
    pub(super) fn poll_timeout(&self) -> Option<Instant> {
        self.check
    }

    /// Frees idle memory of large samples and memory of ended publishers, if the check is due. The session must be
    /// linked: freed memory may have to be opened again, and only a daemon can announce it to readers.
    pub(super) fn handle_timeout(&mut self) {
        let now = Instant::now();
        if self.check.is_none_or(|due| now < due) {
            return;
        }
        let (publishers, _) = self.shared.state().endpoints.all();
        let more = publishers.iter().filter(|publisher| publisher.rings.reclaim_idle(now)).count();
        let more = self.shared.core.segment.tidy() || more > 0;
        self.check = more.then(|| now + CHECK_INTERVAL);
    }
}
