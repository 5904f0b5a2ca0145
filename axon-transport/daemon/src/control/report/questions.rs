//! The questions about access rules of peers that wait for an answer.

use std::{
    collections::{BTreeMap, VecDeque},
    rc::Rc,
};

use axon_shm::ids::{DaemonId, SessionId};
use axon_transport::internal::wire::session::CheckedUse;
use tokio::sync::Notify;

/// The reason why a peer was not asked.
pub(in crate::control) const NOT_LINKED: &str = "there is no link with this peer";

/// Maximum number of questions that wait for an answer. Beyond that, the session of the oldest is told that there are
/// too many.
const WAITING: usize = 64;

/// A question for the gateway to pass on: its number, the peer, and the uses that it is about.
type Question = (u64, DaemonId, Vec<CheckedUse>);

/// The questions that wait.
#[derive(Default)]
pub(in crate::control) struct AccessQuestions {
    number: u64,
    unsent: VecDeque<Question>,
    /// The asking session and the peer of each question.
    waiting: BTreeMap<u64, (SessionId, DaemonId)>,
    bell: Rc<Notify>,
}

impl AccessQuestions {
    /// Returns the bell that rings when there is a question for the gateway.
    pub(in crate::control) fn bell(&self) -> Rc<Notify> {
        Rc::clone(&self.bell)
    }

    /// Returns the next question for the gateway.
    pub(in crate::control) fn poll(&mut self) -> Option<Question> {
        self.unsent.pop_front()
    }

    /// Adds a question. Returns the number of the oldest one if too many wait.
    pub(super) fn push(
        &mut self,
        id: SessionId,
        daemon: DaemonId,
        uses: Vec<CheckedUse>,
    ) -> Option<u64> {
        self.number += 1;
        self.unsent.push_back((self.number, daemon, uses));
        self.waiting.insert(self.number, (id, daemon));
        self.bell.notify_one();
        let oldest = *self.waiting.first_key_value()?.0;
        (self.waiting.len() > WAITING).then_some(oldest)
    }

    /// Removes an answered question. Returns the session that asked.
    pub(super) fn remove(&mut self, number: u64) -> Option<SessionId> {
        self.unsent.retain(|(unsent, ..)| *unsent != number);
        self.waiting.remove(&number).map(|(id, _)| id)
    }

    /// Returns the numbers of the questions that this peer has to answer; of all questions if no peer is named.
    pub(super) fn of(&self, daemon: Option<DaemonId>) -> Vec<u64> {
        let of = |asked: &DaemonId| daemon.is_none_or(|daemon| daemon == *asked);
        let waiting = self.waiting.iter().filter(|(_, (_, asked))| of(asked));
        waiting.map(|(number, _)| *number).collect()
    }
}
