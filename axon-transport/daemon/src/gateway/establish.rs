//! From a completed QUIC handshake to a link that awaits its election: HELLO both ways and, in qkd,
//! the proof of the client's name (`docs/formats.md`, sections 2 and 6).

use std::{net::SocketAddr, sync::Arc, time::Duration};

use axon_envelope::{KeyId, KmeKey};
use axon_tls::{
    KeyExchange, Negotiated,
    identity::{Auth, CaMaterial},
    qkd::PskIdentity,
    quic::{ALPN, negotiated},
};
use axon_transport::config::{Config, QkdKex, Security};
use quinn::{Connection, ConnectionError, VarInt};
use rustls_pki_types::CertificateDer;

use super::{
    context::{Context, chain},
    control::{ControlError, ControlReader, ControlWriter, Outbox},
    keyring::PeerKeys,
    prove::Proof,
    refusal::Refusal,
    tls_settings::tls_cipher,
};
use crate::{
    keys::{Completion, Exporters},
    link::{CloseCode, Hello, Message, Order, Side, check},
};

/// HELLO must be done in this time.
pub(crate) const HELLO_TIMEOUT: Duration = Duration::from_secs(5);
/// The proof must be done in this time and that of its KME calls: this side's, and three tries of
/// the peer's.
const PROOF_TIMEOUT: Duration = Duration::from_secs(3);
const PROOF_CALLS: u32 = 4;

/// How long the proof may take, where a KME call may take as long as `kme_answer`.
pub(crate) fn proof_limit(kme_answer: Duration) -> Duration {
    PROOF_TIMEOUT + PROOF_CALLS * kme_answer
}

/// A connection whose peer said who it is and, in qkd, proved it.
pub(super) struct Established {
    /// This daemon's number for the connection.
    pub(super) number: u64,
    /// The connection.
    pub(super) connection: Connection,
    /// Which end this side is.
    pub(super) side: Side,
    /// What the handshake agreed on.
    pub(super) negotiated: Negotiated,
    /// The peer's HELLO.
    pub(super) hello: Hello,
    /// Control messages from the peer.
    pub(super) reader: ControlReader,
    /// Control messages to the peer; written by a task of their own.
    pub(super) outbox: Outbox,
    /// What may come next.
    pub(super) order: Order,
    /// What seals its messages, in messages10.
    pub(super) sealing: Option<Sealing>,
}

/// The message keys of a connection in messages10.
pub(super) struct Sealing {
    /// Those of the peer's SAE.
    pub(super) keys: Arc<PeerKeys>,
    /// What binds them to this connection.
    pub(super) exporters: Exporters,
    /// Server: the key that proved the client's name, its first sending key.
    pub(super) first: Option<(KeyId, KmeKey)>,
}

impl std::fmt::Debug for Established {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Established")
            .field("number", &self.number)
            .field("side", &self.side)
            .field("hello", &self.hello)
            .finish_non_exhaustive()
    }
}

/// Closes with a code and says why.
pub(super) fn close(connection: &Connection, code: CloseCode, reason: &str) {
    connection.close(VarInt::from_u32(code.code()), close_text(reason));
}

/// The bytes of `reason` that fit into a close: at most 300, and no part of a character.
pub(crate) fn close_text(reason: &str) -> &[u8] {
    let end = reason.char_indices().map(|(i, c)| i + c.len_utf8()).take_while(|e| *e <= 300).last();
    &reason.as_bytes()[..end.unwrap_or(0)]
}

/// Carries a connection through HELLO and proof. `dialled` is the SAE that the client dialled.
/// On failure the connection is closed and the refusal says why.
pub(super) async fn establish(
    context: &Arc<Context>,
    connection: Connection,
    side: Side,
    ours: Hello,
    dialled: Option<&str>,
) -> Result<Established, Refusal> {
    let number = context.next_link();
    let result = run(context, &connection, side, ours, dialled, number).await;
    if let Some(keyring) = &context.keyring {
        keyring.proof_over(number);
    }
    result.map_err(|failure| {
        let (refusal, closes) = failure.into_refusal(connection.close_reason().as_ref());
        if let Some((code, told)) = closes {
            close(&connection, code, &told);
        }
        if let Some(keyring) = &context.keyring {
            keyring.forget_connection(number);
        }
        refusal
    })
}

/// What went wrong on the way.
pub(crate) enum Failure {
    /// This side refuses.
    Ours(CloseCode, String),
    /// This side refuses, and tells the peer less than its own people.
    Quietly { code: CloseCode, told: &'static str, why: String },
    /// The peer closed, or the connection broke.
    Connection,
    /// The control stream said so; the connection may know more.
    Control(ControlError),
}

impl Failure {
    /// The refusal for log and status, and the code and text with which this side closes, if it does.
    /// `ended` is why the connection ended, if it did.
    pub(crate) fn into_refusal(
        self,
        ended: Option<&ConnectionError>,
    ) -> (Refusal, Option<(CloseCode, String)>) {
        let lost = |fallback: String| match ended {
            Some(error) => Refusal::of(error),
            None => Refusal::network(fallback),
        };
        let (refusal, code) = match self {
            Self::Quietly { code, told, why } => {
                return (Refusal::here(code, why), Some((code, told.into())));
            }
            Self::Ours(code, reason) => (Refusal::here(code, reason), Some(code)),
            Self::Connection => (lost("the connection broke".into()), None),
            Self::Control(error) => match error.code() {
                Some(code) => (Refusal::here(code, &error), Some(code)),
                None => (lost(error.to_string()), Some(CloseCode::Internal)),
            },
        };
        let closes = code.map(|code| (code, refusal.reason.clone()));
        (refusal, closes)
    }
}

impl From<ControlError> for Failure {
    fn from(error: ControlError) -> Self {
        Self::Control(error)
    }
}

async fn run(
    context: &Arc<Context>,
    connection: &Connection,
    side: Side,
    ours: Hello,
    dialled: Option<&str>,
    number: u64,
) -> Result<Established, Failure> {
    let negotiated = agreed(&context.config, negotiated(connection))?;
    admits(context.closed())?;
    let psk_sae = psk_sae(context, side, &negotiated, dialled).await?;
    let qkd = context.keyring.is_some();
    let mut order = Order::new(side, qkd);

    let hello = async {
        let (mut writer, mut reader) = open_control(connection, side).await?;
        if side == Side::Client {
            writer.send(&Message::Hello(ours.clone())).await?;
        }
        let message = reader.next().await?;
        order.accept(&message).map_err(|e| Failure::Ours(CloseCode::OutOfOrder, e.to_string()))?;
        let Message::Hello(theirs) = message else {
            return Err(Failure::Ours(CloseCode::OutOfOrder, "HELLO must come first".into()));
        };
        check(&ours, &theirs, psk_sae.as_deref())
            .map_err(|m| Failure::Ours(m.code, m.to_string()))?;
        if matches!(context.auth(), Some(Auth::Ca(_))) {
            names_its_host(&chain(connection), &theirs)?;
        }
        if side == Side::Server {
            writer.send(&Message::Hello(ours.clone())).await?;
        }
        Ok((writer, reader, theirs))
    };
    let late = |_| Failure::Ours(CloseCode::OutOfOrder, "no HELLO within 5 s".into());
    let (writer, mut reader, theirs) =
        tokio::time::timeout(HELLO_TIMEOUT, hello).await.map_err(late)??;
    reader.hello_checked();
    order.hello_checked(theirs.daemon < ours.daemon);
    let outbox = Outbox::spawn(connection.clone(), writer);

    let sealing = match (&context.keyring, &theirs.sae) {
        (Some(keyring), Some(sae)) => {
            let proof = Proof { keyring, connection, number, sae, outbox: &outbox };
            let limit = proof_limit(keyring.config.kme_answer_timeout);
            let late =
                |_| Failure::Ours(CloseCode::KeySupply, format!("no proof within {limit:?}"));
            let sealing = tokio::time::timeout(limit, async {
                match side {
                    Side::Server => proof.demand(&mut reader, &mut order).await,
                    Side::Client => proof.give(&mut reader, &mut order).await,
                }
            })
            .await
            .map_err(late)??;
            order.proven();
            sealing
        }
        _ => None,
    };
    reader.proven();
    Ok(Established {
        number,
        connection: connection.clone(),
        side,
        negotiated,
        hello: theirs,
        reader,
        outbox,
        order,
        sealing,
    })
}

/// What the handshake agreed on, checked against the settings once more: a defect in the TLS
/// configuration must end here and not in a weaker link.
pub(crate) fn agreed(
    config: &Config,
    negotiated: Option<Negotiated>,
) -> Result<Negotiated, Failure> {
    let internal = |text: &str| Failure::Ours(CloseCode::Internal, text.into());
    let negotiated = negotiated.ok_or_else(|| internal("the handshake is not complete"))?;
    let wanted = match &config.security {
        Security::Classic(_) => KeyExchange::X25519MlKem768,
        Security::Qkd(qkd) => match qkd.kex {
            QkdKex::PskKe => KeyExchange::PskKe,
            QkdKex::PskDheKe => KeyExchange::PskDheKe,
        },
    };
    if negotiated.key_exchange != wanted || negotiated.cipher != tls_cipher(config.cipher) {
        return Err(internal("the handshake agreed on something else than the settings"));
    }
    if negotiated.alpn != ALPN {
        return Err(internal("the handshake agreed on another protocol than axon/1"));
    }
    Ok(negotiated)
}

/// Refuses a peer while this host does not know whom to trust; `closed` says why.
pub(crate) fn admits(closed: Option<String>) -> Result<(), Failure> {
    let told = "this host cannot read whom it trusts, and takes nobody; its log says more";
    match closed {
        Some(why) => Err(Failure::Quietly { code: CloseCode::NotAllowed, told, why }),
        None => Ok(()),
    }
}

/// In `ca` a certificate stands for the hosts that it names: the peer must be one of them. In
/// `pinned` the pin has the peer's name, and what it calls itself counts for nothing.
pub(crate) fn names_its_host(chain: &[CertificateDer<'_>], theirs: &Hello) -> Result<(), Failure> {
    if chain.first().is_some_and(|c| CaMaterial::is_for_host(c, &theirs.host)) {
        return Ok(());
    }
    let text = format!(
        "its certificate does not name the host {:?}; give it one with that DNS name (no wildcard)",
        theirs.host
    );
    Err(Failure::Ours(CloseCode::NotAllowed, text))
}

/// The peer's SAE by the PSK, in qkd. A server spends the PSK here: the client's Finished was
/// verified.
async fn psk_sae(
    context: &Context,
    side: Side,
    negotiated: &Negotiated,
    dialled: Option<&str>,
) -> Result<Option<String>, Failure> {
    let Some(keyring) = &context.keyring else { return Ok(None) };
    if side == Side::Client {
        return Ok(dialled.map(Into::into));
    }
    let identity = negotiated.psk_identity.as_deref().unwrap_or_default();
    let parsed = PskIdentity::parse(identity)
        .map_err(|e| Failure::Ours(CloseCode::Internal, e.to_string()))?;
    match keyring.spent(identity, parsed.key_id()).await {
        Completion::First => Ok(Some(parsed.client_sae().to_owned())),
        Completion::Reused => Err(reused()),
    }
}

/// The PSK of the handshake was spent before.
pub(crate) fn reused() -> Failure {
    let text = "this PSK has completed a handshake before; a KME key is used once";
    Failure::Ours(CloseCode::KeyReused, text.into())
}

async fn open_control(
    connection: &Connection,
    side: Side,
) -> Result<(ControlWriter, ControlReader), Failure> {
    let (send, receive) = match side {
        Side::Client => connection.open_bi().await,
        Side::Server => connection.accept_bi().await,
    }
    .map_err(|_| Failure::Connection)?;
    Ok((ControlWriter::new(send), ControlReader::new(receive)))
}

/// Where a peer is, for log and status.
pub(crate) fn peer_text(sae: Option<&str>, address: SocketAddr) -> String {
    sae.map_or_else(|| address.to_string(), |sae| format!("{sae} at {address}"))
}
