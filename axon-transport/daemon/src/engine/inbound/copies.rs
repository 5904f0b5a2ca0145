//! Delivers copies of small samples, which the peer also sends over the link that stands by.
//!
//! A copy has the number of the sample before it in its flow. It is delivered once that sample is, so the order of a flow
//! stays, and the sample itself then counts as delivered. Nothing else happens because of a copy: one that cannot be
//! delivered now, or within a second, is dropped without a count, since its sample comes over the link in use.

use std::{
    collections::{HashMap, VecDeque},
    time::Duration,
};

use axon_envelope::Kind;
use axon_shm::ids::Gid;
use bytes::{Buf, Bytes};

use super::{
    Inbound, LinkViolation, StreamKey,
    incoming::{IncomingStream, OpenedMessage, StreamStep},
    reading::{StepOutcome, wait},
};
use crate::{
    engine::{
        rank::SMALL,
        sample::{dropped::EarlierFate, protection::MAX_OVERHEAD},
    },
    link::CloseCode,
};

/// Bytes of a copy's number of the sample before it.
pub(super) const AFTER: usize = 8;
/// Maximum length of a copy's message, with its headers or its envelope.
const MAX_LENGTH: u64 = (SMALL + MAX_OVERHEAD) as u64;
/// Time for which a copy waits for the sample before it.
const PATIENCE: Duration = Duration::from_secs(1);
/// Maximum number of copies of a peer, and of one flow, that wait.
const MAX_WAITING: (usize, usize) = (32, 8);
/// Maximum number of flows whose delivered copies are remembered.
const MAX_DELIVERED: usize = 64;

/// A copy that was read.
#[derive(Debug)]
pub(super) struct ReadCopy {
    pub(super) message: OpenedMessage,
    /// The time until which it waits.
    pub(super) until: Duration,
}

/// The copies of one peer.
#[derive(Debug, Default)]
pub(super) struct Copies {
    /// The copies that wait for the sample before them, by flow.
    waiting: HashMap<(u32, Gid), Vec<StreamKey>>,
    count: usize,
    /// The newest copy that was delivered before its sample, by flow.
    delivered: VecDeque<((u32, Gid), u64)>,
}

impl Copies {
    /// Makes a copy wait. Returns whether it may.
    fn add(&mut self, flow: (u32, Gid), key: StreamKey) -> bool {
        let of_flow = self.waiting.get(&flow).map_or(0, Vec::len);
        let has_room = self.count < MAX_WAITING.0 && of_flow < MAX_WAITING.1;
        if has_room {
            self.waiting.entry(flow).or_default().push(key);
            self.count += 1;
        }
        has_room
    }

    /// Returns the number of copies that wait.
    #[cfg(test)]
    pub(super) fn waiting(&self) -> usize {
        self.count
    }

    fn remove(&mut self, flow: (u32, Gid), key: StreamKey) {
        let Some(keys) = self.waiting.get_mut(&flow) else { return };
        let before = keys.len();
        keys.retain(|other| *other != key);
        self.count -= before - keys.len();
        if keys.is_empty() {
            self.waiting.remove(&flow);
        }
    }

    /// Takes the copies of a flow that moved on.
    fn take(&mut self, flow: (u32, Gid)) -> Vec<StreamKey> {
        if self.waiting.is_empty() {
            return Vec::new();
        }
        let keys = self.waiting.remove(&flow).unwrap_or_default();
        self.count -= keys.len();
        keys
    }

    /// Records that a copy was delivered. Its sample may come after its publisher, or client, is gone.
    fn note_delivered(&mut self, flow: (u32, Gid), number: u64) {
        match self.delivered.iter_mut().find(|(of, _)| *of == flow) {
            Some((_, newest)) => *newest = number,
            None => self.delivered.push_back((flow, number)),
        }
        if self.delivered.len() > MAX_DELIVERED {
            self.delivered.pop_front();
        }
    }

    /// Returns the number of the newest delivered copy of a flow.
    pub(super) fn newest_delivered(&self, flow: (u32, Gid)) -> Option<u64> {
        self.delivered.iter().find(|(of, _)| *of == flow).map(|(_, newest)| *newest)
    }

    /// Handles that the samples up to this number came over the link in use.
    pub(super) fn handle_sample(&mut self, flow: (u32, Gid), number: u64) {
        self.delivered.retain(|(of, newest)| *of != flow || *newest > number);
    }
}

/// Checks the length of a copy's message before it is read. The payload in it is at most as long.
///
/// # Errors
/// It is longer than any message with a payload that is copied.
pub(super) fn permit_length(length: u64) -> Result<(), LinkViolation> {
    if length <= MAX_LENGTH {
        return Ok(());
    }
    let text = format!("a copy of {length} bytes, at most {MAX_LENGTH} are allowed");
    Err((CloseCode::TooLarge, text))
}

/// Checks the length of a copy's payload. Its headers, and in `messages10` its envelope, do not count.
///
/// # Errors
/// It is longer than the samples that are copied.
pub(super) fn permit_payload(length: usize) -> Result<(), LinkViolation> {
    if length <= SMALL {
        return Ok(());
    }
    let text = format!("a copy with a payload of {length} bytes, at most {SMALL} are allowed");
    Err((CloseCode::TooLarge, text))
}

/// Reads the number of the sample before a copy.
pub(super) fn read_after(mut bytes: Bytes) -> u64 {
    bytes.get_u64()
}

impl Inbound {
    /// Delivers a copy, makes it wait for the sample before it, or drops it.
    pub(super) fn deliver_copy(
        &mut self,
        key: StreamKey,
        stream: &mut IncomingStream,
        copy: ReadCopy,
        now: Duration,
    ) -> StepOutcome {
        let Some((header, Some(route))) = stream.header else { return StepOutcome::Over };
        let ReadCopy { message, until } = copy;
        let flow = (header.route, header.of);
        self.waiting.remove(&(until, key));
        self.copies.remove(flow, key);
        let found = self.routes.get(&header.route).filter(|route| route.has_flow(&header.of));
        let Some(found) = found else { return StepOutcome::Over };
        let Some(stand_in) = found.writers.get(&message.writer).cloned() else {
            return StepOutcome::Over;
        };
        let number = message.number;
        let (last, is_new) = match route.kind {
            Kind::Topic | Kind::Request => (stand_in.last_sequence(), stand_in.is_new()),
            Kind::Response => {
                let last = found.clients.get(&header.of).copied();
                (last, last.is_none_or(|last| last == 0))
            }
        };
        let is_decided = |number| stand_in.dropped(number) != EarlierFate::Unknown;
        if last >= Some(number) || is_decided(number) || !found.limit.is_none() {
            return StepOutcome::Over;
        }
        // Before the first sample of a flow, samples of an earlier link may be unread.
        let is_next = match stream.after {
            0 => is_new && !self.turns.contains_key(&flow),
            after => last >= Some(after) || is_decided(after),
        };
        if now >= until {
            return StepOutcome::Over;
        }
        if !is_next {
            if !self.copies.add(flow, key) {
                return StepOutcome::Over;
            }
            self.waiting.insert((until, key));
            return wait(stream, StreamStep::Copy(ReadCopy { message, until }));
        }
        let OpenedMessage { meta, payload, .. } = message;
        if !stand_in.try_write_copy(&header.of, meta, &payload, now) {
            return StepOutcome::Over;
        }
        if route.kind == Kind::Response
            && let Some(found) = self.routes.get_mut(&header.route)
        {
            found.clients.entry(header.of).and_modify(|last| *last = number);
        }
        self.counters.arrived_as_copy(payload.len());
        self.announce_later(&stand_in);
        self.receipts.came(flow, number, payload.len(), now);
        self.copies.note_delivered(flow, number);
        self.handle_decided(flow);
        StepOutcome::Over
    }

    /// Returns the next step of a copy that was opened.
    pub(super) fn copy_step(message: OpenedMessage, now: Duration) -> StreamStep {
        StreamStep::Copy(ReadCopy { message, until: now + PATIENCE })
    }

    /// Continues the copies that waited for a sample of this flow, which was delivered or dropped.
    pub(super) fn handle_decided(&mut self, flow: (u32, Gid)) {
        for key in self.copies.take(flow) {
            self.make_ready(key);
        }
    }

    /// Forgets that a copy waits.
    pub(super) fn forget_copy(&mut self, key: StreamKey, stream: &IncomingStream) {
        if let (StreamStep::Copy(copy), Some((header, _))) = (&stream.step, stream.header) {
            self.waiting.remove(&(copy.until, key));
            self.copies.remove((header.route, header.of), key);
        }
    }
}
