//! The questions about access rules of peers that wait for an answer.

use std::{
    collections::{BTreeMap, VecDeque},
    rc::Rc,
};

use axon_shm::ids::{DaemonId, SessionId};
use axon_transport::internal::wire::session::CheckedUse;
use tokio::sync::Notify;

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

    /// A question is answered. Returns who asked.
    pub(super) fn remove(&mut self, number: u64) -> Option<SessionId> {
        self.unsent.retain(|(unsent, ..)| *unsent != number);
        self.waiting.remove(&number).map(|(id, _)| id)
    }

    /// The numbers of those that this peer has to answer; of all where none is named.
    pub(super) fn of(&self, daemon: Option<DaemonId>) -> Vec<u64> {
        let of = |asked: &DaemonId| daemon.is_none_or(|daemon| daemon == *asked);
        let waiting = self.waiting.iter().filter(|(_, (_, asked))| of(asked));
        waiting.map(|(number, _)| *number).collect()
    }
}
