//! Delivers copies of small samples, which the peer also sends over the link that stands by.
//!
//! A copy has the number of the sample before it in its flow. It is delivered once that sample is, so the order of a flow
//! stays, and the sample itself then counts as delivered. A copy decides over nothing else: one that cannot be delivered
//! at once, or soon, is dropped without a count, since its sample comes over the link in use.

use std::{collections::HashMap, time::Duration};

use axon_envelope::Kind;
use axon_shm::ids::Gid;
use bytes::{Buf, Bytes};

use super::{
    Inbound, LinkViolation, StreamKey,
    incoming::{IncomingStream, OpenedMessage, StreamStep},
    reading::{StepOutcome, malformed, wait},
};
use crate::{
    engine::{
        rank::SMALL,
        sample::{
            dropped::EarlierFate,
            protection::{MAX_OVERHEAD, Open},
        },
    },
    link::CloseCode,
};

/// Bytes of a copy's number of the sample before it.
pub(super) const AFTER: usize = 8;
/// Maximum length of a copy's message.
const MAX_LENGTH: u64 = (SMALL + MAX_OVERHEAD) as u64;
/// Time for which a copy waits for the sample before it.
const PATIENCE: Duration = Duration::from_secs(1);
/// Maximum number of copies of a peer that wait.
const MAX_WAITING: usize = 32;

/// A copy that was read.
#[derive(Debug)]
pub(super) struct ReadCopy {
    pub(super) message: OpenedMessage,
    /// The time until which it waits.
    pub(super) until: Duration,
}

/// The copies that wait for the sample before them, by flow.
#[derive(Debug, Default)]
pub(super) struct WaitingCopies {
    flows: HashMap<(u32, Gid), Vec<StreamKey>>,
    count: usize,
}

impl WaitingCopies {
    fn add(&mut self, flow: (u32, Gid), key: StreamKey) -> bool {
        let has_room = self.count < MAX_WAITING;
        if has_room {
            self.flows.entry(flow).or_default().push(key);
            self.count += 1;
        }
        has_room
    }

    fn remove(&mut self, flow: (u32, Gid), key: StreamKey) {
        let Some(keys) = self.flows.get_mut(&flow) else { return };
        let before = keys.len();
        keys.retain(|other| *other != key);
        self.count -= before - keys.len();
        if keys.is_empty() {
            self.flows.remove(&flow);
        }
    }

    /// Takes the copies of a flow that moved on.
    fn take(&mut self, flow: (u32, Gid)) -> Vec<StreamKey> {
        if self.flows.is_empty() {
            return Vec::new();
        }
        let keys = self.flows.remove(&flow).unwrap_or_default();
        self.count -= keys.len();
        keys
    }
}

/// Checks that a link may carry copies.
///
/// # Errors
/// Its messages have envelopes of their own, which copies lack.
pub(super) fn permit_copy(open: &Open<'_>) -> Result<(), LinkViolation> {
    match open {
        Open::Link => Ok(()),
        Open::Envelope { .. } => Err(malformed("a copy of a sample without an envelope")),
    }
}

/// Checks the length of a copy's message.
///
/// # Errors
/// It is longer than the samples that are copied.
pub(super) fn permit_length(length: u64) -> Result<(), LinkViolation> {
    if length <= MAX_LENGTH {
        return Ok(());
    }
    let text = format!("a copy of {length} bytes, at most {MAX_LENGTH} are allowed");
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
        self.waiting_copies.remove(flow, key);
        let Some(found) = self.routes.get(&header.route) else { return StepOutcome::Over };
        let Some(stand_in) = found.writers.get(&message.writer).cloned() else {
            return StepOutcome::Over;
        };
        let number = message.number;
        let last = match route.kind {
            Kind::Topic | Kind::Request => stand_in.last_sequence(),
            Kind::Response => found.clients.get(&header.of).copied(),
        };
        let is_known = last >= Some(number) || stand_in.dropped(number) != EarlierFate::Unknown;
        if is_known || !found.limit.is_none() {
            return StepOutcome::Over;
        }
        // Before the first sample of a flow, samples of an earlier link may be unread.
        let is_next = match stream.after {
            0 => last.unwrap_or(0) == 0 && !self.turns.contains_key(&flow),
            after => last >= Some(after) || stand_in.dropped(after) != EarlierFate::Unknown,
        };
        if !is_next {
            if now >= until || !self.waiting_copies.add(flow, key) {
                return StepOutcome::Over;
            }
            self.waiting.insert((until, key));
            return wait(stream, StreamStep::Copy(ReadCopy { message, until }));
        }
        let OpenedMessage { meta, payload, .. } = message;
        let since = &mut stream.short_since;
        let Some(there) = self.write(&stand_in, header, meta, &payload, since, now) else {
            return StepOutcome::Over;
        };
        if route.kind == Kind::Response
            && let Some(found) = self.routes.get_mut(&header.route)
        {
            found.clients.entry(header.of).and_modify(|last| *last = number);
        }
        if there {
            self.receipts.came(flow, number, payload.len(), now);
            self.counters.arrived_first();
        } else {
            self.receipts.dropped(flow, number, now);
        }
        self.handle_delivered(flow);
        StepOutcome::Over
    }

    /// Returns the next step of a copy that was opened.
    pub(super) fn copy_step(message: OpenedMessage, now: Duration) -> StreamStep {
        StreamStep::Copy(ReadCopy { message, until: now + PATIENCE })
    }

    /// Continues the copies that waited for a sample of this flow.
    pub(super) fn handle_delivered(&mut self, flow: (u32, Gid)) {
        for key in self.waiting_copies.take(flow) {
            self.make_ready(key);
        }
    }

    /// Forgets that a copy waits.
    pub(super) fn forget_copy(&mut self, key: StreamKey, stream: &IncomingStream) {
        if let (StreamStep::Copy(copy), Some((header, _))) = (&stream.step, stream.header) {
            self.waiting.remove(&(copy.until, key));
            self.waiting_copies.remove((header.route, header.of), key);
        }
    }
}
