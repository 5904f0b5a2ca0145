//! FENCE: tells a session that all its messages about a publisher were sent to the readers that must not lose a
//! sample.
//!
//! A relayed publisher's process keeps a sample until the daemon confirms it. The sample is then in the daemon's
//! memory. A reader can read that memory after the daemon was killed, but only if the daemon had sent it the
//! descriptors of the memory, and its grant.

use super::sessions::Sessions;
use crate::{
    ids::{Gid, SessionId},
    wire::session::Fence,
};

/// A FENCE that is not answered yet.
#[derive(Debug)]
struct FenceRequest {
    /// The session that asked.
    by: SessionId,
    fence: Fence,
    /// The sessions of readers that have not been sent everything yet. Each has the number of the last packet that it
    /// must be sent; `None` while it is sent the complete state.
    readers: Vec<(SessionId, Option<u64>)>,
}

/// The FENCEs that are not answered yet, at most one for each publisher.
#[derive(Debug, Default)]
pub(super) struct Fences(Vec<FenceRequest>);

impl Fences {
    pub(super) fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Adds the FENCE of session `by` for the readers of its publisher. It replaces an earlier one for the same
    /// publisher.
    pub(super) fn ask<F>(
        &mut self,
        by: SessionId,
        fence: Fence,
        readers: Vec<SessionId>,
        sessions: &Sessions<F>,
    ) {
        let mark = |id: &SessionId| sessions.get(id).and_then(|entry| entry.outbox.mark());
        let readers = readers.into_iter().map(|reader| (reader, mark(&reader))).collect();
        self.forget(&fence.writer);
        self.0.push(FenceRequest { by, fence, readers });
    }

    /// Removes the FENCE of a publisher that is gone.
    pub(super) fn forget(&mut self, writer: &Gid) {
        self.0.retain(|asked| asked.fence.writer != *writer);
    }

    /// Takes the FENCEs for which everything has been sent. A session that has ended delays no FENCE.
    pub(super) fn take_answered<F>(&mut self, sessions: &Sessions<F>) -> Vec<(SessionId, Fence)> {
        let waits = |(reader, mark): &mut (SessionId, Option<u64>)| {
            sessions.get(reader).is_some_and(|entry| !entry.outbox.was_sent(mark))
        };
        self.0.iter_mut().for_each(|asked| asked.readers.retain_mut(waits));
        let answered = self.0.extract_if(.., |asked| asked.readers.is_empty());
        answered.map(|asked| (asked.by, asked.fence)).collect()
    }
}

#[cfg(test)]
mod tests {
    use axon_shm::internal::Location;

    use super::*;
    use crate::{
        graph::{Endpoint, EndpointKind},
        qos::Qos,
        registry::{MAX_QUEUE, Registry, Violation},
        wire::session::{
            Announce, EndpointRole, Gone, Segment, SegmentOpened, SessionMessage, SessionRole,
        },
    };

    const WRITER: u8 = 1;
    const KEEPS: u8 = 2;
    const KEEPS_LAST: u8 = 3;

    fn id(number: u8) -> SessionId {
        SessionId([number; 16])
    }

    fn gid(session: u8) -> Gid {
        Gid::new(id(session), 1)
    }

    /// Returns a registry with a KEEP_ALL publisher, a KEEP_ALL subscription, and a KEEP_LAST one.
    fn registry() -> Registry<&'static str> {
        let mut registry = Registry::default();
        for (session, kind, qos) in [
            (WRITER, EndpointKind::Publisher, Qos::keep_all()),
            (KEEPS, EndpointKind::Subscription, Qos::keep_all()),
            (KEEPS_LAST, EndpointKind::Subscription, Qos::default()),
        ] {
            let handed = Some(["segment", "doorbell", "pidfd"]);
            let (role, name) = (SessionRole::Application, String::new());
            registry.handle_connect(id(session), role, name, 1, handed, None).unwrap();
            let endpoint = Endpoint { qos, ..Endpoint::example(gid(session), kind) };
            let ring = (session == WRITER).then_some(Location { segment: 0, offset: 4096 });
            let (role, stands_for) = (EndpointRole::Application, Vec::new());
            let announce = Announce { endpoint, role, stands_for, ring, only: None };
            registry
                .handle_message(&id(session), SessionMessage::Endpoint(announce), vec![])
                .unwrap();
        }
        [WRITER, KEEPS, KEEPS_LAST].iter().for_each(|session| drop(take(&mut registry, *session)));
        registry
    }

    fn take(registry: &mut Registry<&'static str>, session: u8) -> Vec<SessionMessage> {
        let taken = std::iter::from_fn(|| registry.poll_output(&id(session)));
        let taken = taken.map(|output| SessionMessage::decode(&output.packet).unwrap()).collect();
        registry.answer_fences();
        taken
    }

    fn ask(registry: &mut Registry<&'static str>, number: u64) {
        let fence = Fence { writer: gid(WRITER), number };
        registry.handle_message(&id(WRITER), SessionMessage::Fence(fence), vec![]).unwrap();
    }

    /// Returns the numbers of the answered FENCEs.
    fn answers(registry: &mut Registry<&'static str>) -> Vec<u64> {
        let answers = take(registry, WRITER).into_iter().filter_map(|message| match message {
            SessionMessage::Fence(fence) => Some(fence.number),
            _ => None,
        });
        answers.collect()
    }

    fn say(registry: &mut Registry<&'static str>, to: u8) {
        registry.push(&id(to), &SessionMessage::Resync, Vec::new());
    }

    #[test]
    fn a_fence_is_answered_once_keep_all_readers_were_sent_earlier_messages() {
        let mut registry = registry();
        ask(&mut registry, 1);
        assert_eq!(answers(&mut registry), [1], "nothing waits");

        [KEEPS, KEEPS, KEEPS_LAST].iter().for_each(|to| say(&mut registry, *to));
        ask(&mut registry, 2);
        say(&mut registry, KEEPS);
        assert_eq!(answers(&mut registry), [0; 0]);
        // One of two packets is sent; the second cannot be sent.
        registry.poll_output(&id(KEEPS)).unwrap();
        let unsent = registry.poll_output(&id(KEEPS)).unwrap();
        registry.return_output(&id(KEEPS), unsent);
        registry.answer_fences();
        assert_eq!(answers(&mut registry), [0; 0]);
        // Packets after the question, and all packets of readers that may lose samples, may still wait.
        registry.poll_output(&id(KEEPS)).unwrap();
        registry.answer_fences();
        assert_eq!(answers(&mut registry), [2]);
        assert!(!registry.has_fences());
    }

    #[test]
    fn memory_that_is_given_up_before_it_is_sent_counts_as_no_other_packet() {
        let mut registry = registry();
        say(&mut registry, KEEPS);
        ask(&mut registry, 1);
        let segment = Segment { number: 1, publisher: None };
        let opened = SessionMessage::Segment(SegmentOpened { session: id(WRITER), segment });
        registry.push(&id(KEEPS), &opened, vec!["map"]);
        let entry = registry.sessions.get_mut(&id(KEEPS)).unwrap();
        assert!(entry.outbox.take_back(&id(WRITER), 1));
        registry.answer_fences();
        assert_eq!(answers(&mut registry), [0; 0]);
        take(&mut registry, KEEPS);
        assert_eq!(answers(&mut registry), [1]);
    }

    #[test]
    fn a_session_that_is_behind_delays_the_fences_answer() {
        let mut registry = registry();
        say(&mut registry, KEEPS);
        ask(&mut registry, 1);
        (0..=MAX_QUEUE).for_each(|_| say(&mut registry, KEEPS));
        registry.answer_fences();
        assert_eq!(answers(&mut registry), [0; 0], "its queue is empty, for it was thrown away");
        ask(&mut registry, 2);
        registry.poll_output(&id(KEEPS)).unwrap();
        registry.answer_fences();
        assert_eq!(answers(&mut registry), [0; 0], "it was told a part");
        take(&mut registry, KEEPS);
        assert_eq!(answers(&mut registry), [2], "the later question alone");
    }

    #[test]
    fn an_ended_session_delays_no_fence() {
        let mut registry = registry();
        say(&mut registry, KEEPS);
        ask(&mut registry, 1);
        registry.handle_disconnect(&id(KEEPS));
        registry.answer_fences();
        assert_eq!(answers(&mut registry), [1]);
        // The FENCE of a publisher that is gone is removed.
        let mut registry = self::registry();
        say(&mut registry, KEEPS);
        ask(&mut registry, 1);
        let gone = SessionMessage::EndpointGone(Gone { gid: gid(WRITER) });
        registry.handle_message(&id(WRITER), gone, vec![]).unwrap();
        assert!(!registry.has_fences());
        ask(&mut registry, 2);
        assert!(!registry.has_fences());
    }

    #[test]
    fn a_fence_for_the_publisher_of_another_session_is_refused() {
        let mut registry = registry();
        let fence = SessionMessage::Fence(Fence { writer: gid(WRITER), number: 1 });
        let refused = registry.handle_message(&id(KEEPS), fence, vec![]);
        assert_eq!(refused, Err(Violation::NotItsOwn(gid(WRITER))));
    }
}
