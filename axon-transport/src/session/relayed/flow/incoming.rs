//! The receiving end: assembles samples from pieces, and grants the credit for more.

use std::{
    collections::{HashMap, VecDeque},
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
};

use axon_shm::Meta;

use super::{FlowChannel, OVERHEAD, WINDOW};
use crate::wire::session::{Credit, SampleFragment, SampleHeader};

/// Bytes beyond the windows of its channels that the arriving samples of one session may take; a long sample does not
/// count.
const SESSION: u64 = 64 << 20;
/// Bytes beyond its window above which a sample is long. Only one long sample is granted at a time, so that samples
/// which are not read leave space for others.
pub(super) const LONG_SAMPLE_BYTES: u64 = SESSION / 8;

/// A sample that has arrived completely.
#[derive(Debug, PartialEq, Eq)]
pub struct InboundSample {
    /// The channel on which it arrived.
    pub channel: FlowChannel,
    /// The number and time of the sample.
    pub meta: Meta,
    /// Number of its publisher's samples that were lost since the previous one.
    pub lost: u64,
    /// The bytes of the sample.
    pub payload: Vec<u8>,
}

impl InboundSample {
    fn cost(&self) -> u64 {
        OVERHEAD + self.payload.len() as u64
    }
}

/// A violation of the protocol by the sender. The connection is closed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum FlowViolation {
    /// A sample longer than the maximum length of a message.
    #[error("a sample of {0} bytes, which is more than AXON_MAX_MESSAGE_MB allows")]
    TooLarge(u32),
    /// More bytes than there was credit for.
    #[error("more bytes of samples than it was given credit for")]
    Overrun,
    /// A piece that does not follow the previous one.
    #[error("a piece of a sample that does not follow the one before")]
    OutOfPlace,
}

/// The memory that the arriving samples of all of a daemon's relayed sessions share.
#[derive(Debug)]
pub struct ArrivalPool {
    held: AtomicU64,
    limit: u64,
}

impl ArrivalPool {
    /// Creates a pool of `limit` bytes.
    pub fn new(limit: u64) -> Arc<Self> {
        Arc::new(Self { held: AtomicU64::new(0), limit })
    }

    /// Returns the number of bytes taken.
    pub fn held(&self) -> u64 {
        self.held.load(Ordering::Relaxed)
    }

    /// Takes bytes from the pool, if they fit. An empty pool accepts any sample: one that is larger than the pool must
    /// pass, too.
    fn take(&self, bytes: u64) -> bool {
        let fits = |held: u64| {
            (held == 0 || held + bytes <= self.limit).then(|| held.saturating_add(bytes))
        };
        // Relaxed: the count guards nothing but itself.
        self.held.fetch_update(Ordering::Relaxed, Ordering::Relaxed, fits).is_ok()
    }

    fn give(&self, bytes: u64) {
        self.held.fetch_sub(bytes, Ordering::Relaxed);
    }
}

/// The receiving end.
#[derive(Debug)]
pub struct IncomingFlow {
    channels: HashMap<FlowChannel, Receiving>,
    max_message: u64,
    /// Channels whose sample is longer than their window, until there is space.
    waiting: VecDeque<FlowChannel>,
    /// Bytes granted beyond the windows to samples that are not long.
    reserved: u64,
    /// The channel of the long sample, and the bytes granted to it.
    long: Option<(FlowChannel, u64)>,
    pool: Arc<ArrivalPool>,
    is_short: bool,
}

#[derive(Debug, Default)]
struct Receiving {
    /// Bytes that arrived and have not reached their destination.
    held: u64,
    /// Bytes granted beyond the window, for these samples.
    granted: u64,
    partial: Option<Partial>,
}

#[derive(Debug)]
struct Partial {
    head: SampleHeader,
    payload: Vec<u8>,
}

impl IncomingFlow {
    /// Creates an end that takes samples of at most `max_message` bytes, and takes memory beyond its windows from
    /// `pool`.
    pub fn new(max_message: u64, pool: Arc<ArrivalPool>) -> Self {
        let (channels, waiting) = (HashMap::new(), VecDeque::new());
        Self { channels, max_message, waiting, reserved: 0, long: None, pool, is_short: false }
    }

    /// Opens a channel, unless it is open. Returns the credit message for its sender; `heard` is the number of MATCHED
    /// messages that were received from the sender.
    pub fn open(&mut self, channel: FlowChannel, heard: u64) -> Option<Credit> {
        if self.channels.contains_key(&channel) {
            return None;
        }
        self.channels.insert(channel, Receiving::default());
        Some(channel.credit(WINDOW, Some(heard)))
    }

    /// Closes the channels that `keep` rejects, and forgets the pieces that came on them.
    pub fn retain(&mut self, keep: impl Fn(&FlowChannel) -> bool) {
        let closed = self.channels.extract_if(|name, _| !keep(name));
        for (name, channel) in closed.collect::<Vec<_>>() {
            self.release(name, channel.granted);
        }
        let channels = &self.channels;
        self.waiting.retain(|channel| channels.contains_key(channel));
    }

    /// Returns the channels of which a sample has arrived in part.
    pub fn partial(&self) -> impl Iterator<Item = &FlowChannel> {
        let partial = self.channels.iter().filter(|(_, channel)| channel.partial.is_some());
        partial.map(|(name, _)| name)
    }

    /// Takes a piece. Returns the sample if this was its last piece.
    ///
    /// # Errors
    /// [`FlowViolation`].
    pub fn piece(&mut self, piece: SampleFragment) -> Result<Option<InboundSample>, FlowViolation> {
        let SampleFragment { publisher, head, bytes, client } = piece;
        let name = FlowChannel { writer: publisher, client };
        // The channel was closed meanwhile.
        let Some(channel) = self.channels.get_mut(&name) else { return Ok(None) };
        let opens = head.is_some();
        let partial = match (head, channel.partial.take()) {
            (Some(head), None) if u64::from(head.length) > self.max_message => {
                return Err(FlowViolation::TooLarge(head.length));
            }
            (Some(head), None) => Partial { head, payload: Vec::new() },
            (None, Some(partial)) if !bytes.is_empty() => partial,
            _ => return Err(FlowViolation::OutOfPlace),
        };
        let length = partial.head.length as usize;
        if bytes.len() > length - partial.payload.len() {
            return Err(FlowViolation::OutOfPlace);
        }
        channel.held += bytes.len() as u64 + if opens { OVERHEAD } else { 0 };
        if channel.held > WINDOW + channel.granted {
            return Err(FlowViolation::Overrun);
        }
        let Partial { head, mut payload } = partial;
        // The buffer grows with the bytes that really arrive.
        payload.extend_from_slice(&bytes);
        if payload.len() < length {
            channel.partial = Some(Partial { head, payload });
            if opens && extra(length) > 0 {
                self.waiting.push_back(name);
            }
            return Ok(None);
        }
        let SampleHeader { sequence, source_timestamp, lost, published, .. } = head;
        let meta = Meta::at_nanos(sequence, source_timestamp).with_published_nanos(published);
        Ok(Some(InboundSample { channel: name, meta, lost, payload }))
    }

    /// Grants credit to each waiting channel whose sample fits what the session may buffer. A channel whose sample does
    /// not fit holds up no other channel.
    pub fn grants(&mut self) -> Vec<Credit> {
        let mut granted = Vec::new();
        self.is_short = false;
        for name in std::mem::take(&mut self.waiting) {
            let partial = self.channels.get(&name).and_then(|channel| channel.partial.as_ref());
            let Some(more) = partial.map(|partial| extra(partial.head.length as usize)) else {
                continue;
            };
            if self.reserve(name, more) {
                self.channels.entry(name).or_default().granted += more;
                granted.push(name.credit(more, None));
            } else {
                self.waiting.push_back(name);
            }
        }
        granted
    }

    fn reserve(&mut self, name: FlowChannel, bytes: u64) -> bool {
        let is_long = bytes > LONG_SAMPLE_BYTES;
        let fits = if is_long { self.long.is_none() } else { self.reserved + bytes <= SESSION };
        if !fits {
            return false;
        }
        if !self.pool.take(bytes) {
            self.is_short = true;
            return false;
        }
        if is_long {
            self.long = Some((name, bytes));
        } else {
            self.reserved += bytes;
        }
        true
    }

    /// Returns whether a sample waits for space that other sessions occupy.
    pub fn is_short(&self) -> bool {
        self.is_short
    }

    /// Records that a sample has reached its destination, or was dropped. Returns the credit for its sender.
    pub fn done(&mut self, sample: &InboundSample) -> Option<Credit> {
        let name = sample.channel;
        let channel = self.channels.get_mut(&name)?;
        let (cost, more) = (sample.cost(), extra(sample.payload.len()));
        channel.held = channel.held.saturating_sub(cost);
        // A sample that did not ask for credit can have come within the window, by the grant for another one.
        let more = more.min(channel.granted);
        channel.granted -= more;
        self.release(name, more);
        Some(Credit { done: Some(sample.meta.sequence), ..name.credit(cost - more, None) })
    }

    fn release(&mut self, of: FlowChannel, bytes: u64) {
        let mut rest = bytes;
        if let Some((name, long)) = &mut self.long
            && *name == of
        {
            let most = rest.min(*long);
            (*long, rest) = (*long - most, rest - most);
            if *long == 0 {
                self.long = None;
            }
        }
        self.reserved -= rest;
        self.pool.give(bytes);
    }
}

impl Drop for IncomingFlow {
    fn drop(&mut self) {
        self.pool.give(self.reserved + self.long.map_or(0, |(_, bytes)| bytes));
    }
}

/// Returns the bytes that a sample takes beyond its channel's window.
fn extra(length: usize) -> u64 {
    (OVERHEAD + length as u64).saturating_sub(WINDOW)
}
