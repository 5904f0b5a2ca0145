//! The messages between a session and its daemon beside samples: the queue of outgoing messages, and the awaited
//! answers.

use std::{
    collections::VecDeque,
    mem,
    sync::{Mutex, MutexGuard, PoisonError},
};

use crate::{
    ids::{DaemonId, Gid},
    session::daemon::status_text::StatusAnswer,
    wire::session::{Fence, Gone, SessionMessage, StatusPart},
};

/// Maximum number of refusals that are kept for a relayed process until it takes them. Further refusals are dropped.
const REFUSALS: usize = 256;

/// A message for the daemon.
#[derive(Debug)]
pub(in crate::session) enum Outgoing {
    /// An endpoint of this session, as it is when the message is sent.
    Announce(Gid),
    /// A message without descriptors.
    Message(Box<SessionMessage>),
    /// A fence, sent behind everything that readers need.
    Fence(Fence),
}

impl Outgoing {
    pub(in crate::session) fn message(message: SessionMessage) -> Self {
        Self::Message(Box::new(message))
    }

    /// Creates the message that an endpoint of this session is gone.
    pub(in crate::session) fn gone(gid: Gid) -> Self {
        Self::message(SessionMessage::EndpointGone(Gone { gid }))
    }
}

/// The session's link to its daemon, as other threads than the control thread see it. Its lock is held for no longer
/// than a call, and may be taken under any other one.
#[derive(Debug, Default)]
pub(in crate::session) struct DaemonLink {
    state: Mutex<LinkState>,
}

#[derive(Debug, Default)]
struct LinkState {
    outgoing: VecDeque<Outgoing>,
    daemon: Option<DaemonId>,
    status: StatusAnswer,
    /// The daemon's refusals that concern no endpoint permanently, for the process that the session relays.
    refusals: Vec<String>,
}

impl DaemonLink {
    /// Returns the daemon at the other end; `None` while there is none.
    pub(in crate::session) fn daemon(&self) -> Option<DaemonId> {
        self.lock().daemon
    }

    /// Sets, for a relay, the daemon at the other end, or that there is none.
    pub(in crate::session) fn set_daemon(&self, daemon: Option<DaemonId>) {
        self.lock().daemon = daemon;
    }

    /// Records that a daemon accepted the session. `outgoing` replaces the queued messages.
    pub(in crate::session) fn connected(&self, daemon: DaemonId, outgoing: Vec<Outgoing>) {
        let mut state = self.lock();
        state.daemon = Some(daemon);
        state.outgoing = outgoing.into();
    }

    /// Records that the connection ended, so that a request for the status gets no answer any more.
    pub(in crate::session) fn lost(&self) {
        let mut state = self.lock();
        state.daemon = None;
        if matches!(state.status, StatusAnswer::Parts(_)) {
            state.status = StatusAnswer::Lost;
        }
    }

    /// Queues a message for the daemon. The caller has to wake the control thread.
    pub(in crate::session) fn queue(&self, outgoing: Outgoing) {
        self.lock().outgoing.push_back(outgoing);
    }

    /// Takes all queued messages.
    pub(in crate::session) fn take(&self) -> VecDeque<Outgoing> {
        mem::take(&mut self.lock().outgoing)
    }

    /// Takes the queued messages for which `which` holds, and leaves the rest.
    pub(in crate::session) fn take_messages(
        &self,
        which: impl Fn(&SessionMessage) -> bool,
    ) -> Vec<SessionMessage> {
        let mut taken = Vec::new();
        let mut state = self.lock();
        for outgoing in mem::take(&mut state.outgoing) {
            match outgoing {
                Outgoing::Message(message) if which(&message) => taken.push(*message),
                other => state.outgoing.push_back(other),
            }
        }
        taken
    }

    /// Queues messages again that could not be sent, ahead of messages that came meanwhile.
    pub(in crate::session) fn put_back(&self, outgoing: impl IntoIterator<Item = Outgoing>) {
        let mut state = self.lock();
        let later = mem::take(&mut state.outgoing);
        state.outgoing = outgoing.into_iter().chain(later).collect();
    }

    /// Begins to wait for a status. Returns false if there is no daemon.
    pub(in crate::session) fn ask_status(&self) -> bool {
        let mut state = self.lock();
        if state.daemon.is_some() {
            state.status = StatusAnswer::Parts(Default::default());
        }
        state.daemon.is_some()
    }

    /// Adds a part of the requested status. Returns whether it was the last part.
    pub(in crate::session) fn add_status(&self, part: &StatusPart) -> bool {
        let mut state = self.lock();
        let StatusAnswer::Parts(text) = &mut state.status else { return false };
        let Some(whole) = text.add(part) else { return false };
        state.status = StatusAnswer::Whole(whole);
        true
    }

    /// Returns whether parts of a status are still to come.
    pub(in crate::session) fn awaits_status(&self) -> bool {
        matches!(self.lock().status, StatusAnswer::Parts(_))
    }

    /// Takes the result of the request for the status. The caller does not wait for it any more.
    pub(in crate::session) fn take_status(&self) -> StatusAnswer {
        mem::take(&mut self.lock().status)
    }

    /// Keeps a refusal until it is taken. Returns whether it is the first one, for which the process that takes
    /// refusals has to be woken.
    pub(in crate::session) fn keep_refusal(&self, why: String) -> bool {
        let mut state = self.lock();
        let is_first = state.refusals.is_empty();
        if state.refusals.len() < REFUSALS {
            state.refusals.push(why);
        }
        is_first
    }

    /// Takes the kept refusals.
    pub(in crate::session) fn take_refusals(&self) -> Vec<String> {
        mem::take(&mut self.lock().refusals)
    }

    fn lock(&self) -> MutexGuard<'_, LinkState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{ids::SessionId, wire::session::Unmet};

    fn gid(number: u32) -> Gid {
        Gid::new(SessionId([1; 16]), number)
    }

    fn fence(number: u64) -> Outgoing {
        Outgoing::Fence(Fence { writer: gid(1), number })
    }

    fn told(outgoing: impl IntoIterator<Item = Outgoing>) -> Vec<String> {
        outgoing.into_iter().map(|outgoing| format!("{outgoing:?}")).collect()
    }

    #[test]
    fn a_new_daemon_is_told_nothing_that_was_queued_for_the_last_one() {
        let link = DaemonLink::default();
        link.queue(Outgoing::gone(gid(1)));
        link.connected(DaemonId([2; 16]), vec![Outgoing::Announce(gid(2))]);
        link.queue(fence(3));
        assert_eq!(link.daemon(), Some(DaemonId([2; 16])));
        assert_eq!(told(link.take()), told([Outgoing::Announce(gid(2)), fence(3)]));
        assert!(link.take().is_empty());
    }

    #[test]
    fn returned_messages_go_before_messages_queued_meanwhile() {
        let link = DaemonLink::default();
        link.queue(fence(2));
        link.put_back([fence(1)]);
        assert_eq!(told(link.take()), told([fence(1), fence(2)]));
    }

    #[test]
    fn only_the_messages_that_are_asked_for_are_taken() {
        let link = DaemonLink::default();
        let unmet = || SessionMessage::Unmet(Unmet { reader: gid(1), writer: gid(2), samples: 3 });
        link.queue(Outgoing::gone(gid(1)));
        link.queue(Outgoing::message(unmet()));
        link.queue(fence(4));
        let taken = link.take_messages(|message| matches!(message, SessionMessage::Unmet(_)));
        assert_eq!(taken, [unmet()]);
        assert_eq!(told(link.take()), told([Outgoing::gone(gid(1)), fence(4)]));
    }

    #[test]
    fn a_question_for_the_status_ends_with_the_daemon() {
        let link = DaemonLink::default();
        assert!(!link.ask_status(), "nobody is there");
        link.set_daemon(Some(DaemonId([2; 16])));
        assert!(link.ask_status() && link.awaits_status());
        let part = |part| StatusPart { part, parts: 2, text: vec![b'a'] };
        assert!(!link.add_status(&part(0)));
        link.lost();
        assert!(!link.add_status(&part(1)) && !link.awaits_status());
        assert!(matches!(link.take_status(), StatusAnswer::Lost));
        assert_eq!(link.daemon(), None);
    }

    #[test]
    fn refusals_are_kept_up_to_a_bound() {
        let link = DaemonLink::default();
        assert!(link.keep_refusal("first".to_owned()));
        (0..REFUSALS).for_each(|_| assert!(!link.keep_refusal("further".to_owned())));
        assert_eq!(link.take_refusals().len(), REFUSALS);
        assert!(link.keep_refusal("first again".to_owned()));
    }
}
