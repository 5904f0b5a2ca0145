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

/// Bytes that a channel may have in flight without asking.
pub const WINDOW: u64 = 32 << 10;
/// Bytes of credit that a sample costs besides its payload.
pub const OVERHEAD: u64 = 128;
/// Maximum number of bytes of a sample in one packet.
pub const PIECE: usize = 31 << 10;

/// A sequence of samples under common flow control.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct FlowChannel {
    /// The writer of the samples.
    pub writer: Gid,
    /// The client that receives the responses, if the writer is a server.
    pub client: Option<Gid>,
}

impl FlowChannel {
    /// Returns the channel of a publisher's samples, or a client's requests.
    pub fn of(writer: Gid) -> Self {
        Self { writer, client: None }
    }

    /// Returns the channel of a server's responses to a client.
    pub fn between(server: Gid, client: Gid) -> Self {
        Self { writer: server, client: Some(client) }
    }

    /// Returns the credit message that confirms the delivery of samples up to this number.
    pub(crate) fn done(self, sequence: u64) -> Credit {
        Credit { done: Some(sequence), ..self.credit(0, None) }
    }

    fn credit(self, bytes: u64, opens: Option<u64>) -> Credit {
        Credit { publisher: self.writer, bytes, opens, client: self.client, done: None }
    }
}

/// The bytes of a sample.
pub trait SampleContent {
    /// Returns the number of bytes.
    fn len(&self) -> usize;
    /// Returns whether there are no bytes.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }
    /// Copies the bytes from `at` on to the front of `out`, as many as there are and fit. Returns their number.
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

/// The payload of a sample that is sent.
#[derive(Debug)]
pub enum SamplePayload {
    /// The payload stays in the ring.
    Ring(Sample),
    /// The payload is kept, to be sent again.
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
    /// The number and time of the sample.
    pub meta: Meta,
    /// Number of its publisher's samples that were lost since the previous one.
    pub lost: u64,
    /// The payload, which may stay in its memory.
    pub content: S,
}

impl From<MergedSample<Sample>> for OutboundSample<SamplePayload> {
    fn from(MergedSample { lost, content, .. }: MergedSample<Sample>) -> Self {
        Self { meta: content.meta(), lost, content: SamplePayload::Ring(content) }
    }
}
