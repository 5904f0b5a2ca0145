//! Memory of sessions that ended soon after this daemon's start, when their readers may not have come back yet.
//!
//! When a daemon is killed, a session may open a segment that no daemon passes on. The session reports it to the next
//! daemon, and may end before its readers have come back and met it there. A new daemon keeps such a session's segments
//! for a while, and sends them to readers that ask.

use std::collections::VecDeque;

use super::super::memory::{OwnMemory, RegisteredSegment};
use crate::ids::SessionId;

/// The segments of sessions that ended.
#[derive(Debug)]
pub(super) struct RetainedMemory<F> {
    /// Most segments that are kept. The daemon holds a descriptor for each.
    most: usize,
    /// In the order in which the sessions ended.
    sessions: VecDeque<(SessionId, OwnMemory<F>)>,
}

impl<F> Default for RetainedMemory<F> {
    fn default() -> Self {
        Self::new(0)
    }
}

impl<F> RetainedMemory<F> {
    /// Creates memory that keeps up to `most` segments.
    pub(super) fn new(most: usize) -> Self {
        Self { most, sessions: VecDeque::new() }
    }

    pub(super) fn is_kept(&self) -> bool {
        self.most > 0
    }

    /// Keeps the segments of a session that ended.
    pub(super) fn keep(&mut self, id: SessionId, segments: OwnMemory<F>) {
        if segments.is_empty() || segments.len() > self.most {
            return;
        }
        self.forget(&id);
        self.sessions.push_back((id, segments));
        while self.sessions.iter().map(|(_, segments)| segments.len()).sum::<usize>() > self.most {
            self.sessions.pop_front();
        }
    }

    /// Drops the segments of a session that has come back.
    pub(super) fn forget(&mut self, id: &SessionId) {
        self.sessions.retain(|(left, _)| left != id);
    }

    pub(super) fn segment(&self, of: &SessionId, number: u32) -> Option<&RegisteredSegment<F>> {
        let (_, segments) = self.sessions.iter().find(|(id, _)| id == of)?;
        segments.get(number)
    }
}

#[cfg(test)]
mod tests {
    use axon_shm::internal::Location;

    use super::*;
    use crate::{
        graph::{Endpoint, EndpointKind},
        ids::Gid,
        registry::Registry,
        wire::session::{
            Announce, EndpointRole, Segment, SegmentName, SegmentOpened, SessionMessage,
            SessionRole,
        },
    };

    const MOST: usize = 4;
    const WRITER: u8 = 1;
    const READER: u8 = 2;

    fn id(number: u8) -> SessionId {
        SessionId([number; 16])
    }

    /// Returns a registry with two sessions whose daemon was killed and that have connected to this one.
    fn registry() -> Registry<&'static str> {
        let mut registry = Registry::default();
        registry.keep_left_memory(MOST);
        [WRITER, READER].into_iter().for_each(|session| connect(&mut registry, session));
        taken(&mut registry);
        registry
    }

    fn connect(registry: &mut Registry<&'static str>, session: u8) {
        let handed = Some(["segment", "doorbell", "pidfd"]);
        let (role, name) = (SessionRole::Application, String::new());
        registry.handle_connect(id(session), role, name, 1, handed, None).unwrap();
    }

    fn open(registry: &mut Registry<&'static str>, session: u8, number: u32) {
        let opened =
            SegmentOpened { session: id(session), segment: Segment { number, publisher: None } };
        registry
            .handle_message(&id(session), SessionMessage::Segment(opened), vec!["map"])
            .unwrap();
    }

    fn need(registry: &mut Registry<&'static str>, number: u32) {
        let need = SessionMessage::Need(SegmentName { session: id(WRITER), number });
        registry.handle_message(&id(READER), need, vec![]).unwrap();
    }

    /// Returns the segments that the reader was sent.
    fn taken(registry: &mut Registry<&'static str>) -> Vec<u32> {
        let packets = std::iter::from_fn(|| registry.poll_output(&id(READER)));
        let segments =
            packets.filter_map(|output| match SessionMessage::decode(&output.packet).unwrap() {
                SessionMessage::Segment(opened) => {
                    assert_eq!(output.descriptors, ["map"]);
                    Some(opened.segment.number)
                }
                _ => None,
            });
        segments.collect()
    }

    #[test]
    fn a_returning_reader_is_handed_the_memory_of_an_ended_session() {
        let mut registry = registry();
        open(&mut registry, WRITER, 1);
        need(&mut registry, 1);
        assert_eq!(taken(&mut registry), [1], "its session is there");
        registry.handle_disconnect(&id(WRITER));
        need(&mut registry, 1);
        need(&mut registry, 2);
        assert_eq!(taken(&mut registry), [1], "its session has ended");
        registry.keep_left_memory(0);
        need(&mut registry, 1);
        assert_eq!(taken(&mut registry), [0; 0]);
    }

    #[test]
    fn without_retention_a_session_leaves_and_hands_out_no_memory() {
        let mut registry = registry();
        registry.keep_left_memory(0);
        open(&mut registry, WRITER, 1);
        need(&mut registry, 1);
        registry.handle_disconnect(&id(WRITER));
        need(&mut registry, 1);
        assert_eq!(taken(&mut registry), [0; 0]);
    }

    #[test]
    fn the_segments_of_the_session_that_ended_first_make_room() {
        let mut registry = registry();
        connect(&mut registry, 3);
        open(&mut registry, WRITER, 1);
        (0..MOST as u32).for_each(|number| open(&mut registry, 3, 1 + number));
        registry.handle_disconnect(&id(WRITER));
        need(&mut registry, 1);
        assert_eq!(taken(&mut registry), [1]);
        registry.handle_disconnect(&id(3));
        need(&mut registry, 1);
        assert_eq!(taken(&mut registry), [0; 0]);
    }

    #[test]
    fn a_session_that_comes_back_and_gives_memory_up_has_left_none() {
        let mut registry = registry();
        open(&mut registry, WRITER, 1);
        registry.handle_disconnect(&id(WRITER));
        connect(&mut registry, WRITER);
        need(&mut registry, 1);
        assert_eq!(taken(&mut registry), [0; 0]);
    }

    #[test]
    fn a_reader_reconnecting_late_is_told_of_the_ended_publisher() {
        let mut registry = registry();
        let gid = Gid::new(id(WRITER), 1);
        let endpoint = Endpoint::example(gid, EndpointKind::Publisher);
        let (role, ring) = (EndpointRole::Application, Some(Location { segment: 0, offset: 4096 }));
        let announce = Announce { endpoint, role, stands_for: Vec::new(), ring, only: None };
        registry.handle_message(&id(WRITER), SessionMessage::Endpoint(announce), vec![]).unwrap();
        registry.flush();
        registry.handle_disconnect(&id(WRITER));
        registry.flush();
        connect(&mut registry, 3);
        let packets = std::iter::from_fn(|| registry.poll_output(&id(3)));
        let ended =
            packets.filter_map(|output| match SessionMessage::decode(&output.packet).unwrap() {
                SessionMessage::Graph(graph) => graph.ended,
                _ => None,
            });
        assert_eq!(ended.flatten().collect::<Vec<_>>(), [gid]);
    }
}
