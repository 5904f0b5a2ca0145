//! Asks peers, for tools, what their access rules let this host do.

use axon_shm::ids::{DaemonId, SessionId};
use axon_transport::{
    internal::{
        graph::LIMITS,
        wire::session::{AccessCheck, MOST_CHECKED},
    },
    status::{PeerDecision, PeerDecisions},
};

use super::{super::plane::ControlPlane, questions::NOT_LINKED};

impl ControlPlane {
    /// Handles a session's question about what a peer lets this host do. Other users may not ask.
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

    /// Sends the answer to a question.
    pub(in crate::control) fn answer_decisions(
        &mut self,
        number: u64,
        decisions: Result<Vec<PeerDecision>, String>,
    ) {
        if let Some(id) = self.questions.remove(number) {
            self.tell_decisions(&id, decisions);
        }
    }

    /// Answers the questions to a peer whose link is over, or all questions if the gateway ended: no other answer will
    /// come.
    pub(in crate::control) fn forget_questions(&mut self, daemon: Option<DaemonId>) {
        for number in self.questions.of(daemon) {
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
