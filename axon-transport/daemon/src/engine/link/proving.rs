//! The proof of the client's name, on either side (`docs/formats.md`, section 2).

use std::{mem, net::IpAddr, time::Duration};

use axon_envelope::{KeyId, KmeKey};
use axon_transport::config::QkdConfig;

use crate::{
    engine::{
        keyring::Keyring,
        link::failure::{LinkFailure, proof_limit},
    },
    keys::{
        Acceptor, Answer, ClientProof, Exporters, KeyMessage, KmeRequest, ProofFailure,
        ProofResponder, ProofState, RequestOrigin,
    },
    link::CloseCode,
};

/// One side of the proof on one connection.
pub(super) struct Proving {
    connection: u64,
    sae: String,
    source: IpAddr,
    /// Timeout of the proof.
    limit: Duration,
    role: Role,
}

enum Role {
    /// Server: a key was requested or announced. Only the right READY succeeds.
    Demand(ClientProof, Tried),
    /// Client in `session`.
    Answer(ProofResponder),
    /// Client in `session` that requested the key from the KME.
    Fetch(ProofResponder),
    /// Client in messages10: the server's ANNOUNCE is due.
    Announcement,
    /// Client in messages10: the KME has to supply one of these keys. It is the server's first sending key, so the
    /// receiver of message keys answers.
    Hold(Vec<KeyId>),
    Over,
}

/// A proof that costs a key. It counts against the client unless it succeeds, also if the connection ends before.
struct Tried {
    acceptor: Acceptor,
    source: IpAddr,
    sae: String,
    over: bool,
}

impl Drop for Tried {
    fn drop(&mut self) {
        if !self.over {
            self.acceptor.unproven(self.source, &self.sae);
        }
    }
}

impl Proving {
    /// Starts the proof on the server: the client has to prove that it is `sae`.
    pub(super) fn demand(
        now: Duration,
        connection: u64,
        source: IpAddr,
        sae: &str,
        exporters: &Exporters,
        keyring: &Keyring,
    ) -> Self {
        let acceptor = keyring.acceptor.clone();
        let tried = Tried { acceptor, source, sae: sae.to_owned(), over: false };
        let role = Role::Demand(ClientProof::new(now, sae, exporters), tried);
        Self::new(connection, source, sae, keyring, role)
    }

    /// Starts the proof on the client, which answers the ANNOUNCE of the server `sae`.
    ///
    /// # Errors
    /// The receiver of message keys cannot be attached, in messages10.
    pub(super) fn give(
        now: Duration,
        connection: u64,
        source: IpAddr,
        sae: &str,
        exporters: &Exporters,
        keyring: &mut Keyring,
    ) -> Result<Self, LinkFailure> {
        let role = if keyring.seals_messages() {
            attach(now, connection, sae, exporters, keyring)?;
            Role::Announcement
        } else {
            Role::Answer(ProofResponder::new(sae, exporters))
        };
        Ok(Self::new(connection, source, sae, keyring, role))
    }

    fn new(connection: u64, source: IpAddr, sae: &str, keyring: &Keyring, role: Role) -> Self {
        let limit = proof_limit(keyring.config.kme_answer_timeout);
        Self { connection, sae: sae.to_owned(), source, limit, role }
    }

    /// Returns the timeout of the proof.
    pub(super) fn limit(&self) -> Duration {
        self.limit
    }

    /// Returns whether the proof takes the next message.
    pub(super) fn reads(&self) -> bool {
        matches!(self.role, Role::Demand(..) | Role::Answer(_) | Role::Announcement)
    }

    /// Handles a key announcement, in order.
    ///
    /// # Errors
    /// The peer violated the protocol.
    pub(super) fn handle_message(
        &mut self,
        now: Duration,
        message: &KeyMessage,
        keyring: &mut Keyring,
    ) -> Result<(), LinkFailure> {
        match mem::replace(&mut self.role, Role::Over) {
            Role::Demand(mut proof, tried) => {
                proof.handle_message(now, message);
                let pending = matches!(proof.state(), ProofState::Pending);
                self.role = Role::Demand(proof, tried);
                if pending {
                    let text = "the message is no answer to the announced key";
                    return Err(LinkFailure::Ours(CloseCode::OutOfOrder, text.into()));
                }
            }
            Role::Answer(mut responder) => {
                responder.handle_message(now, message).map_err(|violation| {
                    let code = CloseCode::from_code(violation.code());
                    let code = code.unwrap_or(CloseCode::Malformed);
                    LinkFailure::Ours(code, violation.to_string())
                })?;
                self.role = Role::Fetch(responder);
            }
            Role::Announcement => {
                keyring
                    .handle_message(now, self.connection, message)
                    .map_err(|e| LinkFailure::Ours(CloseCode::Malformed, e.to_string()))?;
                let KeyMessage::Announce(key_ids) = message else {
                    return Err(LinkFailure::Ours(
                        CloseCode::OutOfOrder,
                        "ANNOUNCE was due".into(),
                    ));
                };
                self.role = Role::Hold(key_ids.clone());
            }
            role => self.role = role,
        }
        Ok(())
    }

    /// Handles the KME's answer to one of this side's requests.
    pub(super) fn handle_answer(&mut self, now: Duration, answer: Answer) {
        match &mut self.role {
            Role::Demand(proof, _) => proof.handle_answer(now, answer),
            Role::Fetch(responder) => responder.handle_answer(now, answer),
            _ => {}
        }
    }

    /// Returns the next call to the KME, if any.
    pub(super) fn poll_request(&mut self, now: Duration) -> Option<(RequestOrigin, KmeRequest)> {
        let connection = self.connection;
        match &mut self.role {
            Role::Demand(proof, _) => {
                Some((RequestOrigin::Proof(connection), proof.poll_request(now)?))
            }
            Role::Fetch(responder) => {
                Some((RequestOrigin::Responder(connection), responder.poll_request(now)?))
            }
            _ => None,
        }
    }

    /// Returns the next key announcement for the control stream.
    pub(super) fn poll_message(&mut self) -> Option<KeyMessage> {
        match &mut self.role {
            Role::Demand(proof, _) => proof.poll_message(),
            Role::Fetch(responder) => responder.poll_message(),
            _ => None,
        }
    }

    /// Returns when to call [`handle_timeout`](Self::handle_timeout) and poll again without other cause.
    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        match &self.role {
            Role::Demand(proof, _) => proof.poll_timeout(),
            Role::Fetch(responder) => responder.poll_timeout(),
            _ => None,
        }
    }

    /// Ends a proof that exceeded its own time limit.
    pub(super) fn handle_timeout(&mut self, now: Duration) {
        if let Role::Demand(proof, _) = &mut self.role {
            proof.handle_timeout(now);
        }
    }

    /// Returns the outcome of the proof, once. The server gets the key that proved the client's name, in messages10 for
    /// its first messages.
    pub(super) fn poll_outcome(
        &mut self,
        now: Duration,
        exporters: &Exporters,
        keyring: &mut Keyring,
    ) -> Option<Result<Option<(KeyId, KmeKey)>, LinkFailure>> {
        match &mut self.role {
            Role::Demand(proof, tried) => match proof.state() {
                ProofState::Pending => None,
                ProofState::Failed(failure) => {
                    // The attempt cost no key.
                    tried.over |= matches!(failure, ProofFailure::NoKey { .. });
                    Some(Err(unproven(&keyring.config, &failure)))
                }
                ProofState::Proven => {
                    tried.over = true;
                    Some(self.proven(now, exporters, keyring))
                }
            },
            Role::Fetch(responder) => {
                let answered = responder.answered()?;
                Some(match answered {
                    Ok(()) => Ok(None),
                    Err(reason) => Err(LinkFailure::Ours(CloseCode::KeySupply, reason)),
                })
            }
            Role::Hold(key_ids) => {
                let opener = keyring.receiver(self.connection)?.opener(self.connection)?;
                let held = key_ids.iter().any(|key_id| opener.contains(key_id.as_bytes()));
                held.then_some(Ok(None))
            }
            Role::Answer(_) | Role::Announcement | Role::Over => None,
        }
    }

    /// Handles a successful proof on the server: the client is the SAE that it claims to be.
    fn proven(
        &mut self,
        now: Duration,
        exporters: &Exporters,
        keyring: &mut Keyring,
    ) -> Result<Option<(KeyId, KmeKey)>, LinkFailure> {
        keyring.authenticated(now, self.source, &self.sae);
        let Role::Demand(proof, _tried) = mem::replace(&mut self.role, Role::Over) else {
            return Ok(None);
        };
        if keyring.seals_messages() {
            attach(now, self.connection, &self.sae, exporters, keyring)?;
        }
        Ok(proof.into_key())
    }
}

/// Attaches the receiver of this peer's keys on this connection, in messages10.
fn attach(
    now: Duration,
    connection: u64,
    sae: &str,
    exporters: &Exporters,
    keyring: &mut Keyring,
) -> Result<(), LinkFailure> {
    let internal = |e| LinkFailure::Ours(CloseCode::Internal, format!("message keys: {e}"));
    keyring.attach_receiver(now, connection, sae, exporters).map_err(internal)
}

/// Returns the failure of a proof. If the keys differ, the log gets more details than the peer.
fn unproven(config: &QkdConfig, failure: &ProofFailure) -> LinkFailure {
    let code = CloseCode::from_code(failure.code()).unwrap_or(CloseCode::Proof);
    if !matches!(failure, ProofFailure::WrongProof(_)) {
        return LinkFailure::Ours(code, failure.to_string());
    }
    let told = "the proof does not fit the announced key";
    let why = format!(
        "{failure}: it holds another key than this host, SAE {}, has from {}. Either the two KMEs \
         disagree, and their operators must compare what they hold for these two SAEs, or somebody \
         poses as that SAE",
        config.sae_id, config.kme_url,
    );
    LinkFailure::Quietly { code, told, why }
}
