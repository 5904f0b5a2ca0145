//! The kind of a message, and the topic or service to which it belongs.

use core::fmt;

use sha2::{Digest, Sha256};

/// The kind of a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[repr(u8)]
pub enum Kind {
    /// A sample of a topic.
    Topic = 0,
    /// A request to a service.
    Request = 1,
    /// A service's response.
    Response = 2,
}

impl Kind {
    pub(crate) fn from_byte(byte: u8) -> Option<Self> {
        match byte {
            0 => Some(Self::Topic),
            1 => Some(Self::Request),
            2 => Some(Self::Response),
            _ => None,
        }
    }
}

/// The name of a topic or service on the wire: the first half of SHA-256(domain u32 big-endian,
/// lp(name), lp(type name)).
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TopicHash(pub [u8; 16]);

/// The error for a topic or type name of more than 65,535 bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("a topic or type name of {0} bytes: at most 65,535 can be hashed")]
pub struct NameTooLong(pub usize);

impl TopicHash {
    /// Hashes the fully qualified name and the type name of a topic, in a domain.
    ///
    /// # Errors
    /// [`NameTooLong`] if either name has more than 65,535 bytes.
    pub fn new(domain: u32, topic: &str, type_name: &str) -> Result<Self, NameTooLong> {
        let mut hash = Sha256::new();
        hash.update(domain.to_be_bytes());
        for name in [topic, type_name] {
            let length = u16::try_from(name.len()).map_err(|_| NameTooLong(name.len()))?;
            hash.update(length.to_be_bytes());
            hash.update(name);
        }
        let mut half = [0; 16];
        half.copy_from_slice(&hash.finalize()[..16]);
        Ok(Self(half))
    }
}

impl fmt::Display for TopicHash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl fmt::Debug for TopicHash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "TopicHash({self})")
    }
}

/// The kind and the topic or service of a message. They are authenticated: a message opens under no
/// other route.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Route {
    /// The kind: sample, request or response.
    pub kind: Kind,
    /// The topic or service.
    pub topic: TopicHash,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_do_not_run_into_each_other() {
        let hash = |domain, topic, ty| TopicHash::new(domain, topic, ty).unwrap();
        assert_ne!(hash(0, "/ab", "c"), hash(0, "/a", "bc"));
        assert_ne!(hash(0, "/a", "b"), hash(1, "/a", "b"));
    }

    #[test]
    fn a_name_that_has_no_length_prefix_is_refused() {
        let name = "x".repeat(65_536);
        assert_eq!(TopicHash::new(0, &name, "t").unwrap_err(), NameTooLong(65_536));
        assert_eq!(TopicHash::new(0, "t", &name).unwrap_err(), NameTooLong(65_536));
        assert!(TopicHash::new(0, &name[1..], "t").is_ok());
    }
}
