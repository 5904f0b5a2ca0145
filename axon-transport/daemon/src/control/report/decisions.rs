//! Asks peers what their access rules let this host do, for tools that want to know.

use std::{
    collections::{BTreeMap, VecDeque},
    rc::Rc,
};

use axon_shm::ids::{DaemonId, SessionId};
use axon_transport::{
    internal::{
        graph::LIMITS,
        wire::session::{AccessCheck, CheckedUse, MOST_CHECKED},
    },
    status::{PeerDecision, PeerDecisions},
};
use tokio::sync::Notify;

use super::super::plane::Control;

/// Why a peer was not asked.
pub(in crate::control) const NOT_LINKED: &str = "there is no link with this peer";

/// Questions that wait for an answer. The session of the oldest is told that there are too many.
const WAITING: usize = 64;

/// A question that the gateway is to pass on: its number, the peer, and the uses that it is about.
type Question = (u64, DaemonId, Vec<CheckedUse>);

/// The questions that wait.
#[derive(Default)]
pub(in crate::control) struct AccessQuestions {
    number: u64,
    unsent: VecDeque<Question>,
    /// Who asked, and which peer.
    waiting: BTreeMap<u64, (SessionId, DaemonId)>,
    bell: Rc<Notify>,
}

impl AccessQuestions {
    /// Rings when there is one for the gateway.
    pub(in crate::control) fn bell(&self) -> Rc<Notify> {
        Rc::clone(&self.bell)
    }

    /// The next question for the gateway.
    pub(in crate::control) fn poll(&mut self) -> Option<Question> {
        self.unsent.pop_front()
    }

    /// Takes a question. Returns the number of another one that waits no longer.
    fn push(&mut self, id: SessionId, daemon: DaemonId, uses: Vec<CheckedUse>) -> Option<u64> {
        self.number += 1;
        self.unsent.push_back((self.number, daemon, uses));
        self.waiting.insert(self.number, (id, daemon));
        self.bell.notify_one();
        let oldest = *self.waiting.first_key_value()?.0;
        (self.waiting.len() > WAITING).then_some(oldest)
    }

    /// A question is answered. Returns who asked.
    fn remove(&mut self, number: u64) -> Option<SessionId> {
        self.unsent.retain(|(unsent, ..)| *unsent != number);
        self.waiting.remove(&number).map(|(id, _)| id)
    }
}

impl Control {
    /// A session asks what a peer lets this host do. Other users may not.
    pub(in crate::control) fn ask_decisions(&mut self, id: &SessionId, check: AccessCheck) {
        let user = self.registry.session(id).and_then(|entry| entry.user);
        let AccessCheck { daemon, uses } = check;
        let error = if let Some(user) = user {
            Some(format!("user {user} may not ask what peers allow this host"))
        } else if uses.len() > MOST_CHECKED
            || uses.iter().any(|used| used.verb > 4 || used.name.len() > LIMITS.name)
        {
            Some(format!("a question is about at most {MOST_CHECKED} uses with valid names"))
        } else if !self.is_linked(&daemon) {
            Some(NOT_LINKED.to_owned())
        } else {
            None
        };
        if let Some(error) = error {
            return self.tell_decisions(id, Err(error));
        }
        if let Some(oldest) = self.questions.push(*id, daemon, uses) {
            self.answer_decisions(oldest, Err("too many questions wait".to_owned()));
        }
    }

    /// A question has an answer.
    pub(in crate::control) fn answer_decisions(
        &mut self,
        number: u64,
        decisions: Result<Vec<PeerDecision>, String>,
    ) {
        if let Some(id) = self.questions.remove(number) {
            self.tell_decisions(&id, decisions);
        }
    }

    /// The link with a peer is over, or the gateway with all links: nobody answers.
    pub(in crate::control) fn forget_questions(&mut self, daemon: Option<DaemonId>) {
        let of = |(_, asked): &(SessionId, DaemonId)| daemon.is_none_or(|daemon| daemon == *asked);
        let waiting = self.questions.waiting.iter().filter(|(_, question)| of(question));
        for number in waiting.map(|(number, _)| *number).collect::<Vec<_>>() {
            self.answer_decisions(number, Err(NOT_LINKED.to_owned()));
        }
    }

    fn tell_decisions(&mut self, id: &SessionId, decisions: Result<Vec<PeerDecision>, String>) {
        let mut answer = PeerDecisions::default();
        match decisions {
            Ok(decisions) => answer.decisions = decisions,
            Err(error) => answer.error = Some(error),
        }
        let text = serde_json::to_vec(&answer).unwrap_or_default();
        self.registry.tell_status(id, text.into());
    }
}
