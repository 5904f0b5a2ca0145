//! Splits samples into pieces and controls their flow: plain data in, data out.
//!
//! There is a [`Channel`] for each publisher whose samples cross, for each client's requests, and for the
//! responses of each server to each client. The receiver of a channel grants the sender a number of bytes in
//! flight. It gives the credit back when the samples have reached their destination. Samples of a channel that
//! nobody reads stay in their source ring, where the publisher's QoS applies; such a channel delays others only
//! through long samples ([`Incoming::grants`]). Pieces of all channels take turns, so that an image does not delay
//! a small sample.

use std::{
    collections::{BTreeMap, HashMap, VecDeque},
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
};

use axon_shm::{Meta, Sample};

use crate::{
    ids::Gid,
    session::merge::Taken,
    wire::session::{Credit, SampleFragment, SampleHeader},
};

/// Bytes that a channel may have under way without asking.
pub const WINDOW: u64 = 32 << 10;
/// What a sample counts for besides its bytes.
pub const OVERHEAD: u64 = 128;
/// Most bytes of a sample in one packet.
pub const PIECE: usize = 31 << 10;
/// Bytes beyond the windows of its channels that one session's arriving samples may take, but for one
/// that is long.
const SESSION: u64 = 64 << 20;
/// Bytes beyond its window above which a sample is long: there is one at a time, so that those which
/// are not read leave room for others.
const LONG: u64 = SESSION / 8;

/// Samples that follow each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Channel {
    /// Who wrote them.
    pub writer: Gid,
    /// The one whose responses they are, where a server did.
    pub client: Option<Gid>,
}

impl Channel {
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
pub trait Content {
    /// How many there are.
    fn len(&self) -> usize;
    /// Whether there are none.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }
    /// Copies those from `at` on to the front of `out`, as many as there are and fit.
    fn read_at(&self, at: usize, out: &mut [u8]) -> usize;
}

impl Content for Sample {
    fn len(&self) -> usize {
        self.len()
    }

    fn read_at(&self, at: usize, out: &mut [u8]) -> usize {
        self.read_at(at, out)
    }
}

impl Content for Vec<u8> {
    fn len(&self) -> usize {
        self.len()
    }

    fn read_at(&self, at: usize, out: &mut [u8]) -> usize {
        let count = out.len().min(self.len().saturating_sub(at));
        out[..count].copy_from_slice(&self[at..][..count]);
        count
    }
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

impl From<Taken<Sample>> for OutboundSample<Sample> {
    fn from(Taken { lost, content, .. }: Taken<Sample>) -> Self {
        Self { meta: content.meta(), lost, content }
    }
}

/// The sending end.
#[derive(Debug)]
pub struct Outgoing<S> {
    channels: BTreeMap<Channel, Sending<S>>,
    /// Channels that may send a piece, in their order.
    turns: VecDeque<Channel>,
}

#[derive(Debug)]
struct Sending<S> {
    /// MATCHED that this end had said when it opened its end.
    since: u64,
    /// Bytes that may still be sent; `None` until the receiver opened its end.
    credit: Option<u64>,
    /// What it was when the receiver opened its end: all of it is back when nothing is under way.
    window: u64,
    /// What is sent piece by piece, and how far.
    current: Option<(OutboundSample<S>, Option<usize>)>,
    in_turn: bool,
}

impl<S> Default for Outgoing<S> {
    fn default() -> Self {
        Self { channels: BTreeMap::new(), turns: VecDeque::new() }
    }
}

impl<S: Content> Outgoing<S> {
    /// Opens a channel, which waits for a receiver that has heard as many MATCHED as were said when it
    /// was to be opened: one that has not means a channel of the same name that was closed since.
    pub fn open(&mut self, channel: Channel, since: u64) {
        let closed = Sending { since, credit: None, window: 0, current: None, in_turn: false };
        self.channels.entry(channel).or_insert(closed);
    }

    /// Closes those channels that `keep` does not want; the rest of a sample that is under way is not
    /// sent.
    pub fn retain(&mut self, keep: impl Fn(&Channel) -> bool) {
        self.channels.retain(|channel, _| keep(channel));
        let channels = &self.channels;
        self.turns.retain(|channel| channels.contains_key(channel));
    }

    /// Closes a channel.
    pub fn close(&mut self, channel: &Channel) {
        self.channels.remove(channel);
        self.turns.retain(|other| other != channel);
    }

    /// What the receiver of a channel says.
    pub fn credit(&mut self, credit: &Credit) {
        let Credit { publisher, bytes, opens, client, .. } = *credit;
        let name = Channel { writer: publisher, client };
        let Some(channel) = self.channels.get_mut(&name) else { return };
        match (&mut channel.credit, opens) {
            (none @ None, Some(heard)) if heard >= channel.since => {
                *none = Some(bytes);
                channel.window = bytes;
            }
            (Some(credit), None) => *credit = credit.saturating_add(bytes),
            // Of a channel that this one came after.
            (None, _) | (Some(_), Some(_)) => {}
        }
        self.enqueue(name);
    }

    /// Whether all that was sent on a channel has gone to where it belongs.
    pub fn is_idle(&self, channel: &Channel) -> bool {
        self.channels.get(channel).is_none_or(|channel| {
            channel.current.is_none()
                && channel.credit.is_none_or(|credit| credit == channel.window)
        })
    }

    /// Asks for the next sample of each channel that has none under way and may send one. Whether
    /// there was any.
    pub fn fill(&mut self, mut take: impl FnMut(&Channel) -> Option<OutboundSample<S>>) -> bool {
        let mut found = Vec::new();
        for (name, channel) in &mut self.channels {
            if channel.current.is_none() && channel.credit >= Some(OVERHEAD) {
                channel.current = take(name).map(|sample| (sample, None));
                found.extend(channel.current.is_some().then_some(*name));
            }
        }
        found.iter().for_each(|name| self.enqueue(*name));
        !found.is_empty()
    }

    /// The next piece, of the channel whose turn it is.
    pub fn next_piece(&mut self) -> Option<SampleFragment> {
        loop {
            let name = self.turns.pop_front()?;
            let Some(channel) = self.channels.get_mut(&name) else { continue };
            channel.in_turn = false;
            let (Some((sample, at)), Some(credit)) = (&mut channel.current, &mut channel.credit)
            else {
                continue;
            };
            let mut cost = 0;
            let mut head = None;
            let from = match at {
                Some(at) => *at,
                None if *credit < OVERHEAD => continue,
                None => {
                    cost = OVERHEAD;
                    let Meta { sequence, source_timestamp, published, .. } = sample.meta;
                    // No sample is longer than AXON_MAX_MESSAGE_MB allows, which is below 4 GiB.
                    let length = u32::try_from(sample.content.len()).unwrap_or(u32::MAX);
                    let lost = sample.lost;
                    head =
                        Some(SampleHeader { length, sequence, source_timestamp, lost, published });
                    0
                }
            };
            let left = sample.content.len() - from;
            let may = usize::try_from(*credit - cost).unwrap_or(usize::MAX);
            let mut bytes = vec![0; left.min(PIECE).min(may)];
            if bytes.is_empty() && head.is_none() {
                // It waits for credit.
                continue;
            }
            sample.content.read_at(from, &mut bytes);
            cost += bytes.len() as u64;
            *credit -= cost;
            *at = Some(from + bytes.len());
            if bytes.len() == left {
                channel.current = None;
            } else {
                self.enqueue(name);
            }
            let Channel { writer: publisher, client } = name;
            return Some(SampleFragment { publisher, head, bytes, client });
        }
    }

    fn enqueue(&mut self, name: Channel) {
        if let Some(channel) = self.channels.get_mut(&name)
            && channel.current.is_some()
            && !std::mem::replace(&mut channel.in_turn, true)
        {
            self.turns.push_back(name);
        }
    }
}

/// A sample that has come whole.
#[derive(Debug, PartialEq, Eq)]
pub struct InboundSample {
    /// On which channel.
    pub channel: Channel,
    /// Its number and time.
    pub meta: Meta,
    /// Samples of its publisher that were lost since the one before.
    pub lost: u64,
    /// Its bytes.
    pub payload: Vec<u8>,
}

impl InboundSample {
    fn cost(&self) -> u64 {
        OVERHEAD + self.payload.len() as u64
    }
}

/// What no sender does. The connection is closed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Violation {
    /// A sample longer than any may be.
    #[error("a sample of {0} bytes, which is more than AXON_MAX_MESSAGE_MB allows")]
    TooLarge(u32),
    /// More bytes than there was credit for.
    #[error("more bytes of samples than it was given credit for")]
    Overrun,
    /// A piece that does not follow the one before.
    #[error("a piece of a sample that does not follow the one before")]
    OutOfPlace,
}

/// The memory that the arriving samples of all of a daemon's relayed sessions share.
#[derive(Debug)]
pub struct Pool {
    held: AtomicU64,
    limit: u64,
}

impl Pool {
    /// A pool of `limit` bytes.
    pub fn new(limit: u64) -> Arc<Self> {
        Arc::new(Self { held: AtomicU64::new(0), limit })
    }

    /// Bytes that are taken.
    pub fn held(&self) -> u64 {
        self.held.load(Ordering::Relaxed)
    }

    /// One sample may always: what is larger than the pool must pass, too.
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
pub struct Incoming {
    channels: HashMap<Channel, Receiving>,
    max_message: u64,
    /// Channels whose sample is longer than their window, until there is room.
    waiting: VecDeque<Channel>,
    /// Bytes that were granted beyond the windows to samples that are not long.
    reserved: u64,
    /// The channel of the one that is, and what it was granted.
    long: Option<(Channel, u64)>,
    pool: Arc<Pool>,
    is_short: bool,
}

#[derive(Debug, Default)]
struct Receiving {
    /// Bytes that came and have not gone to where they belong.
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

impl Incoming {
    /// An end that takes samples of at most `max_message` bytes, and memory beyond its windows out of
    /// `pool`.
    pub fn new(max_message: u64, pool: Arc<Pool>) -> Self {
        let (channels, waiting) = (HashMap::new(), VecDeque::new());
        Self { channels, max_message, waiting, reserved: 0, long: None, pool, is_short: false }
    }

    /// Opens a channel, unless it is open: what its sender, of which so many MATCHED were heard, is to
    /// be told.
    pub fn open(&mut self, channel: Channel, heard: u64) -> Option<Credit> {
        if self.channels.contains_key(&channel) {
            return None;
        }
        self.channels.insert(channel, Receiving::default());
        Some(channel.credit(WINDOW, Some(heard)))
    }

    /// Closes those channels that `keep` does not want, and forgets what came on them.
    pub fn retain(&mut self, keep: impl Fn(&Channel) -> bool) {
        let closed = self.channels.extract_if(|name, _| !keep(name));
        for (name, channel) in closed.collect::<Vec<_>>() {
            self.release(name, channel.granted);
        }
        let channels = &self.channels;
        self.waiting.retain(|channel| channels.contains_key(channel));
    }

    /// The channels of which a sample has come in part.
    pub fn partial(&self) -> impl Iterator<Item = &Channel> {
        let partial = self.channels.iter().filter(|(_, channel)| channel.partial.is_some());
        partial.map(|(name, _)| name)
    }

    /// Takes a piece; the sample, if it was the last.
    ///
    /// # Errors
    /// [`Violation`].
    pub fn piece(&mut self, piece: SampleFragment) -> Result<Option<InboundSample>, Violation> {
        let SampleFragment { publisher, head, bytes, client } = piece;
        let name = Channel { writer: publisher, client };
        // Of a channel that was closed meanwhile.
        let Some(channel) = self.channels.get_mut(&name) else { return Ok(None) };
        let opens = head.is_some();
        let partial = match (head, channel.partial.take()) {
            (Some(head), None) if u64::from(head.length) > self.max_message => {
                return Err(Violation::TooLarge(head.length));
            }
            (Some(head), None) => Partial { head, payload: Vec::new() },
            (None, Some(partial)) if !bytes.is_empty() => partial,
            _ => return Err(Violation::OutOfPlace),
        };
        let length = partial.head.length as usize;
        if bytes.len() > length - partial.payload.len() {
            return Err(Violation::OutOfPlace);
        }
        channel.held += bytes.len() as u64 + if opens { OVERHEAD } else { 0 };
        if channel.held > WINDOW + channel.granted {
            return Err(Violation::Overrun);
        }
        let Partial { head, mut payload } = partial;
        // Grows with what really arrives.
        payload.extend_from_slice(&bytes);
        if payload.len() < length {
            channel.partial = Some(Partial { head, payload });
            if opens && extra(length) > 0 {
                self.waiting.push_back(name);
            }
            return Ok(None);
        }
        let SampleHeader { sequence, source_timestamp, lost, published, .. } = head;
        let meta = Meta::at_nanos(sequence, source_timestamp).with_published(published);
        Ok(Some(InboundSample { channel: name, meta, lost, payload }))
    }

    /// Grants credit to each waiting channel whose sample fits what the session may buffer. A channel whose
    /// sample does not fit holds up no other one.
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

    fn reserve(&mut self, name: Channel, bytes: u64) -> bool {
        let is_long = bytes > LONG;
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

    /// Whether somebody waits for room that other sessions have.
    pub fn is_short(&self) -> bool {
        self.is_short
    }

    /// A sample has gone to where it belongs, or nowhere: what its sender is given back.
    pub fn done(&mut self, sample: &InboundSample) -> Option<Credit> {
        let name = sample.channel;
        let channel = self.channels.get_mut(&name)?;
        let (cost, more) = (sample.cost(), extra(sample.payload.len()));
        channel.held = channel.held.saturating_sub(cost);
        // One that was not asked for can have come within the window, by the grant for another.
        let more = more.min(channel.granted);
        channel.granted -= more;
        self.release(name, more);
        Some(Credit { done: Some(sample.meta.sequence), ..name.credit(cost - more, None) })
    }

    fn release(&mut self, of: Channel, bytes: u64) {
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

impl Drop for Incoming {
    fn drop(&mut self) {
        self.pool.give(self.reserved + self.long.map_or(0, |(_, bytes)| bytes));
    }
}

/// What a sample takes beyond its channel's window.
fn extra(length: usize) -> u64 {
    (OVERHEAD + length as u64).saturating_sub(WINDOW)
}

#[cfg(test)]
mod tests;
