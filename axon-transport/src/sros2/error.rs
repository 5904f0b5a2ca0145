//! The errors of permissions, and the denials.

use std::{fmt, io, path::PathBuf};

use super::names::TopicUse;
use crate::text::plain;

/// Maximum length shown of a name from a file.
const SHOWN: usize = 200;

/// The reason why an enclave's permissions cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PermissionsError {
    /// The file cannot be read.
    #[error(
        "{}: {source}; `ros2 security create_enclave` makes it, and `ros2 security create_permission` renews it",
        path.display()
    )]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// The error of the system.
        source: io::Error,
    },
    /// The file is no permissions file, or contains something that is not understood. Then nothing in it is used.
    #[error("{}: {}", path.display(), plain(what, 1000))]
    Malformed {
        /// The file.
        path: PathBuf,
        /// The defect, with its line.
        what: String,
    },
    /// It has no grant for the enclave.
    #[error(
        "{}: it has no grant whose subject_name is CN={}, but {}; \
         `ros2 security create_permission` writes one",
        path.display(),
        plain(enclave, SHOWN),
        plain(known, 1000)
    )]
    NoGrant {
        /// The file.
        path: PathBuf,
        /// The enclave.
        enclave: String,
        /// The subjects of its grants.
        known: String,
    },
    /// The grant is not valid yet, or no longer.
    #[error(
        "{}: the permissions of enclave {} are valid from {not_before} to {not_after} UTC (line {line}); \
         `ros2 security create_permission` renews them",
        path.display(),
        plain(enclave, SHOWN)
    )]
    NotValid {
        /// The file.
        path: PathBuf,
        /// The enclave.
        enclave: String,
        /// The first moment, as it is written in the file.
        not_before: String,
        /// The last moment, as it is written in the file.
        not_after: String,
        /// The line of the validity.
        line: u32,
    },
    /// Nothing is allowed in the session's domain.
    #[error(
        "{}: the permissions of enclave {} allow nothing in domain {domain}, but in {allowed} (line {line}); \
         `ros2 security create_permission` writes them for the domain in ROS_DOMAIN_ID",
        path.display(),
        plain(enclave, SHOWN)
    )]
    Domain {
        /// The file.
        path: PathBuf,
        /// The enclave.
        enclave: String,
        /// The session's domain.
        domain: u32,
        /// The domains in which something is allowed, for people.
        allowed: String,
        /// The line of the grant.
        line: u32,
    },
}

/// The reason why an enclave may not have an endpoint. Its text names the enclave, the DDS topic, the file and the
/// line.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Denial(pub(super) Box<Denied>);

#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Denied {
    pub(super) enclave: String,
    pub(super) path: PathBuf,
    pub(super) does: TopicUse,
    pub(super) topic: String,
    pub(super) reason: DenialReason,
}

/// The part of the permissions that denies it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum DenialReason {
    /// An expression of a `deny_rule`, on this line.
    Rule(u32),
    /// The default on this line; no rule fits.
    Default(u32),
    /// The validity on this line: the grant is not valid now.
    NotValid { not_before: String, not_after: String, line: u32 },
}

impl Denial {
    /// Returns the line of the file that decides.
    pub fn line(&self) -> u32 {
        match self.0.reason {
            DenialReason::Rule(line)
            | DenialReason::Default(line)
            | DenialReason::NotValid { line, .. } => line,
        }
    }
}

impl fmt::Display for Denial {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Denied { enclave, path, does, topic, reason } = &*self.0;
        let (enclave, topic, line) = (plain(enclave, SHOWN), plain(topic, 1000), self.line());
        let path = path.display();
        write!(f, "enclave {enclave} may not {} {topic}: ", does.verb())?;
        match reason {
            DenialReason::Rule(_) => write!(f, "denied by line {line} of {path}"),
            DenialReason::Default(_) => {
                write!(f, "no rule allows it, and line {line} of {path} denies the rest")
            }
            DenialReason::NotValid { not_before, not_after, .. } => write!(
                f,
                "its permissions are valid from {not_before} to {not_after} UTC, by line {line} of {path}"
            ),
        }
    }
}
