//! Splits samples into pieces and controls their flow: plain data in, data out.
//!
//! There is a [`FlowChannel`] for each publisher whose samples cross, for each client's requests, and for the
//! responses of each server to each client. The receiver of a channel grants the sender a number of bytes in
//! flight. It gives the credit back when the samples have reached their destination. Samples of a channel that
//! nobody reads stay in their source ring, where the publisher's QoS applies; such a channel delays others only
//! through long samples ([`IncomingFlow::grants`]). Pieces of all channels take turns, so that an image does not delay
//! a small sample.

mod incoming;
mod outgoing;
#[cfg(test)]
mod tests;

use std::sync::Arc;

use axon_shm::{Meta, Sample};

pub use self::{
    incoming::{ArrivalPool, FlowViolation, InboundSample, IncomingFlow},
    outgoing::OutgoingFlow,
};
use crate::{ids::Gid, session::merge::MergedSample, wire::session::Credit};

/// Bytes that a channel may have under way without asking.
pub const WINDOW: u64 = 32 << 10;
/// What a sample counts for besides its bytes.
pub const OVERHEAD: u64 = 128;
/// Most bytes of a sample in one packet.
pub const PIECE: usize = 31 << 10;

/// Samples that follow each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct FlowChannel {
    /// Who wrote them.
    pub writer: Gid,
    /// The one whose responses they are, where a server did.
    pub client: Option<Gid>,
}

impl FlowChannel {
    /// That of a publisher's samples, or a client's requests.
    pub fn of(writer: Gid) -> Self {
        Self { writer, client: None }
    }

    /// That of a server's responses to a client.
    pub fn between(server: Gid, client: Gid) -> Self {
        Self { writer: server, client: Some(client) }
    }

    /// Samples up to this number are where they are to go.
    pub(crate) fn done(self, sequence: u64) -> Credit {
        Credit { done: Some(sequence), ..self.credit(0, None) }
    }

    fn credit(self, bytes: u64, opens: Option<u64>) -> Credit {
        Credit { publisher: self.writer, bytes, opens, client: self.client, done: None }
    }
}

/// A sample's bytes.
pub trait SampleContent {
    /// How many there are.
    fn len(&self) -> usize;
    /// Whether there are none.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }
    /// Copies those from `at` on to the front of `out`, as many as there are and fit.
    fn read_at(&self, at: usize, out: &mut [u8]) -> usize;
}

impl SampleContent for Vec<u8> {
    fn len(&self) -> usize {
        self.len()
    }

    fn read_at(&self, at: usize, out: &mut [u8]) -> usize {
        read_at(self, at, out)
    }
}

/// The bytes of a sample that goes.
#[derive(Debug)]
pub enum SamplePayload {
    /// They stay in the ring.
    Ring(Sample),
    /// They are kept, to be sent again.
    Kept(Arc<[u8]>),
}

impl SampleContent for SamplePayload {
    fn len(&self) -> usize {
        match self {
            Self::Ring(sample) => sample.len(),
            Self::Kept(bytes) => bytes.len(),
        }
    }

    fn read_at(&self, at: usize, out: &mut [u8]) -> usize {
        match self {
            Self::Ring(sample) => sample.read_at(at, out),
            Self::Kept(bytes) => read_at(bytes, at, out),
        }
    }
}

fn read_at(bytes: &[u8], at: usize, out: &mut [u8]) -> usize {
    let count = out.len().min(bytes.len().saturating_sub(at));
    out[..count].copy_from_slice(&bytes[at..][..count]);
    count
}

/// A sample to be sent.
#[derive(Debug)]
pub struct OutboundSample<S> {
    /// Its number and time.
    pub meta: Meta,
    /// Samples of its publisher that were lost since the one before.
    pub lost: u64,
    /// Its bytes, which may stay where they are.
    pub content: S,
}

impl From<MergedSample<Sample>> for OutboundSample<SamplePayload> {
    fn from(MergedSample { lost, content, .. }: MergedSample<Sample>) -> Self {
        Self { meta: content.meta(), lost, content: SamplePayload::Ring(content) }
    }
}
