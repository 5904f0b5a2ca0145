//! The first key of a link: the side that fetches it, the time for which it is kept, and the point at which it is spent
//! (docs/formats.md, sections 1 and 2).

mod acceptor;
mod dialler;
mod limits;
mod seen_set;
#[cfg(test)]
mod tests;

pub use acceptor::{Acceptor, Lookup, Resolver};
pub use dialler::{BootstrapDialler, DialDecision, DialKey, DialRefusal};

/// The status of a completed handshake: the first under its key, or a later one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[must_use]
pub enum Completion {
    /// The handshake was the first under its key. The key is erased now.
    First,
    /// The handshake was not the first under its key, or this host no longer holds the key. The connection must be
    /// closed with `KEY_REUSED`.
    Reused,
}
