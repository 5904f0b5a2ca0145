//! Why permissions cannot be used, and why they do not allow something.

use std::{fmt, io, path::PathBuf};

use super::names::TopicUse;
use crate::text::plain;

/// Shown of a name from a file.
const SHOWN: usize = 200;

/// Why an enclave's permissions cannot be used.
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
        /// What the system said.
        source: io::Error,
    },
    /// It is no such file, or says something that is not understood: nothing of it counts then.
    #[error("{}: {}", path.display(), plain(what, 1000))]
    Malformed {
        /// The file.
        path: PathBuf,
        /// What is wrong, and in which line.
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
    /// The grant does not count yet, or any more.
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
        /// The first moment, as it is written.
        not_before: String,
        /// The last one.
        not_after: String,
        /// The line that says so.
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
        /// The domains in which something is allowed.
        allowed: String,
        /// The line of the grant.
        line: u32,
    },
}

/// Why an enclave may not have an endpoint. Its text names the enclave, the topic of DDS, the file and the line.
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

/// What denies it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum DenialReason {
    /// The line of an expression of a `deny_rule`.
    Rule(u32),
    /// No rule fits, and this line says that the default is to deny.
    Default(u32),
    /// The grant is not valid now, by this line.
    NotValid { not_before: String, not_after: String, line: u32 },
}

impl Denial {
    /// The line of the file that decides.
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
