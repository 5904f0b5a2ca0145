//! The proof of the client's name, from either end (`docs/formats.md`, section 2).

use std::{sync::Arc, time::Duration};

use axon_transport::config::QkdConfig;
use quinn::Connection;

use super::{
    control::{ControlReader, Outbox},
    establish::{Failure, Sealing},
    keyring::{Keyring, PeerKeys},
};
use crate::{
    keys::{ClientProof, Exporters, KeyMessage, Origin, ProofFailure, ProofResponder, ProofState},
    link::{CloseCode, Message, Order},
};

/// A proof that costs a key, and counts against the client unless it succeeds: also where the
/// connection ends in the middle of it.
struct Tried<'a, 'p> {
    proof: &'a Proof<'p>,
    over: bool,
}

impl Tried<'_, '_> {
    fn cost_nothing(&mut self) {
        self.over = true;
    }
}

impl Drop for Tried<'_, '_> {
    fn drop(&mut self) {
        if !self.over {
            let Proof { keyring, connection, sae, .. } = self.proof;
            keyring.acceptor.unproven(connection.remote_address().ip(), sae);
        }
    }
}

/// The proof of the client's name, from either end.
pub(super) struct Proof<'a> {
    pub(super) keyring: &'a Arc<Keyring>,
    pub(super) connection: &'a Connection,
    pub(super) number: u64,
    pub(super) sae: &'a str,
    pub(super) outbox: &'a Outbox,
}

impl Proof<'_> {
    fn exporters(&self) -> Result<Exporters, Failure> {
        Exporters::derive(|out, label| self.connection.export_keying_material(out, label, b""))
            .map_err(|_| Failure::Ours(CloseCode::Internal, "no TLS exporter".into()))
    }

    fn say(&self, message: KeyMessage) {
        self.outbox.send(Message::Keys(message));
    }

    /// In messages10: the keys of this peer, ready to receive on this connection.
    fn attach(&self, exporters: &Exporters) -> Result<Arc<PeerKeys>, Failure> {
        let internal = |e: &dyn std::fmt::Display| {
            Failure::Ours(CloseCode::Internal, format!("message keys: {e}"))
        };
        let keys = self.keyring.peer(self.sae).map_err(|e| internal(&e))?;
        keys.attach_receiver(self.keyring, self.number, exporters, self.outbox.clone())
            .map_err(|e| internal(&e))?;
        Ok(keys)
    }

    /// The next key message, in its order.
    async fn next(
        &self,
        reader: &mut ControlReader,
        order: &mut Order,
    ) -> Result<KeyMessage, Failure> {
        loop {
            let message = reader.next().await?;
            order
                .accept(&message)
                .map_err(|e| Failure::Ours(CloseCode::OutOfOrder, e.to_string()))?;
            if let Message::Keys(message) = message {
                return Ok(message);
            }
        }
    }

    /// Server: announces a fresh key and takes nothing but the right READY.
    pub(super) async fn demand(
        &self,
        reader: &mut ControlReader,
        order: &mut Order,
    ) -> Result<Option<Sealing>, Failure> {
        let exporters = self.exporters()?;
        let clock = &self.keyring.clock;
        let mut answers = self.keyring.proof_answers(self.number);
        let mut proof = ClientProof::new(clock.now(), self.sae, &exporters);
        let mut tried = Tried { proof: self, over: false };
        // One read at a time, held across the loop: a cancelled read would lose its place.
        let mut read = Box::pin(self.next(reader, order));
        loop {
            while let Some(request) = proof.poll_request(clock.now()) {
                self.keyring.submit(Origin::Proof(self.number), request);
            }
            while let Some(message) = proof.poll_message() {
                self.say(message);
            }
            match proof.state() {
                ProofState::Pending => {}
                ProofState::Proven => break,
                ProofState::Failed(failure) => {
                    if matches!(failure, ProofFailure::NoKey { .. }) {
                        tried.cost_nothing();
                    }
                    return Err(unproven(&self.keyring.config, &failure));
                }
            }
            let until = proof.poll_timeout().map_or(Duration::from_secs(1), |at| {
                at.saturating_sub(clock.now()).min(Duration::from_secs(1))
            });
            tokio::select! {
                Some(answer) = answers.recv() => proof.handle_answer(clock.now(), answer),
                message = &mut read => {
                    proof.handle_message(clock.now(), &message?);
                    // At most one message proves or fails; another read is started only if not.
                    if matches!(proof.state(), ProofState::Pending) {
                        let text = "the message is no answer to the announced key";
                        return Err(Failure::Ours(CloseCode::OutOfOrder, text.into()));
                    }
                }
                () = tokio::time::sleep(until) => proof.handle_timeout(clock.now()),
            }
        }
        drop(read);
        tried.cost_nothing();
        self.keyring.authenticated(self.connection.remote_address().ip(), self.sae);
        if !self.keyring.seals_messages() {
            return Ok(None);
        }
        let keys = self.attach(&exporters)?;
        Ok(Some(Sealing { keys, exporters, first: proof.into_key() }))
    }

    /// Client: answers the server's ANNOUNCE.
    pub(super) async fn give(
        &self,
        reader: &mut ControlReader,
        order: &mut Order,
    ) -> Result<Option<Sealing>, Failure> {
        let exporters = self.exporters()?;
        if self.keyring.seals_messages() {
            let keys = self.give_as_receiver(&exporters, reader, order).await?;
            return Ok(Some(Sealing { keys, exporters, first: None }));
        }
        let clock = &self.keyring.clock;
        let mut answers = self.keyring.proof_answers(self.number);
        let mut responder = ProofResponder::new(self.sae, &exporters);
        let announce = self.next(reader, order).await?;
        responder.handle_message(clock.now(), &announce).map_err(|violation| {
            let code = CloseCode::from_code(violation.code()).unwrap_or(CloseCode::Malformed);
            Failure::Ours(code, violation.to_string())
        })?;
        loop {
            while let Some(request) = responder.poll_request(clock.now()) {
                self.keyring.submit(Origin::Responder(self.number), request);
            }
            while let Some(message) = responder.poll_message() {
                self.say(message);
            }
            match responder.answered() {
                Some(Ok(())) => return Ok(None),
                Some(Err(reason)) => return Err(Failure::Ours(CloseCode::KeySupply, reason)),
                None => {}
            }
            let until = responder.poll_timeout().map_or(Duration::from_secs(1), |at| {
                at.saturating_sub(clock.now()).min(Duration::from_secs(1))
            });
            tokio::select! {
                Some(answer) = answers.recv() => responder.handle_answer(clock.now(), answer),
                () = tokio::time::sleep(until) => {}
            }
        }
    }

    /// Client in messages10: the announced key is the server's first sending key, so the receiver
    /// of message keys answers.
    async fn give_as_receiver(
        &self,
        exporters: &Exporters,
        reader: &mut ControlReader,
        order: &mut Order,
    ) -> Result<Arc<PeerKeys>, Failure> {
        let keys = self.attach(exporters)?;
        let announce = self.next(reader, order).await?;
        keys.handle_message(self.keyring, self.number, &announce)
            .map_err(|e| Failure::Ours(CloseCode::Malformed, e.to_string()))?;
        let KeyMessage::Announce(key_ids) = announce else {
            return Err(Failure::Ours(CloseCode::OutOfOrder, "ANNOUNCE was due".into()));
        };
        // READY is in the outbox once the key is held; ELECTED must not overtake it.
        let held = |keys: &PeerKeys| {
            keys.with_receiver(self.keyring, |_, receiver| {
                receiver.opener(self.number).is_some_and(|opener| {
                    key_ids.iter().any(|key_id| opener.contains(key_id.as_bytes()))
                })
            })
        };
        loop {
            let changed = keys.changed.notified();
            if held(&keys) {
                return Ok(keys.clone());
            }
            tokio::select! {
                () = changed => {}
                () = tokio::time::sleep(Duration::from_millis(20)) => {}
                _ = self.connection.closed() => return Err(Failure::Connection),
            }
        }
    }
}

/// What the peer is told, and what the log says: there is more in it where keys differ.
pub(crate) fn unproven(config: &QkdConfig, failure: &ProofFailure) -> Failure {
    let code = CloseCode::from_code(failure.code()).unwrap_or(CloseCode::Proof);
    if !matches!(failure, ProofFailure::WrongProof(_)) {
        return Failure::Ours(code, failure.to_string());
    }
    let told = "the proof does not fit the announced key";
    let why = format!(
        "{failure}: it holds another key than this host, SAE {}, has from {}. Either the two KMEs \
         disagree, and their operators must compare what they hold for these two SAEs, or somebody \
         poses as that SAE",
        config.sae_id, config.kme_url,
    );
    Failure::Quietly { code, told, why }
}
