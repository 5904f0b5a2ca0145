//! Reasons for refusals that rustls's own errors do not express.

use std::fmt;
use std::sync::Arc;

use rustls::pki_types::CertificateDer;
use rustls::{CertificateError, Error, OtherError};
use webpki::EndEntityCert;

/// The reason why a peer, or this host's own certificate, is refused.
#[derive(Clone, PartialEq, Eq)]
pub(super) enum Refused {
    /// A certificate of X.509 version 1 or 2. It has no extensions, and therefore names no host.
    OldVersion,
    /// A pin that was valid until this day. The reason is sent to the refused peer, so it does not contain the trust
    /// file's name for that peer.
    PinEnded(String),
}

/// Returns whether this is an X.509 certificate of version 1 or 2.
pub(super) fn is_of_old_version(certificate: &CertificateDer<'_>) -> bool {
    matches!(EndEntityCert::try_from(certificate), Err(webpki::Error::UnsupportedCertVersion))
}

impl fmt::Display for Refused {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::OldVersion => f.write_str(
                "it is X.509 version 1 (or 2), which has no extensions and so no names; have it issued \
                 again as version 3 with a subjectAltName",
            ),
            Self::PinEnded(day) => write!(
                f,
                "the pin of this key ended: its last day in the trust file is {day} (UTC); pin the key \
                 again, or correct the clock"
            ),
        }
    }
}

/// rustls formats an error that is not its own with `Debug`.
impl fmt::Debug for Refused {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

impl std::error::Error for Refused {}

impl From<Refused> for Error {
    fn from(refused: Refused) -> Self {
        CertificateError::Other(OtherError(Arc::new(refused))).into()
    }
}
