//! The requests of key state machines to the KME, and the answers.

use std::{fmt, time::Duration};

use axon_envelope::{KeyId, KmeKey};

pub use etsi_qkd014::pool::Stock;

/// What a key is fetched for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum KeyPurpose {
    /// A dialler's TLS external PSK.
    Bootstrap,
    /// The same key at the server, for a handshake that named it.
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
        /// How many keys.
        number: u32,
        /// What for.
        purpose: KeyPurpose,
    },
    /// `dec_keys`: the keys that `master` named.
    Dec {
        /// The SAE that called `enc_keys`.
        master: String,
        /// Their names.
        key_ids: Vec<KeyId>,
        /// What for.
        purpose: KeyPurpose,
    },
    /// `status`: what is in stock with `slave`.
    Status {
        /// The other SAE.
        slave: String,
    },
}

/// A [`KmeRequest`] and how it ended.
#[derive(Debug)]
pub struct Answer {
    /// As it was asked.
    pub request: KmeRequest,
    /// From asking to the end.
    pub took: Duration,
    /// What came of it.
    pub outcome: Result<Fetched, RequestFailure>,
}

/// What a successful [`KmeRequest`] gave.
pub enum Fetched {
    /// Keys, in the order asked for. All that were asked for, or it is a [`RequestFailure`]; of
    /// `enc_keys` for messages without those that were used before.
    Keys(Vec<(KeyId, KmeKey)>),
    /// The answer to [`KmeRequest::Status`].
    Stock(Stock),
}

/// Why a [`KmeRequest`] failed. Never holds anything of a key.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RequestFailure {
    /// What can be done about it.
    pub kind: FailureKind,
    /// For log and status.
    pub text: String,
    /// The pause that the KME asked for before it is asked again.
    pub retry_after: Option<Duration>,
}

/// What can be done about a [`RequestFailure`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum FailureKind {
    /// No connection; nothing was asked. Try later.
    Unreachable,
    /// The KME cannot serve it now; an empty store is one reason. Try later.
    Unavailable,
    /// The KME knows no such key, or refuses such a request. Asking again is useless.
    Refused,
    /// The KME does not accept this SAE, or this host does not accept the KME: a matter of
    /// certificates.
    Unauthorized,
    /// Cut off or answered badly after the request may have arrived: its keys may be consumed.
    Ambiguous,
    /// The KME gave keys whose key_IDs it had given before. They are not used.
    Repeated,
    /// Too many calls are waiting; nothing was asked.
    Busy,
    /// This host could not even put the request.
    Invalid,
}

impl RequestFailure {
    /// One after which the KME asked for no pause.
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
    /// What a peer may know: nothing of where the KME is or what it said.
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

    /// Whether the same call may succeed later by itself.
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
