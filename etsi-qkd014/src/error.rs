//! The error type of this crate. A program can act on its variants.
//!
//! No variant ever contains key bytes, an answer body, or the contents of a private key file. Text
//! of a KME appears only from the error `message` that the specification defines.

use std::time::Duration;

use serde_json::Value;

/// The end of the connection that refused the TLS handshake.
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

/// The reason why a call to a KME, or the creation of a [`Client`](crate::Client), failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A setting of the [`ClientBuilder`](crate::ClientBuilder) is missing or unusable.
    #[error("{setting}: {reason}")]
    Config {
        /// The method of the builder.
        setting: &'static str,
        /// The defect, and the accepted values.
        reason: String,
    },
    /// The request is not possible. Nothing was sent.
    #[error("request refused before it was sent: {reason}")]
    Request {
        /// The request, and what is possible.
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
        /// The end that refused.
        refused_by: RefusedBy,
        /// The reason, and what to check.
        reason: String,
    },
    /// Status 400 (clauses 5.2 to 5.4): the KME did not accept the request.
    #[error("KME answered 400 Bad Request: {message}")]
    BadRequest {
        /// The KME's message; empty if its answer contained none.
        message: String,
        /// The KME's details (clause 6.5).
        details: Vec<Value>,
    },
    /// Status 401 (clauses 5.2 to 5.4): this SAE is not permitted to do that.
    #[error("KME answered 401 Unauthorized: {message}")]
    Unauthorized {
        /// The KME's message; empty if its answer contained none.
        message: String,
        /// The KME's details (clause 6.5).
        details: Vec<Value>,
    },
    /// Status 503 (clauses 5.2 to 5.4): an error of the server, for example an empty key store.
    #[error("KME answered 503 Service Unavailable: {message}")]
    Unavailable {
        /// The KME's message; empty if its answer contained none.
        message: String,
        /// The KME's details (clause 6.5).
        details: Vec<Value>,
        /// The `Retry-After` header, if it is in seconds.
        retry_after: Option<Duration>,
    },
    /// A status code that the specification does not list. Redirects are among them, because they
    /// are never followed.
    #[error("KME answered status {code}, which ETSI GS QKD 014 does not list: {message}")]
    Status {
        /// The HTTP status code.
        code: u16,
        /// The KME's message; empty if its answer contained none.
        message: String,
    },
    /// The answer does not have the form of clause 6.
    #[error("malformed answer, {what}: {reason}")]
    Malformed {
        /// The part of the answer, for example `keys[2].key`.
        what: String,
        /// The defect; never the text itself.
        reason: String,
    },
    /// The answer is well formed but violates a promise of the specification.
    #[error("the KME broke {clause}: expected {expected}, got {got}")]
    Check {
        /// The clause, for example `ETSI GS QKD 014 V1.1.1 clause 6.3`.
        clause: &'static str,
        /// What the clause and the request require.
        expected: String,
        /// What the answer contains.
        got: String,
    },
    /// The answer is larger than [`max_body`](crate::ClientBuilder::max_body).
    #[error("the answer is larger than the limit of {limit} bytes")]
    BodyTooLarge {
        /// The limit in bytes.
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
    /// The connection was lost when the request may already have left.
    #[error("connection lost before the answer was complete: {reason}")]
    Interrupted {
        /// A description of the failure.
        reason: String,
    },
    /// `enc_keys` or `dec_keys` failed when the request may already have reached the KME. The KME
    /// may have handed out, and so destroyed, the keys of this call. After `enc_keys`, ask for
    /// other keys; the lost ones are never used. After `dec_keys`, tell the master to choose other
    /// keys.
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
    /// Returns whether the failed call may have consumed keys; see
    /// [`KeyPossiblyConsumed`](Error::KeyPossiblyConsumed).
    #[must_use]
    pub fn keys_may_be_consumed(&self) -> bool {
        matches!(self, Self::KeyPossiblyConsumed { .. })
    }

    /// Returns the failure inside [`KeyPossiblyConsumed`](Error::KeyPossiblyConsumed), or else the
    /// error itself.
    #[must_use]
    pub fn cause(&self) -> &Self {
        match self {
            Self::KeyPossiblyConsumed { cause, .. } => cause.cause(),
            other => other,
        }
    }

    /// Returns whether the same call may succeed later without any change: the KME was unreachable,
    /// slow, cut off or answered
    /// 503. This does not tell whether keys were consumed.
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

    /// Returns the HTTP status code, if the KME answered with one other than 200.
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
