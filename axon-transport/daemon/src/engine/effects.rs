//! What the engine has its owner do, in order.

use std::collections::VecDeque;

use super::{
    counters::{self, Loss},
    links::LinkReport,
    refusal::{Refusal, RefusedBy},
};
use crate::{
    bridge::ToControl,
    keys::{Origin, Request},
};

/// What the engine has its owner do.
#[derive(Debug)]
pub(crate) enum Effect {
    /// Tell the control plane.
    Tell(ToControl),
    /// Ask the KME; the answer comes back by [`Engine::handle_key_event`](super::Engine::handle_key_event).
    Kme(Origin, Request),
    /// Record a key in the ledger of used keys; the result comes back by
    /// [`Engine::handle_recorded`](super::Engine::handle_recorded).
    Record {
        /// The connection.
        link: u64,
        /// The key.
        key_id: String,
    },
    /// Give freed memory back to the system, after a while.
    ReturnMemory,
}

/// Effects that the owner has not taken yet.
#[derive(Default)]
pub(super) struct Effects {
    waiting: VecDeque<Effect>,
    /// What the control plane was told of [`tell_draining`](Self::tell_draining).
    draining: bool,
}

impl Effects {
    /// Adds an effect.
    pub(super) fn push(&mut self, effect: Effect) {
        self.waiting.push_back(effect);
    }

    /// Tells the control plane.
    pub(super) fn tell(&mut self, what: ToControl) {
        self.push(Effect::Tell(what));
    }

    /// Tells the control plane whether samples of publishers that ended are on their way, if that changed.
    pub(super) fn tell_draining(&mut self, draining: bool) {
        if std::mem::replace(&mut self.draining, draining) != draining {
            self.tell(ToControl::Draining(draining));
        }
    }

    /// Logs losses, and tells the control plane.
    pub(super) fn tell_lost(&mut self, peer: &str, losses: Vec<Loss>) {
        counters::log(&losses, peer);
        for Loss { topic, cause, samples } in losses {
            self.tell(ToControl::Lost { topic: topic.to_string(), cause, samples });
        }
    }

    /// Passes on what the links report.
    pub(super) fn tell_report(&mut self, report: LinkReport) {
        match report {
            LinkReport::Refused(peer, refusal) => self.tell_refused(peer, &refusal),
            LinkReport::DialFailed { daemon, standing } => {
                self.tell(ToControl::DialFailed { daemon, standing });
            }
            LinkReport::Up { daemon, address } => self.tell(ToControl::LinkUp { daemon, address }),
            LinkReport::Datagrams(datagrams) => self.tell(ToControl::Datagrams(datagrams)),
        }
    }

    fn tell_refused(&mut self, peer: String, refusal: &Refusal) {
        if refusal.by == RefusedBy::Network {
            tracing::debug!(peer, %refusal, "no link");
        } else {
            tracing::warn!(peer, %refusal, "link refused");
        }
        let by = match refusal.by {
            RefusedBy::Here => "refused here",
            RefusedBy::Peer => "refused by the peer",
            RefusedBy::Network => "not reached",
        };
        let reason = format!("{by}: {}", refusal.reason);
        self.tell(ToControl::Refusal { peer, what: refusal.name.clone(), reason });
    }

    /// The next effect.
    pub(super) fn poll(&mut self) -> Option<Effect> {
        self.waiting.pop_front()
    }
}
