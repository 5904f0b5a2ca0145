//! Datagrams that are passed on together.

use std::net::SocketAddr;

/// Datagrams, in the order in which they came.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Datagrams {
    bytes: Vec<u8>,
    /// The sender of each datagram, and the position of its end.
    all: Vec<(SocketAddr, usize)>,
}

impl Datagrams {
    /// Adds one.
    pub fn push(&mut self, from: SocketAddr, bytes: &[u8]) {
        self.bytes.extend_from_slice(bytes);
        self.all.push((from, self.bytes.len()));
    }

    /// Returns the number of datagrams.
    pub fn len(&self) -> usize {
        self.all.len()
    }

    /// Returns whether there is no datagram.
    pub fn is_empty(&self) -> bool {
        self.all.is_empty()
    }

    /// Returns the sender and the content of each datagram.
    pub fn iter(&self) -> impl Iterator<Item = (SocketAddr, &[u8])> {
        let begins = std::iter::once(0).chain(self.all.iter().map(|(_, end)| *end));
        self.all.iter().zip(begins).map(|((from, end), begin)| (*from, &self.bytes[begin..*end]))
    }
}
