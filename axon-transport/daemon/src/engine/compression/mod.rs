//! Compresses samples that wait for a slow link, on a thread of the owner, for all peers.
//!
//! Compression pays while it takes much less time than it saves. Each sample is judged by the rate of the link and the
//! measured speed of the compressor. A sample that goes to several peers is compressed once.

#[cfg(test)]
mod tests;

use std::{
    cell::RefCell,
    collections::{HashMap, VecDeque},
    rc::Rc,
    time::Duration,
};

use axon_envelope::TopicHash;
use axon_shm::ids::{DaemonId, Gid};
use bytes::Bytes;

use super::rank::FlowId;

/// The level of zstd.
const LEVEL: i32 = 1;
/// Minimum length of a compressed sample; shorter samples are sent as they are.
pub(crate) const SHORTEST: usize = 1 << 10;
/// Maximum length of a compressed sample. The receiver decompresses a sample at once, and delivers no other meanwhile.
pub(crate) const LONGEST: usize = 8 << 20;
/// Compression may take this share of the time for which the link is busy with the sample.
const SHARE: f64 = 0.3;
/// Time to pass a sample to the compressor's thread and back.
const THERE_AND_BACK: Duration = Duration::from_micros(100);
/// The share of a sample that compression has to save, as a divisor.
const MIN_SAVING_DIVISOR: usize = 10;
/// Maximum number of bytes that are with the compressor at once, unless they are one sample.
const MAX_COMPRESSOR_BYTES: usize = 4 << 20;
/// Maximum number of bytes of compressed samples that are kept for other peers that will ask for them.
const MAX_SHARED_BYTES: usize = 4 << 20;
/// The compressor's speed is averaged over about this many recent bytes.
const MEASURED: f64 = (8 << 20) as f64;
/// The assumed speed before the first sample, in bytes a second.
const SPEED: f64 = 200e6;
/// After this time without compression the initial speed is assumed again: the compressor may have been held up.
const TRIED_AGAIN: Duration = Duration::from_secs(5);

/// An order to the owner to compress a sample.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct CompressionOrder {
    /// The number by which the answer refers to the order.
    pub(crate) number: u64,
    /// The sample.
    pub(crate) payload: Bytes,
}

/// The result of an order.
#[derive(Clone, Debug)]
pub(crate) struct CompressionAnswer {
    /// The number of the order.
    pub(crate) number: u64,
    /// One zstd frame, or `None` if it would save too little.
    pub(crate) compressed: Option<Bytes>,
    /// The duration of the compression.
    pub(crate) took: Duration,
}

/// Compresses samples, one after the other.
pub(crate) struct Compressor(Option<zstd::bulk::Compressor<'static>>);

impl Compressor {
    /// Creates a compressor that has compressed nothing.
    pub(crate) fn new() -> Self {
        // If its memory cannot be allocated, samples are sent as they are.
        Self(zstd::bulk::Compressor::new(LEVEL).ok())
    }

    /// Carries out an order.
    pub(crate) fn compress(
        &mut self,
        order: &CompressionOrder,
        now: impl Fn() -> Duration,
    ) -> CompressionAnswer {
        let begun = now();
        let most = order.payload.len() - order.payload.len().div_ceil(MIN_SAVING_DIVISOR);
        let compressed = self.0.as_mut().and_then(|zstd| {
            let mut frame = Vec::with_capacity(most);
            // An error means that the frame would be longer.
            zstd.compress_to_buffer(&order.payload, &mut frame).ok()?;
            frame.shrink_to_fit();
            Some(frame.into())
        });
        let took = now().saturating_sub(begun);
        CompressionAnswer { number: order.number, compressed, took }
    }
}

/// The flow that asks for a sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct RequestingFlow {
    /// The peer.
    pub(crate) daemon: DaemonId,
    /// The flow towards it.
    pub(crate) flow: FlowId,
}

/// The name of a sample of a topic. Peers have relays of their own. These may read different content under one number,
/// if a faulty publisher changes it. So a frame stands only for a sample of the same length; otherwise the peer would
/// take it for malformed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) struct SampleName {
    /// The topic and its type.
    pub(crate) topic: TopicHash,
    pub(crate) publisher: Gid,
    pub(crate) sequence: u64,
    /// The length in bytes.
    pub(crate) length: usize,
}

/// The answer to a flow that asks for a sample.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum CompressionReply {
    /// The sample is compressed already, or not worth it.
    Known(Option<Bytes>),
    /// The order with this number is in progress; its answer is the reply.
    Later(u64),
}

/// An order without an answer.
#[derive(Debug)]
struct PendingOrder {
    name: Option<SampleName>,
    length: usize,
    askers: Vec<RequestingFlow>,
}

#[derive(Debug)]
struct OrderState {
    number: u64,
    orders: VecDeque<CompressionOrder>,
    pending: HashMap<u64, PendingOrder>,
    /// The orders of samples that other peers may ask for, too.
    named: HashMap<SampleName, u64>,
    pending_bytes: usize,
    /// The last samples of topics, compressed or not worth it, and their order.
    kept: HashMap<SampleName, Option<Bytes>>,
    kept_order: VecDeque<SampleName>,
    kept_bytes: usize,
    /// Bytes of the recent orders, and the seconds that they took.
    measured: (f64, f64),
    used: Duration,
}

/// The compression for one peer.
#[derive(Debug)]
pub(crate) struct PeerCompression {
    all: Rc<Compression>,
    daemon: DaemonId,
}

impl PeerCompression {
    /// Creates the compression for this peer.
    pub(crate) fn new(all: Rc<Compression>, daemon: DaemonId) -> Self {
        Self { all, daemon }
    }

    /// Returns the result of [`Compression::pays`].
    pub(crate) fn pays(&self, length: usize, rate: f64, now: Duration) -> bool {
        self.all.pays(length, rate, now)
    }

    /// Asks for a sample as [`Compression::ask`] does.
    pub(crate) fn ask(
        &self,
        flow: FlowId,
        name: Option<SampleName>,
        payload: &Bytes,
    ) -> Option<CompressionReply> {
        self.all.ask(RequestingFlow { daemon: self.daemon, flow }, name, payload)
    }
}

/// The compression for all peers of one daemon.
#[derive(Debug)]
pub(crate) struct Compression(RefCell<OrderState>);

impl Compression {
    /// Creates compression without an order.
    pub(crate) fn new() -> Self {
        Self(RefCell::new(OrderState {
            number: 0,
            orders: VecDeque::new(),
            pending: HashMap::new(),
            named: HashMap::new(),
            pending_bytes: 0,
            kept: HashMap::new(),
            kept_order: VecDeque::new(),
            kept_bytes: 0,
            measured: (SPEED / 100.0, 0.01),
            used: Duration::ZERO,
        }))
    }

    /// Returns whether a sample of this length should be compressed for a link with a rate of `rate` bytes a second.
    pub(crate) fn pays(&self, length: usize, rate: f64, now: Duration) -> bool {
        let state = self.0.borrow();
        let (bytes, seconds) = match now.saturating_sub(state.used) > TRIED_AGAIN {
            true => (SPEED, 1.0),
            false => state.measured,
        };
        // The samples that wait are compressed first.
        let all = (state.pending_bytes + length) as f64;
        let takes = all * seconds / bytes + THERE_AND_BACK.as_secs_f64();
        (SHORTEST..=LONGEST).contains(&length) && takes < SHARE * length as f64 / rate
    }

    /// Handles the request of a flow for a sample, which has a name if it belongs to a topic. Returns `None` if too
    /// much is being compressed.
    pub(crate) fn ask(
        &self,
        by: RequestingFlow,
        name: Option<SampleName>,
        payload: &Bytes,
    ) -> Option<CompressionReply> {
        let mut state = self.0.borrow_mut();
        if let Some(name) = name {
            if let Some(known) = state.kept.get(&name) {
                return Some(CompressionReply::Known(known.clone()));
            }
            if let Some(number) = state.named.get(&name).copied() {
                state.pending.get_mut(&number)?.askers.push(by);
                return Some(CompressionReply::Later(number));
            }
        }
        let length = payload.len();
        if state.pending_bytes > 0 && state.pending_bytes + length > MAX_COMPRESSOR_BYTES {
            return None;
        }
        state.number += 1;
        let number = state.number;
        state.pending_bytes += length;
        state.pending.insert(number, PendingOrder { name, length, askers: vec![by] });
        if let Some(name) = name {
            state.named.insert(name, number);
        }
        state.orders.push_back(CompressionOrder { number, payload: payload.clone() });
        Some(CompressionReply::Later(number))
    }

    /// Returns the next order for the owner.
    pub(crate) fn poll_order(&self) -> Option<CompressionOrder> {
        self.0.borrow_mut().orders.pop_front()
    }

    /// Handles the owner's answer to an order. Returns the flows that asked.
    pub(crate) fn handle_answer(
        &self,
        now: Duration,
        answer: &CompressionAnswer,
    ) -> Vec<RequestingFlow> {
        let mut state = self.0.borrow_mut();
        state.used = now;
        let Some(PendingOrder { name, length, askers }) = state.pending.remove(&answer.number)
        else {
            return Vec::new();
        };
        state.pending_bytes -= length;
        let (bytes, seconds) = state.measured;
        let left = (1.0 - length as f64 / MEASURED).max(0.0);
        state.measured = (bytes * left + length as f64, seconds * left + answer.took.as_secs_f64());
        if let Some(name) = name {
            state.named.remove(&name);
            state.keep(name, answer.compressed.clone());
        }
        askers
    }
}

impl OrderState {
    fn keep(&mut self, name: SampleName, compressed: Option<Bytes>) {
        self.kept_bytes += kept_size(&compressed);
        if let Some(before) = self.kept.insert(name, compressed) {
            self.kept_bytes -= kept_size(&before);
        } else {
            self.kept_order.push_back(name);
        }
        while self.kept_bytes > MAX_SHARED_BYTES
            && let Some(oldest) =
                self.kept_order.pop_front().and_then(|name| self.kept.remove(&name))
        {
            self.kept_bytes -= kept_size(&oldest);
        }
    }
}

/// Returns the bytes that a kept sample counts for, including an allowance for its name.
fn kept_size(compressed: &Option<Bytes>) -> usize {
    compressed.as_ref().map_or(0, Bytes::len) + SHORTEST
}
