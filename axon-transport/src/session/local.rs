//! A session without a daemon (`AXON_DAEMON=off`): the registry that a daemon would keep, for this
//! session alone, so that its own endpoints find each other in the usual way.

use std::sync::Arc;

use super::message::{Message, SessionRole};
use crate::{daemon::registry::Registry, ids::SessionId, passed::PassedFd};

#[derive(Debug)]
pub(super) struct Local {
    id: SessionId,
    registry: Registry<Arc<PassedFd>>,
}

impl Local {
    pub(super) fn new(id: SessionId, name: String) -> Self {
        let mut registry = Registry::default();
        // The first session is never one too many.
        let _ = registry.connect(id, SessionRole::Application, name, std::process::id(), None);
        Self { id, registry }
    }

    /// What a daemon would answer to nothing, or to a message.
    pub(super) fn exchange(
        &mut self,
        message: Option<(Message, Vec<PassedFd>)>,
    ) -> Vec<(Message, Vec<PassedFd>)> {
        if let Some((message, descriptors)) = message {
            let descriptors = descriptors.into_iter().map(Arc::new).collect();
            if let Err(violation) = self.registry.message(&self.id, message, descriptors) {
                tracing::error!(%violation, "a message to no daemon");
            }
        }
        self.registry.flush();
        let mut answers = Vec::new();
        while let Some(output) = self.registry.next_output(&self.id) {
            let descriptors: std::io::Result<Vec<PassedFd>> =
                output.descriptors.iter().map(|d| d.try_clone()).collect();
            match (Message::decode(&output.packet), descriptors) {
                (Ok(message), Ok(descriptors)) => answers.push((message, descriptors)),
                (message, descriptors) => {
                    tracing::error!(?message, ?descriptors, "an answer of no daemon was lost");
                }
            }
        }
        answers
    }
}
