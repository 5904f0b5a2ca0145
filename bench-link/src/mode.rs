//! The security modes in which AXON is measured.

use clap::ValueEnum;

/// Where the keys of a link come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Mode {
    /// X25519MLKEM768.
    Classic,
    /// A KME key for each QUIC session.
    Session,
    /// That, and a KME key for every ten messages.
    Messages10,
}

impl Mode {
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Classic => "classic",
            Self::Session => "session",
            Self::Messages10 => "messages10",
        }
    }

    /// Whether keys come from a KME.
    pub(crate) fn is_qkd(self) -> bool {
        self != Self::Classic
    }

    /// The variables that select it.
    pub(crate) fn settings(self) -> Vec<(&'static str, String)> {
        if !self.is_qkd() {
            return vec![("AXON_SECURITY_MODE", "classic".to_owned())];
        }
        vec![
            ("AXON_SECURITY_MODE", "qkd".to_owned()),
            ("AXON_QKD_KEY_MODE", self.name().to_owned()),
        ]
    }
}
