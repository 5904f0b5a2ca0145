//! Client side in `session`: answers the server's request for the proof. In `messages10` the
//! [`KeyReceiver`](crate::keys::KeyReceiver) answers.

use std::{sync::Arc, time::Duration};

use crate::keys::{
    Exporters, KeyMessage, KeyViolation,
    exporters::Exporter,
    fetch::Fetches,
    proof,
    request::{Answer, KeyPurpose, KmeRequest},
};

/// Fetches the one key that the server announces and answers READY with its proof.
pub struct ProofResponder {
    ready: Exporter,
    fetches: Fetches,
    announced: bool,
    outbox: Option<KeyMessage>,
    answered: Option<Result<(), String>>,
}

impl ProofResponder {
    /// Answers `server_sae` on the connection with these `exporters`.
    pub fn new(server_sae: &str, exporters: &Exporters) -> Self {
        Self {
            ready: Arc::clone(exporters.ready()),
            fetches: Fetches::new(server_sae, KeyPurpose::Proof),
            announced: false,
            outbox: None,
            answered: None,
        }
    }

    /// Handles a message of the server.
    ///
    /// # Errors
    /// The message is not one ANNOUNCE of one key.
    pub fn handle_message(
        &mut self,
        now: Duration,
        message: &KeyMessage,
    ) -> Result<(), KeyViolation> {
        match message {
            KeyMessage::Announce(key_ids) if !self.announced && key_ids.len() == 1 => {
                self.announced = true;
                self.fetches.start(now, key_ids.clone());
                Ok(())
            }
            other => Err(KeyViolation::Unexpected(other.name())),
        }
    }

    /// Returns the next call to the KME, if any.
    pub fn poll_request(&mut self, now: Duration) -> Option<KmeRequest> {
        self.fetches.poll_request(now)
    }

    /// Handles the KME's answer to one of our requests. The key is used for the proof, and erased.
    pub fn handle_answer(&mut self, now: Duration, answer: Answer) {
        for (key_id, outcome) in self.fetches.handle_answer(now, answer) {
            let (message, answered) = match outcome {
                Ok(key) => {
                    let proof = proof::compute(&key, &key_id, &self.ready);
                    (KeyMessage::Ready { key_id, proof }, Ok(()))
                }
                Err(failure) => {
                    let reason = failure.kind.told().to_owned();
                    (KeyMessage::Failed { key_id, reason }, Err(failure.text))
                }
            };
            self.outbox = Some(message);
            self.answered = Some(answered);
        }
    }

    /// Returns READY or FAILED, once.
    pub fn poll_message(&mut self) -> Option<KeyMessage> {
        self.outbox.take()
    }

    /// Returns when to poll again without other cause.
    pub fn poll_timeout(&self) -> Option<Duration> {
        self.fetches.poll_timeout()
    }

    /// Returns the answer that the server got: READY, or FAILED with the reason. `None` before the answer.
    pub fn answered(&self) -> Option<Result<(), String>> {
        self.answered.clone()
    }
}
