//! The reason why a connection did not become, or stay, a link: a text for log and status.

use std::fmt;

use quinn::ConnectionError;
use serde::Serialize;

use crate::link::CloseCode;

/// The side that refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum RefusedBy {
    /// This side.
    Here,
    /// The peer.
    Peer,
    /// Neither: the peer could not be reached.
    Network,
}

/// A connection that was refused.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct Refusal {
    /// The side that refused.
    pub by: RefusedBy,
    /// The close code or TLS alert by its name, `unreachable` when there is none.
    pub name: String,
    /// The difference or failure, in some cases with advice.
    pub reason: String,
    /// The TLS alert, if the handshake failed with one.
    pub alert: Option<u8>,
}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let by = match self.by {
            RefusedBy::Here => "refused here",
            RefusedBy::Peer => "refused by the peer",
            RefusedBy::Network => "not reached",
        };
        write!(f, "{by}: {}: {}", self.name, self.reason)
    }
}

impl std::error::Error for Refusal {}

impl Refusal {
    /// Makes a refusal by this side.
    pub(crate) fn here(code: CloseCode, reason: impl fmt::Display) -> Self {
        Self {
            by: RefusedBy::Here,
            name: code.name().into(),
            reason: reason.to_string(),
            alert: None,
        }
    }

    /// Makes a refusal for a peer that could not be reached, or was not even tried.
    pub(crate) fn network(reason: impl fmt::Display) -> Self {
        Self {
            by: RefusedBy::Network,
            name: "unreachable".into(),
            reason: reason.to_string(),
            alert: None,
        }
    }

    /// Makes the refusal that `error` of a connection means.
    pub(crate) fn of(error: &ConnectionError) -> Self {
        let (by, name, reason) = match error {
            ConnectionError::ApplicationClosed(close) => {
                let code = close.error_code.into_inner();
                let name = CloseCode::from_code(code)
                    .map_or_else(|| format!("code {code:#x}"), |c| c.name().into());
                (RefusedBy::Peer, name, text(&close.reason))
            }
            ConnectionError::ConnectionClosed(close) => {
                (RefusedBy::Peer, transport_name(error), text(&close.reason))
            }
            ConnectionError::TransportError(e) => {
                (RefusedBy::Here, transport_name(error), e.reason.clone())
            }
            ConnectionError::Reset => (
                RefusedBy::Network,
                "reset".into(),
                "the peer's daemon was restarted and does not know this connection".into(),
            ),
            other => (RefusedBy::Network, "unreachable".into(), other.to_string()),
        };
        let alert = axon_tls::quic::tls_alert(error);
        let reason = match alert.and_then(meaning) {
            Some(meaning) if reason.is_empty() => meaning.into(),
            Some(meaning) => format!("{meaning} ({reason})"),
            None => reason,
        };
        Self { by, name, reason, alert }
    }
}

/// Returns a peer's text, bounded and printable.
fn text(bytes: &[u8]) -> String {
    axon_transport::internal::text::plain(&String::from_utf8_lossy(bytes), 300)
}

fn transport_name(error: &ConnectionError) -> String {
    match axon_tls::quic::tls_alert(error) {
        Some(alert) => {
            let name = match alert {
                40 => "handshake_failure",
                42 => "bad_certificate",
                43 => "unsupported_certificate",
                44 => "certificate_revoked",
                45 => "certificate_expired",
                46 => "certificate_unknown",
                47 => "illegal_parameter",
                48 => "unknown_ca",
                49 => "access_denied",
                51 => "decrypt_error",
                70 => "protocol_version",
                109 => "missing_extension",
                115 => "unknown_psk_identity",
                116 => "certificate_required",
                120 => "no_application_protocol",
                _ => return format!("TLS alert {alert}"),
            };
            format!("TLS alert {name}")
        }
        None => "QUIC transport error".into(),
    }
}

/// Returns the meaning of an alert between two AXON daemons.
fn meaning(alert: u8) -> Option<&'static str> {
    Some(match alert {
        40 => {
            "no common key exchange or cipher: AXON offers X25519MLKEM768 and one cipher, no more"
        }
        42 | 43 | 46 | 48 => "the key or certificate is not trusted by the side that refuses",
        44 => "the certificate was revoked",
        45 => "the certificate has expired, or a clock is wrong",
        49 => "a client read this host's key, as `axon trust scan` does, and closed the connection",
        116 => "the dialler showed no key or certificate",
        51 => "the PSK binder does not fit: the two sides hold different keys",
        109 => "no PSK was offered to a daemon in qkd: AXON_SECURITY_MODE differs",
        115 => "the PSK identity is not known: its KME key cannot be had",
        120 => "the peer does not speak axon/1",
        _ => return None,
    })
}
