//! The security modes that the demo shows and that benchmarks measure.

use clap::ValueEnum;

/// A method of establishing keys between two hosts.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Mode {
    /// X25519MLKEM768.
    Classic,
    /// A KME key for each QUIC session.
    Session,
    /// A KME key for each QUIC session, and a KME key for every ten messages.
    Messages10,
}

impl Mode {
    /// All modes, in the order of the demo.
    pub(crate) const ALL: [Self; 3] = [Self::Classic, Self::Session, Self::Messages10];

    /// Returns the name of the route between hosts.
    pub(crate) fn route(self) -> &'static str {
        match self {
            Self::Classic => "QUIC classic",
            Self::Session => "QUIC qkd/session",
            Self::Messages10 => "QUIC qkd/messages10",
        }
    }

    /// Returns the text that file names contain.
    pub(crate) fn stem(self) -> &'static str {
        match self {
            Self::Classic => "classic",
            Self::Session => "session",
            Self::Messages10 => "messages10",
        }
    }

    /// Returns whether keys come from KMEs.
    pub(crate) fn is_qkd(self) -> bool {
        self != Self::Classic
    }

    /// Returns the variables that select the mode.
    pub(crate) fn settings(self) -> impl Iterator<Item = (&'static str, &'static str)> {
        let key_mode = match self {
            Self::Classic => None,
            Self::Session => Some("session"),
            Self::Messages10 => Some("messages10"),
        };
        let mode = if self.is_qkd() { "qkd" } else { "classic" };
        [("AXON_SECURITY_MODE", mode)]
            .into_iter()
            .chain(key_mode.map(|key_mode| ("AXON_QKD_KEY_MODE", key_mode)))
    }
}
