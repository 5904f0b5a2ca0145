//! Server side: requires the client of a connection to prove its name.

use std::{sync::Arc, time::Duration};

use axon_envelope::{KeyId, KmeKey};

use crate::{
    keys::{
        Exporters, KeyMessage,
        exporters::Exporter,
        proof,
        request::{Answer, FailureKind, Fetched, KeyPurpose, KmeRequest, RequestFailure},
    },
    wire::keys::announceable,
};

/// Maximum time for the whole proof: four calls with the longest timeout that may be set.
const DEADLINE: Duration = Duration::from_secs(60);
/// Maximum number of calls to `enc_keys`; a call is repeated only if the calls before certainly cost no key.
const MAX_CALLS: u32 = 3;
/// Wait before `enc_keys` is called again.
const RETRY_INTERVAL: Duration = Duration::from_millis(500);

/// Makes the client of one connection prove its name.
pub struct ClientProof {
    client_sae: String,
    ready: Exporter,
    deadline: Duration,
    tries: u32,
    step: ProofStep,
}

enum ProofStep {
    Ask { not_before: Duration },
    Asked,
    Announce(KeyId, KmeKey),
    Announced(KeyId, KmeKey),
    Proven(KeyId, KmeKey),
    Failed(ProofFailure),
}

/// The state of a [`ClientProof`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ProofState {
    /// The proof is not yet settled.
    Pending,
    /// The client has proven its name.
    Proven,
    /// It is not known to be: close the connection.
    Failed(ProofFailure),
}

/// Why the client's name is not proven.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ProofFailure {
    /// Our KME gave no key for it.
    // This text goes to the client before its name is proven, so it does not contain what the KME answered.
    #[error("no key to prove SAE {sae:?} with: enc_keys: {}", failure.kind.told())]
    NoKey {
        /// The client.
        sae: String,
        /// Why.
        failure: RequestFailure,
    },
    /// The client's KME gave it no key.
    #[error("SAE {sae:?} could not fetch the key announced to it: {reason}")]
    ClientHasNoKey {
        /// The client.
        sae: String,
        /// In the client's words.
        reason: String,
    },
    /// It does not hold the key of the SAE it claims to be.
    #[error("the client is not SAE {0:?}: its READY carries a wrong proof")]
    WrongProof(String),
    /// It sent something else.
    #[error("SAE {sae:?} sent {message} where READY was due")]
    Unexpected {
        /// The client.
        sae: String,
        /// The kind of the message.
        message: &'static str,
    },
    /// Time ran out.
    #[error("SAE {0:?} did not prove its name within {DEADLINE:?}")]
    Timeout(String),
}

impl ProofFailure {
    /// Returns the application error code to close the connection with (docs/formats.md, section 6).
    pub fn code(&self) -> u64 {
        match self {
            Self::NoKey { .. } | Self::ClientHasNoKey { .. } => 0x23,
            Self::Unexpected { .. } => 0x32,
            Self::WrongProof(_) | Self::Timeout(_) => 0x20,
        }
    }
}

impl ClientProof {
    /// Starts a proof that the client of the connection with these `exporters` is `client_sae`.
    pub fn new(now: Duration, client_sae: &str, exporters: &Exporters) -> Self {
        Self {
            client_sae: client_sae.to_owned(),
            ready: Arc::clone(exporters.ready()),
            deadline: now + DEADLINE,
            tries: MAX_CALLS,
            step: ProofStep::Ask { not_before: now },
        }
    }

    /// Returns the next call to the KME, if any.
    pub fn poll_request(&mut self, now: Duration) -> Option<KmeRequest> {
        match self.step {
            ProofStep::Ask { not_before } if not_before <= now => {}
            _ => return None,
        }
        self.step = ProofStep::Asked;
        self.tries -= 1;
        Some(KmeRequest::Enc {
            slave: self.client_sae.clone(),
            number: 1,
            purpose: KeyPurpose::Proof,
        })
    }

    /// Handles the KME's answer to our request.
    pub fn handle_answer(&mut self, now: Duration, answer: Answer) {
        if !matches!(self.step, ProofStep::Asked) {
            return;
        }
        let invalid = |text: &str| RequestFailure::new(FailureKind::Invalid, text);
        let failure = match answer.outcome {
            Ok(Fetched::Keys(mut keys)) => match keys.pop() {
                Some((key_id, key)) if keys.is_empty() && announceable(&key_id).is_some() => {
                    self.step = ProofStep::Announce(key_id, key);
                    return;
                }
                _ => invalid("the KME did not give one key with a key_ID of at most 128 bytes"),
            },
            Ok(Fetched::Stock(_)) => invalid("the KME answered another call"),
            Err(failure) => failure,
        };
        let nothing_lost = failure.kind.is_transient() && failure.kind != FailureKind::Ambiguous;
        self.step = if nothing_lost && self.tries > 0 {
            ProofStep::Ask { not_before: now + RETRY_INTERVAL }
        } else {
            ProofStep::Failed(ProofFailure::NoKey { sae: self.client_sae.clone(), failure })
        };
    }

    /// Returns the ANNOUNCE, once.
    pub fn poll_message(&mut self) -> Option<KeyMessage> {
        match std::mem::replace(&mut self.step, ProofStep::Asked) {
            ProofStep::Announce(key_id, key) => {
                let announce = KeyMessage::Announce(vec![key_id.clone()]);
                self.step = ProofStep::Announced(key_id, key);
                Some(announce)
            }
            other => {
                self.step = other;
                None
            }
        }
    }

    /// Handles a message of the client. Every message but the right READY ends in failure.
    pub fn handle_message(&mut self, _now: Duration, message: &KeyMessage) {
        let sae = || self.client_sae.clone();
        let failure = match (&self.step, message) {
            (ProofStep::Failed(_), _) => return,
            (ProofStep::Announced(id, key), KeyMessage::Ready { key_id, proof })
                if id == key_id =>
            {
                if proof::verify(key, id, &self.ready, proof) {
                    let announced = std::mem::replace(&mut self.step, ProofStep::Asked);
                    if let ProofStep::Announced(key_id, key) = announced {
                        self.step = ProofStep::Proven(key_id, key);
                    }
                    return;
                }
                ProofFailure::WrongProof(sae())
            }
            (ProofStep::Announced(id, _), KeyMessage::Failed { key_id, reason })
                if id == key_id =>
            {
                ProofFailure::ClientHasNoKey { sae: sae(), reason: reason.clone() }
            }
            (_, other) => ProofFailure::Unexpected { sae: sae(), message: other.name() },
        };
        self.step = ProofStep::Failed(failure);
    }

    /// Returns when to call [`handle_timeout`](Self::handle_timeout) and poll again without other cause.
    pub fn poll_timeout(&self) -> Option<Duration> {
        match &self.step {
            ProofStep::Proven(..) | ProofStep::Failed(_) => None,
            ProofStep::Ask { not_before } => Some((*not_before).min(self.deadline)),
            _ => Some(self.deadline),
        }
    }

    /// Ends the proof when its time is over.
    pub fn handle_timeout(&mut self, now: Duration) {
        if now >= self.deadline
            && !matches!(self.step, ProofStep::Proven(..) | ProofStep::Failed(_))
        {
            self.step = ProofStep::Failed(ProofFailure::Timeout(self.client_sae.clone()));
        }
    }

    /// Returns the state of the proof.
    pub fn state(&self) -> ProofState {
        match &self.step {
            ProofStep::Proven(..) => ProofState::Proven,
            ProofStep::Failed(failure) => ProofState::Failed(failure.clone()),
            _ => ProofState::Pending,
        }
    }

    /// Returns the key of the proof. In `messages10` it is the first sending key, for
    /// [`KeySender::adopt`](crate::keys::KeySender::adopt). In `session` dropping it spends it.
    pub fn into_key(self) -> Option<(KeyId, KmeKey)> {
        match self.step {
            ProofStep::Proven(key_id, key) => Some((key_id, key)),
            _ => None,
        }
    }
}
