//! Shared memory between the sessions of one host: a ring per publisher in a sealed memfd, and a
//! segment per session that holds its readers' cursors and the words by which it is woken.
//!
//! Every shared word has exactly one writer process; there is no lock, reference count or
//! compare-and-swap between processes, so a process that dies leaves only its own pages stale.
//! Readers map read-only. What another process wrote is hostile input: layouts are checked and
//! copied when they are mapped, each word is read once and range-checked, and payload is copied
//! by atomic words with a check afterwards that it was not overwritten meanwhile.
//!
//! Nothing in here starts a thread or knows the daemon: two sessions that exchange descriptors
//! over any unix socket can use it.
#![allow(unsafe_code)]

#[cfg(not(all(target_pointer_width = "64", target_endian = "little")))]
compile_error!("rings are laid out for 64-bit little-endian machines");

mod area;
mod audience;
mod error;
mod fork;
mod headroom;
mod history;
mod lane;
mod layout;
mod loan;
mod memory;
mod peer;
mod reader;
mod ring;
mod session;
pub(crate) mod sync;
mod writer;

#[cfg(test)]
mod tests;

pub use error::{PublishError, ShmError, TakeError};
pub use lane::Lane;
pub use loan::Loan;
pub use peer::{Peer, PeerDescriptors, PeerSession};
pub use reader::{Reader, ReaderOptions, Taken};
pub use session::SessionSegment;
pub use writer::{Grant, Meta, Published, ReaderInfo, RingOptions, Writer};
