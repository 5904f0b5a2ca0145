//! The reasons for which a connection does not become a link, and the checks that every link has to pass.

use std::{net::SocketAddr, time::Duration};

use axon_tls::{KeyExchange, Negotiated, identity::CaMaterial, quic::ALPN};
use axon_transport::config::{Config, QkdKex, Security};
use quinn_proto::ConnectionError;
use rustls_pki_types::CertificateDer;

use crate::{
    engine::{
        quic::{control_stream::ControlError, tls_settings::tls_cipher},
        refusal::Refusal,
    },
    link::{CloseCode, LinkHello},
};

/// Timeout of HELLO.
pub(crate) const HELLO_TIMEOUT: Duration = Duration::from_secs(5);

/// Timeout of the proof, without the time for its KME calls: one of this side and three tries of the peer.
const PROOF_TIMEOUT: Duration = Duration::from_secs(3);

const PROOF_CALLS: u32 = 4;

/// Returns the timeout of the proof if a KME call may take up to `kme_answer`.
pub(crate) fn proof_limit(kme_answer: Duration) -> Duration {
    PROOF_TIMEOUT + PROOF_CALLS * kme_answer
}

/// Returns the bytes of `reason` that fit into a close: at most 300, without a partial character.
pub(crate) fn close_text(reason: &str) -> &[u8] {
    let end = reason.char_indices().map(|(i, c)| i + c.len_utf8()).take_while(|e| *e <= 300).last();
    &reason.as_bytes()[..end.unwrap_or(0)]
}

/// A failure before the connection became a link.
pub(crate) enum LinkFailure {
    /// This side refuses, with this code and reason.
    Ours(CloseCode, String),
    /// This side refuses, and tells the peer less than its own log.
    Quietly { code: CloseCode, told: &'static str, why: String },
    /// The peer closed the connection, or it broke.
    Connection,
    /// The control stream reported this error; the connection may know more.
    Control(ControlError),
}

impl LinkFailure {
    /// Returns the refusal for log and status, and the code and text with which this side closes, if it does. `ended`
    /// is the connection's error, if it ended.
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

impl From<ControlError> for LinkFailure {
    fn from(error: ControlError) -> Self {
        Self::Control(error)
    }
}

/// Checks the outcome of the handshake against the settings once more: a defect in the TLS configuration must end here
/// and not in a weaker link.
pub(crate) fn agreed(
    config: &Config,
    negotiated: Option<Negotiated>,
) -> Result<Negotiated, LinkFailure> {
    let internal = |text: &str| LinkFailure::Ours(CloseCode::Internal, text.into());
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

/// Refuses a peer while this host has no readable list of trusted peers. `closed` is the reason.
pub(crate) fn admits(closed: Option<String>) -> Result<(), LinkFailure> {
    let told = "this host cannot read its list of trusted peers, and refuses every peer; its log says more";
    match closed {
        Some(why) => Err(LinkFailure::Quietly { code: CloseCode::NotAllowed, told, why }),
        None => Ok(()),
    }
}

/// Checks that a certificate in `ca` names the peer's host. In `pinned` the pin states the peer's name, and the name in
/// its HELLO is ignored.
pub(crate) fn names_its_host(
    chain: &[CertificateDer<'_>],
    theirs: &LinkHello,
) -> Result<(), LinkFailure> {
    if chain.first().is_some_and(|c| CaMaterial::is_for_host(c, &theirs.host)) {
        return Ok(());
    }
    let text = format!(
        "its certificate does not name the host {:?}; give it one with that DNS name (no wildcard)",
        theirs.host
    );
    Err(LinkFailure::Ours(CloseCode::NotAllowed, text))
}

/// Returns the failure of a handshake whose PSK was spent before.
pub(crate) fn reused() -> LinkFailure {
    let text = "this PSK has completed a handshake before; a KME key is used once";
    LinkFailure::Ours(CloseCode::KeyReused, text.into())
}

/// Returns the peer's SAE ID and address for log and status.
pub(crate) fn peer_text(sae: Option<&str>, address: SocketAddr) -> String {
    sae.map_or_else(|| address.to_string(), |sae| format!("{sae} at {address}"))
}
