//! Single links made by hand: for tools that show what a daemon accepts and what it refuses.
//!
//! An attempt speaks the real protocol over a real connection; what it can do beside the rules
//! (an unknown PSK identity, a wrong PSK, a tampered or repeated envelope) is what a hostile peer
//! could do as well.

use std::{net::SocketAddr, sync::Arc, time::Duration};

use axon_envelope::{Delivery, Kind, KmeKey, Route, TopicHash};
use axon_shm::{
    ids::{DaemonId, Gid},
    qos::Qos,
};
use axon_tls::{Negotiated, qkd::derive_psk};
use axon_transport::{
    MessageInfo,
    config::{Config, Security},
    graph::{Endpoint, EndpointKind},
    internal::SessionKey,
};
use quinn::SendStream;
use secrecy::ExposeSecret;

use super::{
    GatewayError, Refusal,
    context::Context,
    dial::{Target, dial, handshake},
    endpoint::Endpoints,
    establish::{Established, establish},
    frames::Frames,
    inbound::stream_header,
    keyring::Keyring,
    peer::binding,
    protection::{Protection, sample},
    queue::Sample,
    tls_settings::tls_cipher,
};
use crate::{
    keys,
    link::{CloseCode, Elected, Graph, Message, Owners, Side, Subscribe},
    owner::prove,
};

/// How long a daemon that refuses is given to say so.
const REFUSAL_TIMEOUT: Duration = Duration::from_secs(5);
/// How long a route, or a key for it, is waited for.
const ROUTE_TIMEOUT: Duration = Duration::from_secs(10);
/// A PSK identity that the server has to look up first is tried this often.
const TRIES: u32 = 12;

/// Which PSK a qkd attempt uses.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub enum Bootstrap {
    /// A key from the KME, as every daemon does.
    #[default]
    Genuine,
    /// A key and key_ID that no KME ever gave out.
    UnknownKeyId,
    /// A key_ID from the KME with one bit of its key flipped.
    WrongKey,
}

/// What is done to an envelope before it is sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Tamper {
    /// Nothing: it is accepted.
    Nothing,
    /// One bit of the ciphertext is flipped.
    FlipBit,
    /// It is sent twice.
    Replay,
}

/// A link that a daemon accepted.
#[derive(Debug)]
pub struct Link {
    established: Established,
    context: Arc<Context>,
    _endpoints: Endpoints,
}

/// Tries to become the link of the daemon at `target`. In qkd `sae` is its SAE ID.
///
/// Must run within a tokio runtime; uses the settings' KME, addresses and domain.
///
/// # Errors
/// [`Refusal`]: by whom and why.
pub async fn link(
    config: &Config,
    target: SocketAddr,
    sae: Option<&str>,
    bootstrap: Bootstrap,
) -> Result<Link, Refusal> {
    let here = |e: GatewayError| Refusal::here(CloseCode::Internal, e);
    let keyring = Keyring::start(config, keys::UsedKeys::in_memory).map_err(|e| here(e.into()))?;
    let keyring = keyring.map(|(keyring, events)| {
        tokio::spawn(Arc::clone(&keyring).run(events));
        keyring
    });
    // The lowest id there is: elections are this side's.
    let daemon = DaemonId::default();
    let config = Arc::new(config.clone());
    let context = Arc::new(Context::new(Arc::clone(&config), daemon, keyring).map_err(here)?);
    // Discovery datagrams find nobody who reads them.
    let (datagrams, _) = tokio::sync::mpsc::channel(1);
    let endpoints =
        Endpoints::bind(&config, &rand::random(), None, &datagrams).map_err(|e| here(e.into()))?;
    let to = Target {
        daemon: None,
        sae: sae.map(Into::into),
        addresses: vec![target],
        listed: false,
        standing: None,
        replaces: None,
    };
    let established = match bootstrap {
        Bootstrap::Genuine => dial(&context, &endpoints, &to).await?,
        _ => forged(&context, &endpoints, &to, bootstrap).await?,
    };
    Ok(Link { established, context, _endpoints: endpoints })
}

/// A dial on a PSK that the server must refuse.
async fn forged(
    context: &Arc<Context>,
    endpoints: &Endpoints,
    target: &Target,
    bootstrap: Bootstrap,
) -> Result<Established, Refusal> {
    let internal = |e: &dyn std::fmt::Display| Refusal::here(CloseCode::Internal, e);
    let (Security::Qkd(qkd), Some(keyring), Some(peer)) =
        (&context.config.security, &context.keyring, &target.sae)
    else {
        return Err(internal(&"a forged PSK needs qkd and the peer's SAE ID"));
    };
    let (key_id, key) = match bootstrap {
        Bootstrap::WrongKey => {
            let fetched = keyring.fetch_one(peer, context.next_link()).await;
            let (key_id, key) = fetched.map_err(|e| internal(&e))?;
            let mut wrong = *key.expose_secret();
            wrong[0] ^= 1;
            (key_id, KmeKey::take(&mut wrong))
        }
        _ => {
            let id: u128 = rand::random();
            let id = axon_envelope::KeyId::new(format!("{id:032x}")).map_err(|e| internal(&e))?;
            (id, KmeKey::take(&mut rand::random()))
        }
    };
    let id = String::from_utf8_lossy(key_id.as_bytes()).into_owned();
    let psk =
        derive_psk(key.expose_secret(), &id, &qkd.sae_id, peer, tls_cipher(context.config.cipher));
    let attempt = keys::Attempt { key_id, psk: Arc::new(psk.map_err(|e| internal(&e))?) };
    let client = context.qkd_client(&attempt).map_err(|e| internal(&e))?;
    let mut tries = 0;
    loop {
        tries += 1;
        match handshake(endpoints, target, &client).await {
            Ok(connection) => {
                let hello = context.hello.clone();
                return establish(context, connection, Side::Client, hello, Some(peer)).await;
            }
            // The server looks the key up after its first answer; what it says then counts.
            Err(refusal)
                if refusal.alert == Some(115)
                    && tries < if bootstrap == Bootstrap::WrongKey { TRIES } else { 3 } =>
            {
                tokio::time::sleep(Duration::from_millis(200)).await;
            }
            Err(refusal) => return Err(refusal),
        }
    }
}

impl Link {
    /// What the handshake agreed on.
    pub fn negotiated(&self) -> &Negotiated {
        &self.established.negotiated
    }

    /// The peer's host name, as it calls itself.
    pub fn host(&self) -> &str {
        &self.established.hello.host
    }

    /// Announces a publisher of `topic`, waits until the daemon subscribes to it (it must have a
    /// subscription of that topic and type), and sends one sealed sample, tampered with as told.
    ///
    /// # Errors
    /// [`Refusal`] when the daemon closes the link for it, or never subscribes.
    pub async fn send_envelope(
        mut self,
        topic: &str,
        type_name: &str,
        tamper: Tamper,
    ) -> Result<(), Refusal> {
        let internal = |e: &dyn std::fmt::Display| Refusal::here(CloseCode::Internal, e);
        let session =
            SessionKey::generate().ok_or_else(|| internal(&"no key for a session can be made"))?;
        let publisher = Gid::new(session.id(), 1);
        self.announce(&session, publisher, topic, type_name)?;
        let (subscribe, frame) = tokio::time::timeout(ROUTE_TIMEOUT, async {
            let subscribe = self.subscription(topic).await?;
            let frame = self.seal(publisher, topic, type_name).await?;
            Ok::<_, Refusal>((subscribe, frame))
        })
        .await
        .map_err(|_| Refusal::network("the daemon did not subscribe, or no key became READY"))??;

        let header = stream_header(true, subscribe.route, publisher);
        let mut stream = self.established.connection.open_uni().await.map_err(|e| internal(&e))?;
        let written = write(&mut stream, &header, frame, tamper).await;
        if written.is_err() {
            return Err(self.closed().await);
        }
        // Control messages are read on, so that READY and GRAPH do not pile up.
        let closed = tokio::time::timeout(REFUSAL_TIMEOUT, async {
            while self.established.reader.next().await.is_ok() {}
            self.established.connection.closed().await
        });
        match (closed.await, tamper) {
            (Ok(error), _) => Err(Refusal::of(&error)),
            (Err(_), Tamper::Nothing) => {
                super::establish::close(&self.established.connection, CloseCode::Goodbye, "done");
                Ok(())
            }
            (Err(_), _) => Ok(()),
        }
    }

    /// Announces a publisher of a session that this side proves to be its own.
    fn announce(
        &self,
        session: &SessionKey,
        publisher: Gid,
        topic: &str,
        type_name: &str,
    ) -> Result<(), Refusal> {
        let internal = |e: &dyn std::fmt::Display| Refusal::here(CloseCode::Internal, e);
        let endpoint = Endpoint {
            gid: publisher,
            kind: EndpointKind::Publisher,
            topic: topic.into(),
            type_name: type_name.into(),
            type_hash: Vec::new(),
            qos: Qos::keep_all(),
            node: String::new(),
            namespace: String::new(),
            enclave: String::new(),
        };
        let graph = Graph { version: 1, before: 0, added: vec![endpoint], ..Graph::default() };
        let binding = binding(&self.established.connection)
            .ok_or_else(|| internal(&"the connection has no exporter"))?;
        let proof = prove(session, &binding, self.context.hello.daemon);
        let proof = proof.ok_or_else(|| internal(&"the session cannot be proved"))?;
        self.established
            .outbox
            .send(Message::Elected(Elected { link: rand::random(), election: 1 }));
        self.established.outbox.send(Message::Owners(Owners { proofs: vec![proof] }));
        self.established.outbox.send(Message::Graph(graph));
        Ok(())
    }

    async fn subscription(&mut self, topic: &str) -> Result<Subscribe, Refusal> {
        loop {
            match self.established.reader.next().await {
                Ok(Message::Subscribe(subscribe)) if subscribe.topic == topic => {
                    return Ok(subscribe);
                }
                Ok(Message::Keys(message)) => self.key_message(&message),
                Ok(_) => {}
                Err(_) => return Err(self.closed().await),
            }
        }
    }

    fn key_message(&self, message: &keys::KeyMessage) {
        if let (Some(keyring), Some(sealing)) = (&self.context.keyring, &self.established.sealing) {
            let _ = sealing.keys.handle_message(keyring, self.established.number, message);
        }
    }

    /// A sealed sample as it goes on a stream: length and envelope.
    async fn seal(
        &mut self,
        publisher: Gid,
        topic: &str,
        type_name: &str,
    ) -> Result<Vec<u8>, Refusal> {
        let internal = |e: &dyn std::fmt::Display| Refusal::here(CloseCode::Internal, e);
        let connection = self.established.number;
        let (Some(keyring), Some(sealing)) =
            (self.context.keyring.clone(), &mut self.established.sealing)
        else {
            return Err(internal(&"envelopes exist in messages10 alone"));
        };
        let (keys, first) = (Arc::clone(&sealing.keys), sealing.first.take());
        keys.attach_sender(&keyring, connection, &sealing.exporters, first)
            .map_err(|e| internal(&e))?;
        let protection = Protection::Envelope { keyring, keys, connection };
        let domain = self.context.config.domain;
        let hash = TopicHash::new(domain, topic, type_name).map_err(|e| internal(&e))?;
        let route = Route { kind: Kind::Topic, topic: hash };
        let sample = greeting(publisher);
        protection.demand(1);
        let mut frames = Frames::default();
        while protection.write(&sample, route, Delivery::Reliable, &mut frames).is_err() {
            match tokio::time::timeout(ROUTE_TIMEOUT, self.established.reader.next()).await {
                Ok(Ok(Message::Keys(message))) => self.key_message(&message),
                Ok(Ok(_)) => {}
                Ok(Err(_)) => return Err(self.closed().await),
                Err(_) => return Err(Refusal::network("no key became READY")),
            }
        }
        Ok(frames.take().concat())
    }

    async fn closed(&self) -> Refusal {
        let closed = self.established.connection.closed();
        match tokio::time::timeout(REFUSAL_TIMEOUT, closed).await {
            Ok(error) => Refusal::of(&error),
            Err(_) => Refusal::network("the control stream ended without a reason"),
        }
    }
}

fn greeting(publisher: Gid) -> Sample {
    let info = MessageInfo::of(publisher, 1);
    sample(info, b"an attempt".to_vec())
}

async fn write(
    stream: &mut SendStream,
    header: &[u8],
    mut frame: Vec<u8>,
    tamper: Tamper,
) -> Result<(), quinn::WriteError> {
    stream.write_all(header).await?;
    if tamper == Tamper::FlipBit
        && let Some(byte) = frame.last_mut()
    {
        *byte ^= 1;
    }
    stream.write_all(&frame).await?;
    if tamper == Tamper::Replay {
        stream.write_all(&frame).await?;
    }
    Ok(())
}
