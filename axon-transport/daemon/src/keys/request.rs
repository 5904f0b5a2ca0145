//! The requests of key state machines to the KME, and the answers.

use std::{fmt, time::Duration};

use axon_envelope::{KeyId, KmeKey};

pub use etsi_qkd014::pool::Stock;

/// The purpose for which a key is fetched.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum KeyPurpose {
    /// A dialler's TLS external PSK.
    Bootstrap,
    /// The same key at the server, which fetches it for a handshake that named it.
    Accept,
    /// The proof of the client's name.
    Proof,
    /// Envelopes of `messages10`.
    Messages,
}

/// One call to the KME.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum KmeRequest {
    /// `enc_keys`: fresh 256-bit keys shared with `slave`. A failed call may have consumed keys and
    /// is never repeated as such.
    Enc {
        /// The other SAE.
        slave: String,
        /// Number of keys.
        number: u32,
        /// The purpose of the keys.
        purpose: KeyPurpose,
    },
    /// `dec_keys`: the keys that `master` named.
    Dec {
        /// The SAE that called `enc_keys`.
        master: String,
        /// The key_IDs of the keys.
        key_ids: Vec<KeyId>,
        /// The purpose of the keys.
        purpose: KeyPurpose,
    },
    /// `status`: asks for the number of keys in stock with `slave`.
    Status {
        /// The other SAE.
        slave: String,
    },
}

/// A [`KmeRequest`] and its result.
#[derive(Debug)]
pub struct Answer {
    /// The request, unchanged.
    pub request: KmeRequest,
    /// Time from the request to its end.
    pub took: Duration,
    /// The result of the request.
    pub outcome: Result<Fetched, RequestFailure>,
}

/// The result of a successful [`KmeRequest`].
pub enum Fetched {
    /// Keys, in the order of the request. Fewer keys than requested are a [`RequestFailure`], except that `enc_keys`
    /// for messages leaves out keys that were used before.
    Keys(Vec<(KeyId, KmeKey)>),
    /// The answer to [`KmeRequest::Status`].
    Stock(Stock),
}

/// The reason why a [`KmeRequest`] failed. It never contains a part of a key.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RequestFailure {
    /// The class of the failure.
    pub kind: FailureKind,
    /// The text for log and status.
    pub text: String,
    /// The pause that the KME asked for before it is asked again.
    pub retry_after: Option<Duration>,
}

/// The class of a [`RequestFailure`], which decides the reaction to it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum FailureKind {
    /// There is no connection, and no request was sent. Try later.
    Unreachable,
    /// The KME cannot serve the request now; an empty store is one reason. Try later.
    Unavailable,
    /// The KME knows no such key, or refuses the request. Repeating it is useless.
    Refused,
    /// The KME does not accept this SAE, or this host does not accept the KME: a matter of
    /// certificates.
    Unauthorized,
    /// The call was cut off or got an invalid answer after the request may have arrived: its keys may be consumed.
    Ambiguous,
    /// The KME gave keys whose key_IDs it had given before. They are not used.
    Repeated,
    /// Too many calls are waiting; no request was sent.
    Busy,
    /// This host could not even make the request.
    Invalid,
}

impl RequestFailure {
    /// Makes a failure after which the KME asked for no pause.
    pub fn new(kind: FailureKind, text: impl Into<String>) -> Self {
        Self { kind, text: text.into(), retry_after: None }
    }
}

impl fmt::Debug for Fetched {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Keys(keys) => f.debug_list().entries(keys.iter().map(|(id, _)| id)).finish(),
            Self::Stock(stock) => stock.fmt(f),
        }
    }
}

impl FailureKind {
    /// Returns the text that a peer may see: it does not contain where the KME is or what the KME answered.
    pub fn told(self) -> &'static str {
        match self {
            Self::Unreachable => "its KME is unreachable",
            Self::Unavailable => "its KME has no key now",
            Self::Refused => "its KME refused the request",
            Self::Unauthorized => "its KME and it do not accept each other",
            Self::Ambiguous => "its KME's answer was lost or unusable",
            Self::Repeated => "its KME gives keys a second time",
            Self::Busy => "too many calls wait for its KME",
            Self::Invalid => "the request could not be put",
        }
    }

    /// Returns whether the same call may succeed later without a change by a person.
    pub fn is_transient(self) -> bool {
        matches!(self, Self::Unreachable | Self::Unavailable | Self::Ambiguous | Self::Busy)
    }
}

impl fmt::Display for RequestFailure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.text)
    }
}

impl std::error::Error for RequestFailure {}
