//! The first key of a link: which side fetches it, how long it is kept, and when it is spent (docs/formats.md,
//! sections 1 and 2).

mod acceptor;
mod dialler;
mod limits;
mod seen_set;
#[cfg(test)]
mod tests;

pub use acceptor::{Acceptor, Lookup, Resolver};
pub use dialler::{BootstrapDialler, DialDecision, DialKey, DialRefusal};

/// Whether a completed handshake was the first under its key.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[must_use]
pub enum Completion {
    /// Yes. The key is erased now.
    First,
    /// No: the connection must be closed with `KEY_REUSED`.
    Reused,
}
