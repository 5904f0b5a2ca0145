//! One error type whose variants a program can act on.
//!
//! No variant ever carries key bytes, an answer body, or the contents of a private key file: a
//! KME's own words appear only where the specification gives it an error `message`.

use std::time::Duration;

use serde_json::Value;

/// Which end of the connection refused the TLS handshake.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum RefusedBy {
    /// This client refused the KME: its certificate or its parameters.
    Client,
    /// The KME refused this client: usually the SAE's certificate.
    Kme,
}

impl std::fmt::Display for RefusedBy {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Client => "this client",
            Self::Kme => "the KME",
        })
    }
}

/// Why a call to a KME, or the making of a [`Client`](crate::Client), failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A setting of the [`ClientBuilder`](crate::ClientBuilder) is missing or unusable.
    #[error("{setting}: {reason}")]
    Config {
        /// The builder's method.
        setting: &'static str,
        /// What was wrong with it, and what is accepted.
        reason: String,
    },
    /// The request cannot be put as asked. Nothing was sent.
    #[error("request refused before it was sent: {reason}")]
    Request {
        /// What was asked and what is possible.
        reason: String,
    },
    /// No connection: name resolution or TCP failed. Nothing was sent.
    #[error("KME {kme} is unreachable: {reason}")]
    Unreachable {
        /// Host and port.
        kme: String,
        /// The system's reason.
        reason: String,
    },
    /// The TLS handshake was refused. No request was served.
    #[error("TLS with KME {kme} was refused by {refused_by}: {reason}")]
    Tls {
        /// Host and port.
        kme: String,
        /// Who refused.
        refused_by: RefusedBy,
        /// Why, and what to look at.
        reason: String,
    },
    /// Status 400 (clauses 5.2 to 5.4): the KME did not accept the request.
    #[error("KME answered 400 Bad Request: {message}")]
    BadRequest {
        /// The KME's message; empty where its answer held none.
        message: String,
        /// The KME's details (clause 6.5).
        details: Vec<Value>,
    },
    /// Status 401 (clauses 5.2 to 5.4): this SAE may not do that.
    #[error("KME answered 401 Unauthorized: {message}")]
    Unauthorized {
        /// The KME's message; empty where its answer held none.
        message: String,
        /// The KME's details (clause 6.5).
        details: Vec<Value>,
    },
    /// Status 503 (clauses 5.2 to 5.4): an error of the server's side; an empty key store is one.
    #[error("KME answered 503 Service Unavailable: {message}")]
    Unavailable {
        /// The KME's message; empty where its answer held none.
        message: String,
        /// The KME's details (clause 6.5).
        details: Vec<Value>,
        /// The `Retry-After` header, where it gave seconds.
        retry_after: Option<Duration>,
    },
    /// A status code that the specification does not list. Redirects are among them: they are
    /// never followed.
    #[error("KME answered status {code}, which ETSI GS QKD 014 does not list: {message}")]
    Status {
        /// The HTTP status code.
        code: u16,
        /// The KME's message; empty where its answer held none.
        message: String,
    },
    /// The answer is not what clause 6 describes.
    #[error("malformed answer, {what}: {reason}")]
    Malformed {
        /// The part of the answer, as `keys[2].key`.
        what: String,
        /// What is wrong with it; never its text.
        reason: String,
    },
    /// The answer is well formed and breaks a promise of the specification.
    #[error("the KME broke {clause}: expected {expected}, got {got}")]
    Check {
        /// The clause, as `ETSI GS QKD 014 V1.1.1 clause 6.3`.
        clause: &'static str,
        /// What the clause and the request ask for.
        expected: String,
        /// What came.
        got: String,
    },
    /// The answer is larger than [`max_body`](crate::ClientBuilder::max_body).
    #[error("the answer is larger than the limit of {limit} bytes")]
    BodyTooLarge {
        /// The limit, bytes.
        limit: usize,
    },
    /// Time ran out.
    #[error("timed out after {after:?} ({phase})")]
    Timeout {
        /// `connect` or `answer`.
        phase: &'static str,
        /// The time allowed.
        after: Duration,
    },
    /// The connection was lost after the request may have left.
    #[error("connection lost before the answer was complete: {reason}")]
    Interrupted {
        /// What happened.
        reason: String,
    },
    /// `enc_keys` or `dec_keys` failed after the request may have reached the KME. It may have
    /// handed out, and so destroyed, the keys of this call. What to do next: after `enc_keys`, ask
    /// for other keys, the lost ones are simply never used; after `dec_keys`, tell the master to
    /// choose other keys.
    #[error("{call} failed and its keys may be consumed: {cause}")]
    KeyPossiblyConsumed {
        /// `enc_keys` or `dec_keys`.
        call: &'static str,
        /// The failure itself.
        #[source]
        cause: Box<Error>,
    },
}

impl Error {
    /// Whether keys may have been consumed by the failed call; see
    /// [`KeyPossiblyConsumed`](Error::KeyPossiblyConsumed).
    #[must_use]
    pub fn keys_may_be_consumed(&self) -> bool {
        matches!(self, Self::KeyPossiblyConsumed { .. })
    }

    /// The failure itself, below [`KeyPossiblyConsumed`](Error::KeyPossiblyConsumed).
    #[must_use]
    pub fn cause(&self) -> &Self {
        match self {
            Self::KeyPossiblyConsumed { cause, .. } => cause.cause(),
            other => other,
        }
    }

    /// Whether the same call may succeed later without anything being changed: the KME was
    /// unreachable, slow, cut off or answered 503. It says nothing of whether keys were consumed.
    #[must_use]
    pub fn is_transient(&self) -> bool {
        matches!(
            self.cause(),
            Self::Unreachable { .. }
                | Self::Timeout { .. }
                | Self::Interrupted { .. }
                | Self::Unavailable { .. }
        )
    }

    /// The HTTP status code, where the KME answered with one other than 200.
    #[must_use]
    pub fn status_code(&self) -> Option<u16> {
        match self.cause() {
            Self::BadRequest { .. } => Some(400),
            Self::Unauthorized { .. } => Some(401),
            Self::Unavailable { .. } => Some(503),
            Self::Status { code, .. } => Some(*code),
            _ => None,
        }
    }
}
