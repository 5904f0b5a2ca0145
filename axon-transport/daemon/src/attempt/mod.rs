//! Single links made by hand: for tools that show what a daemon accepts and what it refuses.
//!
//! An attempt speaks the real protocol over a real connection, with the engine's machines for the dial and the opening.
//! It can break the rules as a hostile peer can: with an unknown PSK identity, a wrong PSK, or a tampered or repeated
//! envelope.

mod control;
mod dialler;
mod keys;

use std::{fmt, net::SocketAddr, time::Duration};

use axon_envelope::{Delivery, Kind, Route, TopicHash};
use axon_shm::{ids::Gid, qos::Qos};
use axon_tls::Negotiated;
use axon_transport::{
    MessageInfo,
    config::Config,
    graph::{Endpoint, EndpointKind},
    internal::SessionKey,
};
use quinn::{Connection, SendStream};

use self::{
    control::{AttemptControl, Unreadable},
    dialler::{AttemptDialler, LINK, close},
};
use crate::{
    engine::{
        link::opening::OpenedConnection,
        refusal::Refusal,
        rings::RingSample,
        sample::{frames::Frames, protection::Seal, stream_header::StreamHeader},
    },
    error::GatewayError,
    link::{CloseCode, Elected, GraphUpdate, LinkMessage, Owners, Subscribe},
    owner::{ChannelBinding, EXPORTER, prove},
};

/// Time for the daemon to close a link that it refuses.
const REFUSAL_TIMEOUT: Duration = Duration::from_secs(5);
/// Time for the daemon to subscribe, and for a key to become READY.
const ROUTE_TIMEOUT: Duration = Duration::from_secs(10);

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

/// A change to an envelope before it is sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Tamper {
    /// No change: the daemon accepts it.
    Nothing,
    /// One bit of the ciphertext is flipped.
    FlipBit,
    /// It is sent twice.
    Replay,
}

/// A link that a daemon accepted. It takes messages and keys only during a call.
pub struct AcceptedLink {
    connection: Connection,
    control: AttemptControl,
    opened: OpenedConnection,
    dialler: AttemptDialler,
}

impl fmt::Debug for AcceptedLink {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("AcceptedLink").field("opened", &self.opened).finish_non_exhaustive()
    }
}

/// Tries to become the link of the daemon at `target`. In qkd `sae` is that daemon's SAE ID.
///
/// Must run within a tokio runtime; uses the settings' KME, addresses and domain.
///
/// # Errors
/// [`Refusal`], which names the refusing side and the reason.
pub async fn link(
    config: &Config,
    target: SocketAddr,
    sae: Option<&str>,
    bootstrap: Bootstrap,
) -> Result<AcceptedLink, Refusal> {
    let here = |e: GatewayError| Refusal::here(CloseCode::Internal, e);
    let mut dialler = AttemptDialler::start(config, target, sae).map_err(here)?;
    let connection = match bootstrap {
        Bootstrap::Genuine => dialler.connect(None).await?,
        _ => dialler.connect_forged(bootstrap).await?,
    };
    let (opened, control) = dialler.open(&connection).await?;
    Ok(AcceptedLink { connection, control, opened, dialler })
}

impl AcceptedLink {
    /// Returns the parameters that the handshake negotiated.
    pub fn negotiated(&self) -> &Negotiated {
        &self.opened.negotiated
    }

    /// Returns the host name that the peer states.
    pub fn host(&self) -> &str {
        &self.opened.hello.host
    }

    /// Announces a publisher of `topic`, waits until the daemon subscribes to it (it must have a subscription of that
    /// topic and type), and sends one sealed sample, changed as `tamper` says.
    ///
    /// # Errors
    /// [`Refusal`] when the daemon closes the link for it, or never subscribes.
    pub async fn send_envelope(
        mut self,
        topic: &str,
        type_name: &str,
        tamper: Tamper,
    ) -> Result<(), Refusal> {
        let session =
            SessionKey::generate().ok_or_else(|| internal("no key for a session can be made"))?;
        let publisher = Gid::new(session.id(), 1);
        self.announce(&session, publisher, topic, type_name)?;
        let (subscribe, frame) = tokio::time::timeout(ROUTE_TIMEOUT, async {
            let subscribe = self.subscription(topic).await?;
            let frame = self.seal(publisher, topic, type_name).await?;
            Ok::<_, Refusal>((subscribe, frame))
        })
        .await
        .map_err(|_| Refusal::network("the daemon did not subscribe, or no key became READY"))??;

        let header = StreamHeader {
            reliable: true,
            copy: false,
            short: false,
            acknowledged: false,
            route: subscribe.route,
            of: publisher,
        };
        let mut stream = self.connection.open_uni().await.map_err(internal)?;
        if write(&mut stream, &header.encode(), frame, tamper).await.is_err() {
            return Err(self.closed().await);
        }
        let closed = tokio::time::timeout(REFUSAL_TIMEOUT, async {
            // The daemon's READY and GRAPH must not pile up.
            while self.next().await.is_ok() {}
            self.connection.closed().await
        });
        match (closed.await, tamper) {
            (Ok(error), _) => Err(Refusal::of(&error)),
            (Err(_), Tamper::Nothing) => {
                close(&self.connection, CloseCode::Goodbye, "done");
                Ok(())
            }
            (Err(_), _) => Ok(()),
        }
    }

    /// Elects the link, and announces a publisher of a session that this side proves to be its own.
    fn announce(
        &mut self,
        session: &SessionKey,
        publisher: Gid,
        topic: &str,
        type_name: &str,
    ) -> Result<(), Refusal> {
        let endpoint = Endpoint::new(publisher, EndpointKind::Publisher, topic, type_name)
            .with_qos(Qos::keep_all());
        let graph =
            GraphUpdate { version: 1, before: 0, added: vec![endpoint], ..GraphUpdate::default() };
        let mut binding = ChannelBinding::default();
        self.connection
            .export_keying_material(&mut binding, EXPORTER, b"")
            .map_err(|_| internal("the connection has no exporter"))?;
        let proof = prove(session, &binding, self.dialler.daemon())
            .ok_or_else(|| internal("the session cannot be proved"))?;
        let messages = [
            LinkMessage::Elected(Elected { link: rand::random(), election: 1, standby: None }),
            LinkMessage::Owners(Owners { proofs: vec![proof] }),
            LinkMessage::Graph(graph),
        ];
        messages.iter().try_for_each(|message| self.control.send(message)).map_err(internal)
    }

    /// Waits for the daemon's subscription to `topic`.
    async fn subscription(&mut self, topic: &str) -> Result<Subscribe, Refusal> {
        loop {
            match self.next().await {
                Ok(Some(LinkMessage::Subscribe(subscribe))) if subscribe.topic == topic => {
                    return Ok(subscribe);
                }
                Ok(_) => {}
                Err(_) => return Err(self.closed().await),
            }
        }
    }

    /// Returns a sealed sample in the form of a stream: length and envelope.
    async fn seal(
        &mut self,
        publisher: Gid,
        topic: &str,
        type_name: &str,
    ) -> Result<Vec<u8>, Refusal> {
        let now = self.dialler.now();
        let sealing = self.opened.sealing.take();
        let (Some(keyring), Some(sealing)) = (self.dialler.keyring(), sealing) else {
            return Err(internal("envelopes exist in messages10 alone"));
        };
        keyring.attach_sender(now, LINK, &sealing.exporters, sealing.first).map_err(internal)?;
        if let Some(mut seal) = self.protection() {
            seal.demand(1, now);
        }
        let domain = self.dialler.config().domain;
        let hash = TopicHash::new(domain, topic, type_name).map_err(internal)?;
        let route = Route { kind: Kind::Topic, topic: hash };
        let sample =
            RingSample::new(MessageInfo::of(publisher, 1), b"an attempt".as_slice().into(), now);
        loop {
            let (now, mut frames) = (self.dialler.now(), Frames::default());
            if let Some(mut seal) = self.protection()
                && seal.write(&sample, route, Delivery::Reliable, None, &mut frames, now).is_ok()
            {
                return Ok(frames.take().concat());
            }
            if self.next().await.is_err() {
                return Err(self.closed().await);
            }
        }
    }

    /// Returns the protection that seals messages, once the sender of message keys is attached.
    fn protection(&mut self) -> Option<Seal<'_>> {
        let sender = self.dialler.keyring()?.sender(LINK)?;
        Some(Seal::Envelope { sender, connection: LINK })
    }

    /// Waits until something happens on the link, or to its keys. Returns the message that came, if it is not
    /// about keys.
    async fn next(&mut self) -> Result<Option<LinkMessage>, Unreadable> {
        self.dialler.say_keys(&mut self.control);
        tokio::select! {
            message = self.control.next(true) => match message? {
                LinkMessage::Keys(message) => {
                    let now = self.dialler.now();
                    if let Some(keyring) = self.dialler.keyring() {
                        // An error: session has no message keys, or the daemon broke a rule. It shows by a key that
                        // does not become READY.
                        let _ = keyring.handle_message(now, LINK, &message);
                    }
                    Ok(None)
                }
                message => Ok(Some(message)),
            },
            _ = self.dialler.wait(None) => Ok(None),
        }
    }

    /// Returns the reason why the daemon closed the link, whose control stream ended.
    async fn closed(&self) -> Refusal {
        match tokio::time::timeout(REFUSAL_TIMEOUT, self.connection.closed()).await {
            Ok(error) => Refusal::of(&error),
            Err(_) => Refusal::network("the control stream ended without a reason"),
        }
    }
}

fn internal(error: impl fmt::Display) -> Refusal {
    Refusal::here(CloseCode::Internal, error)
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
