//! What a session and its daemon have to say to each other beside samples: the messages that wait to be sent, and the
//! answers that somebody waits for.

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

/// Refusals that are kept for a process that is relayed, until it takes them. It is not told of those beyond.
const REFUSALS: usize = 256;

/// Something for the daemon to be told.
#[derive(Debug)]
pub(in crate::session) enum Outgoing {
    /// This endpoint of ours, as it is when the message is sent.
    Announce(Gid),
    /// A message without descriptors.
    Message(Box<SessionMessage>),
    /// A question behind all that readers have to be sent.
    Fence(Fence),
}

impl Outgoing {
    pub(in crate::session) fn message(message: SessionMessage) -> Self {
        Self::Message(Box::new(message))
    }

    /// An endpoint of ours is gone.
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
    /// What the daemon refused of no endpoint for good, for the process that the session relays.
    refusals: Vec<String>,
}

impl DaemonLink {
    /// The daemon at the other end; `None` while there is none.
    pub(in crate::session) fn daemon(&self) -> Option<DaemonId> {
        self.lock().daemon
    }

    /// For a relay: there is a daemon now, or none any more.
    pub(in crate::session) fn set_daemon(&self, daemon: Option<DaemonId>) {
        self.lock().daemon = daemon;
    }

    /// A daemon took the session, and is to be told this in place of what was queued.
    pub(in crate::session) fn connected(&self, daemon: DaemonId, outgoing: Vec<Outgoing>) {
        let mut state = self.lock();
        state.daemon = Some(daemon);
        state.outgoing = outgoing.into();
    }

    /// The connection ended. Nobody answers a question for the status any more.
    pub(in crate::session) fn lost(&self) {
        let mut state = self.lock();
        state.daemon = None;
        if matches!(state.status, StatusAnswer::Parts(_)) {
            state.status = StatusAnswer::Lost;
        }
    }

    /// Queues something for the daemon. The control thread has to be woken for it.
    pub(in crate::session) fn queue(&self, outgoing: Outgoing) {
        self.lock().outgoing.push_back(outgoing);
    }

    /// Takes all that is queued.
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

    /// Queues again, ahead of what came meanwhile, what could not be said.
    pub(in crate::session) fn put_back(&self, outgoing: impl IntoIterator<Item = Outgoing>) {
        let mut state = self.lock();
        let later = mem::take(&mut state.outgoing);
        state.outgoing = outgoing.into_iter().chain(later).collect();
    }

    /// Begins to wait for a status. False, where there is no daemon.
    pub(in crate::session) fn ask_status(&self) -> bool {
        let mut state = self.lock();
        if state.daemon.is_some() {
            state.status = StatusAnswer::Parts(Default::default());
        }
        state.daemon.is_some()
    }

    /// Adds a part of the status that was asked for. Whether it was the last.
    pub(in crate::session) fn add_status(&self, part: &StatusPart) -> bool {
        let mut state = self.lock();
        let StatusAnswer::Parts(text) = &mut state.status else { return false };
        let Some(whole) = text.add(part) else { return false };
        state.status = StatusAnswer::Whole(whole);
        true
    }

    /// Whether parts of a status are still to come.
    pub(in crate::session) fn awaits_status(&self) -> bool {
        matches!(self.lock().status, StatusAnswer::Parts(_))
    }

    /// What became of the question for the status. Nobody waits for it any more.
    pub(in crate::session) fn take_status(&self) -> StatusAnswer {
        mem::take(&mut self.lock().status)
    }

    /// Keeps a refusal until it is taken; returns whether it is the first, for which its taker has to be woken.
    pub(in crate::session) fn keep_refusal(&self, why: String) -> bool {
        let mut state = self.lock();
        let is_first = state.refusals.is_empty();
        if state.refusals.len() < REFUSALS {
            state.refusals.push(why);
        }
        is_first
    }

    /// Takes the refusals that were kept.
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
    fn what_is_put_back_is_ahead_of_what_came_meanwhile() {
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
