//! Copies of small samples over the link that stands by.
//!
//! A RELIABLE sample waits for the take-over if its path is cut while it is on its way. So a small one also leaves over
//! the second path, and the peer delivers whichever arrives first. A copy is a help and no promise: it is left out while
//! the second path is silent or has many copies in flight.

use std::{collections::HashMap, mem, time::Duration};

use axon_shm::ids::Gid;
use bytes::Bytes;
use quinn_proto::{Connection, Dir, StreamId, VarInt};

use crate::{
    engine::{
        rank::SMALL,
        sample::{
            protection::MAX_OVERHEAD,
            stream_header::{HEADER, StreamHeader},
        },
    },
    link::CloseCode,
};

/// Maximum number of copies in flight. Before a link is elected its peer allows 128 streams at a time, which are also for
/// those that the election precedes.
const MOST: usize = 96;
/// Bytes before the message of a copy in its stream: the header, and the number of the sample before it.
const START: usize = HEADER + size_of::<u64>();
/// Bytes of a copy's stream besides the payload, at most: the message has a length, a header and an envelope.
const MAX_AROUND: usize = START + size_of::<u32>() + MAX_OVERHEAD;
/// Maximum number of copies in flight of one flow, so that a fast flow leaves some to the others.
const MOST_OF_FLOW: usize = 32;
/// Time without an answer, and number of round trips, after which the second path counts as silent.
const SILENT: Duration = Duration::from_millis(100);
const ROUND_TRIPS: u32 = 3;
/// Interval of the PINGs over a silent path, in the first seconds of the silence and later. The first PING that is
/// answered shows that the path works again.
const FIRST_PINGS: (Duration, Duration) = (Duration::from_secs(10), Duration::from_millis(100));
const PING: Duration = Duration::from_secs(1);
/// Time, and number of round trips, after which a copy is given up. Its sample has arrived over the link in use, or the
/// peer lacks the sample before it.
const LIFE: (Duration, u32) = (Duration::from_secs(1), 4);
/// Longest time after which a copy is given up. In messages10 the peer keeps the key of a copy for 5 s after its RETIRE.
const LONGEST_LIFE: Duration = Duration::from_secs(4);

/// A copy that is to leave.
#[derive(Debug)]
pub(in crate::engine) struct SampleCopy {
    /// The header of its stream.
    pub(in crate::engine) header: StreamHeader,
    /// The number of the sample that was sent before it in its flow.
    pub(in crate::engine) after: u64,
    /// The message behind its length.
    pub(in crate::engine) frames: Vec<Bytes>,
}

/// The copies of one pass.
#[derive(Debug, Default)]
pub(in crate::engine) struct CopyBatch {
    /// The connection that stands by.
    pub(in crate::engine) connection: u64,
    /// Number of copies, and of their bytes, that the second path takes.
    room: (usize, usize),
    /// Number of copies in flight by flow.
    of_flow: HashMap<(u32, Gid), usize>,
    copies: Vec<SampleCopy>,
}

impl CopyBatch {
    /// Returns whether the second path takes one more copy.
    pub(in crate::engine) fn has_room(&self) -> bool {
        self.copies.len() < self.room.0
    }

    /// Returns whether the second path takes a copy of a payload of this length. A copy is sealed only then: its key would
    /// be used up for nothing.
    pub(in crate::engine) fn takes(&self, header: &StreamHeader, payload: usize) -> bool {
        let of_flow = self.of_flow.get(&(header.route, header.of)).copied().unwrap_or(0);
        self.has_room() && of_flow < MOST_OF_FLOW && payload + MAX_AROUND <= self.room.1
    }

    /// Adds a copy.
    pub(in crate::engine) fn add(&mut self, copy: SampleCopy) {
        let bytes = START + copy.frames.iter().map(Bytes::len).sum::<usize>();
        self.room.1 = self.room.1.saturating_sub(bytes);
        *self.of_flow.entry((copy.header.route, copy.header.of)).or_default() += 1;
        self.copies.push(copy);
    }

    /// Takes the copies.
    pub(in crate::engine) fn take(&mut self) -> Vec<SampleCopy> {
        mem::take(&mut self.copies)
    }
}

/// A copy in flight.
#[derive(Debug)]
struct SentCopy {
    stream: StreamId,
    of: (u32, Gid),
    sent_at: Duration,
    bytes: usize,
}

/// The copies in flight over one connection.
#[derive(Debug, Default)]
pub(in crate::engine) struct CopyStreams {
    in_flight: Vec<SentCopy>,
    bytes: usize,
    /// Number of copies that left.
    sent: u64,
    /// True if a copy left since the peer's latest answer.
    is_asking: bool,
    ping_at: Option<Duration>,
}

impl CopyStreams {
    /// Returns an empty batch for the copies that may leave now over `connection`, which is this one. `since`: since when
    /// the peer has not answered over it.
    pub(in crate::engine) fn batch(
        &self,
        connection: u64,
        quic: &Connection,
        since: Option<Duration>,
        now: Duration,
    ) -> CopyBatch {
        let mut batch = CopyBatch { connection, ..CopyBatch::default() };
        if is_silent(since, quic.rtt(), now) {
            return batch;
        }
        // One copy may always be in flight.
        let bytes = match self.in_flight.is_empty() {
            true => most_bytes(quic).max(MAX_AROUND + SMALL),
            false => most_bytes(quic).saturating_sub(self.bytes),
        };
        batch.room = (MOST.saturating_sub(self.in_flight.len()), bytes);
        for copy in &self.in_flight {
            *batch.of_flow.entry(copy.of).or_default() += 1;
        }
        batch
    }

    /// Sends a copy that the [batch](Self::batch) took, in a stream of its own.
    pub(in crate::engine) fn send(
        &mut self,
        quic: &mut Connection,
        copy: &mut SampleCopy,
        now: Duration,
    ) {
        let of = (copy.header.route, copy.header.of);
        let mut start = copy.header.encode().to_vec();
        start.extend_from_slice(&copy.after.to_be_bytes());
        let mut chunks = vec![Bytes::from(start)];
        chunks.append(&mut copy.frames);
        let bytes = chunks.iter().map(Bytes::len).sum();
        let Some(stream) = quic.streams().open(Dir::Uni) else { return };
        let written = quic.send_stream(stream).write_chunks(&mut chunks).map(|taken| taken.bytes);
        if written != Ok(bytes) {
            reset(quic, stream);
            return;
        }
        let _ = quic.send_stream(stream).finish();
        self.in_flight.push(SentCopy { stream, of, sent_at: now, bytes });
        (self.bytes, self.sent, self.is_asking) = (self.bytes + bytes, self.sent + 1, true);
    }

    /// Handles that the peer answered over this connection.
    pub(in crate::engine) fn handle_answer(&mut self) {
        (self.is_asking, self.ping_at) = (false, None);
    }

    /// Gives up all copies, because the connection is put in use and carries the samples themselves.
    pub(in crate::engine) fn give_up(&mut self, quic: &mut Connection) {
        self.in_flight.drain(..).for_each(|copy| reset(quic, copy.stream));
        (self.bytes, self.is_asking) = (0, false);
    }

    /// Handles that a stream is over: the peer acknowledged all of it. Returns whether it was
    /// that of a copy.
    pub(in crate::engine) fn handle_over(&mut self, stream: StreamId) -> bool {
        let Some(at) = self.in_flight.iter().position(|sent| sent.stream == stream) else {
            return false;
        };
        self.bytes -= self.in_flight.remove(at).bytes;
        true
    }

    /// Handles that the peer wants no more of a stream. Returns whether it was that of a copy.
    pub(in crate::engine) fn handle_stopped(
        &mut self,
        quic: &mut Connection,
        stream: StreamId,
    ) -> bool {
        let is_copy = self.handle_over(stream);
        if is_copy {
            reset(quic, stream);
        }
        is_copy
    }

    /// Returns the number of copies that left.
    pub(in crate::engine) fn sent(&self) -> u64 {
        self.sent
    }

    /// Returns when [`handle_timeout`](Self::handle_timeout) is due.
    pub(in crate::engine) fn poll_timeout(
        &self,
        since: Option<Duration>,
        round_trip: Duration,
    ) -> Option<Duration> {
        let over = self.in_flight.first().map(|oldest| oldest.sent_at + life(round_trip));
        let since = since.filter(|_| self.is_asking);
        let silent = since.map(|since| since + silent_after(round_trip));
        let ping = silent.map(|silent| self.ping_at.map_or(silent, |ping| ping.max(silent)));
        [over, ping].into_iter().flatten().min()
    }

    /// Gives up old copies. Returns whether a PING is due.
    pub(in crate::engine) fn handle_timeout(
        &mut self,
        quic: &mut Connection,
        since: Option<Duration>,
        now: Duration,
    ) -> bool {
        let life = life(quic.rtt());
        while let Some(oldest) = self.in_flight.first()
            && oldest.sent_at + life <= now
        {
            reset(quic, oldest.stream);
            self.bytes -= oldest.bytes;
            self.in_flight.remove(0);
        }
        let is_due = self.is_asking && is_silent(since, quic.rtt(), now);
        let Some(since) = since.filter(|_| is_due) else { return false };
        if self.ping_at.is_some_and(|ping| now < ping) {
            return false;
        }
        let is_first = now < since + FIRST_PINGS.0;
        self.ping_at = Some(now + if is_first { FIRST_PINGS.1 } else { PING });
        true
    }
}

/// Returns the bytes of copies that may be in flight. A PING, and the first packets after a take-over, then fit into the
/// congestion window.
fn most_bytes(quic: &Connection) -> usize {
    usize::try_from(quic.congestion_state().window() / 2).unwrap_or(usize::MAX)
}

fn life(round_trip: Duration) -> Duration {
    LIFE.0.max(LIFE.1 * round_trip).min(LONGEST_LIFE)
}

fn silent_after(round_trip: Duration) -> Duration {
    SILENT.max(ROUND_TRIPS * round_trip)
}

fn is_silent(since: Option<Duration>, round_trip: Duration, now: Duration) -> bool {
    since.is_some_and(|since| since + silent_after(round_trip) <= now)
}

fn reset(quic: &mut Connection, stream: StreamId) {
    // An error means that the stream is over.
    let _ = quic.send_stream(stream).reset(VarInt::from_u32(CloseCode::Goodbye.code()));
}
