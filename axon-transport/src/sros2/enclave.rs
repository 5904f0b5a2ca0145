//! The permissions of the enclave of a session.

use std::{
    path::{Path, PathBuf},
    time::SystemTime,
};

use super::{
    Denial, PermissionsError, date,
    document::{self, MOST_EXPRESSIONS, common_name},
    error::{DenialReason, Denied},
    file,
    grant::{CompiledGrant, GrantDecision},
    names::{TopicUse, uses},
};
use crate::graph::EndpointKind;

/// The topics and services that a process of one enclave may publish, subscribe to, serve and call, according to the
/// `permissions.p7s` or `permissions.xml` of that enclave.
///
/// A session that [has them](crate::SessionOptions::permissions) refuses to create any other endpoint. They keep a
/// well-behaved process within its enclave. A malicious process could do without them; the
/// [rules](crate::access::AccessRules) of other hosts protect those hosts from it. For the same reason the signature of
/// the file is not verified: the CA's certificate that would verify it lies in the same folder as the file.
///
/// ```
/// use std::time::SystemTime;
///
/// use axon_transport::{graph::EndpointKind, sros2::EnclavePermissions};
///
/// let text = "<dds><permissions><grant name='/arm'><subject_name>CN=/arm</subject_name>
///     <validity><not_before>2026-01-01T00:00:00</not_before><not_after>2126-01-01T00:00:00</not_after></validity>
///     <allow_rule><domains><id>0</id></domains>
///       <publish><topics><topic>rt/joints</topic></topics></publish></allow_rule>
///     <default>DENY</default></grant></permissions></dds>";
/// let permissions = EnclavePermissions::parse(text, "permissions.xml", "/arm")?;
/// let check = |kind| permissions.check(kind, "/joints", 0, SystemTime::now());
/// assert_eq!(check(EndpointKind::Publisher), Ok(()));
/// assert_eq!(check(EndpointKind::Subscription).unwrap_err().line(), 5);
/// # Ok::<(), axon_transport::sros2::PermissionsError>(())
/// ```
#[derive(Clone, Debug)]
pub struct EnclavePermissions {
    enclave: String,
    path: PathBuf,
    /// The grants for the enclave, in their order. There is at least one.
    grants: Vec<CompiledGrant>,
}

impl EnclavePermissions {
    /// Reads the file of an enclave such as `/robot/arm`.
    ///
    /// # Errors
    /// The file cannot be read, everybody may write it, it is larger than 1 MiB, it has no grant for the enclave, or a
    /// grant for the enclave is not completely understood.
    pub fn read(path: impl AsRef<Path>, enclave: &str) -> Result<Self, PermissionsError> {
        let path = path.as_ref();
        Self::parse(&file::read(path)?, path, enclave)
    }

    /// Like [`read`](Self::read), for a text. Errors name `path` as its file.
    ///
    /// # Errors
    /// The errors of [`read`](Self::read) about the content.
    pub fn parse(
        text: &str,
        path: impl Into<PathBuf>,
        enclave: &str,
    ) -> Result<Self, PermissionsError> {
        let path = path.into();
        let malformed = |what| PermissionsError::Malformed { path: path.clone(), what };
        let all = document::parse(text).map_err(malformed)?;
        let mut known = Vec::new();
        let mut grants = Vec::new();
        let mut expressions = 0;
        for grant in all {
            let subject = grant.subject.as_ref().map_or("", |(subject, _)| subject);
            if common_name(subject) == Some(enclave) {
                let criteria = grant.rules.iter().flat_map(|rule| &rule.criteria);
                expressions += criteria.map(|criteria| criteria.topics.len()).sum::<usize>();
                grants.push(CompiledGrant::new(grant).map_err(malformed)?);
            } else if known.len() < 20 {
                known.push(subject.to_owned());
            }
        }
        if grants.is_empty() {
            let known = if known.is_empty() { "none at all".into() } else { known.join("; ") };
            return Err(PermissionsError::NoGrant { path, enclave: enclave.to_owned(), known });
        }
        if expressions > MOST_EXPRESSIONS {
            return Err(malformed(format!("more than {MOST_EXPRESSIONS} expressions")));
        }
        Ok(Self { enclave: enclave.to_owned(), path, grants })
    }

    /// Returns the enclave.
    pub fn enclave(&self) -> &str {
        &self.enclave
    }

    /// Returns the path of the file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Checks that a session may be opened in a domain at this time, like a DDS participant that joins it.
    ///
    /// # Errors
    /// The permissions are not valid at this time, or allow nothing in that domain.
    pub fn check_domain(&self, domain: u32, now: SystemTime) -> Result<(), PermissionsError> {
        let (path, enclave) = (self.path.clone(), self.enclave.clone());
        let grant = match self.grant(now) {
            Ok(grant) => grant,
            Err(document::Validity { not_before, not_after, line }) => {
                let (not_before, not_after) = (not_before.clone(), not_after.clone());
                let line = *line;
                return Err(PermissionsError::NotValid {
                    path,
                    enclave,
                    not_before,
                    not_after,
                    line,
                });
            }
        };
        if grant.counts_in(domain) {
            return Ok(());
        }
        let (allowed, line) = (grant.domains(), grant.line);
        Err(PermissionsError::Domain { path, enclave, domain, allowed, line })
    }

    /// Checks that the enclave may have an endpoint of this kind and name in a domain at this time. A client needs
    /// permissions for both requests and responses, and so does a server.
    ///
    /// # Errors
    /// The first operation that the enclave is denied.
    pub fn check(
        &self,
        kind: EndpointKind,
        name: &str,
        domain: u32,
        now: SystemTime,
    ) -> Result<(), Denial> {
        let grant = self.grant(now);
        for &(does, part) in uses(kind) {
            let topic = part.dds_name(name);
            let reason = match grant {
                Ok(grant) => match grant.decide(domain, does, &topic) {
                    GrantDecision::Allowed => continue,
                    GrantDecision::DeniedByRule(line) => DenialReason::Rule(line),
                    GrantDecision::DeniedByDefault(line) => DenialReason::Default(line),
                },
                Err(document::Validity { not_before, not_after, line }) => DenialReason::NotValid {
                    not_before: not_before.clone(),
                    not_after: not_after.clone(),
                    line: *line,
                },
            };
            return Err(self.denial(does, topic, reason));
        }
        Ok(())
    }

    fn denial(&self, does: TopicUse, topic: String, reason: DenialReason) -> Denial {
        let (enclave, path) = (self.enclave.clone(), self.path.clone());
        Denial(Box::new(Denied { enclave, path, does, topic, reason }))
    }

    /// Returns the first valid grant, or else the validity of the last one.
    fn grant(&self, now: SystemTime) -> Result<&CompiledGrant, &document::Validity> {
        let now = date::of_clock(now);
        let last = &self.grants[self.grants.len() - 1];
        self.grants.iter().find(|grant| grant.is_valid(now)).ok_or(&last.validity)
    }
}
