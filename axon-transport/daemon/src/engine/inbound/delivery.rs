//! Delivers whole messages to the rings of stand-ins: once each, as far as limits and space allow.

use std::{rc::Rc, time::Duration};

use axon_envelope::Kind;
use axon_shm::Meta;
use axon_transport::internal::session::Written;

use super::{
    FULL_RETRY, Inbound, RouteIn, StreamKey,
    incoming::{IncomingStream, OpenedMessage, StreamStep},
    reading::{StepOutcome, wait},
};
use crate::engine::sample::stream_header::StreamHeader;
use crate::engine::{rings::RingError, sample::dropped::EarlierFate, stand_in::StandIn};

/// Maximum time that a message waits while other rings of its peer have the memory that it needs. The readers of these
/// rings may never take their samples, and history stays for as long as its publisher. A ring that has samples itself
/// is full, and waits for its own readers.
const LONGEST_SHORT: Duration = Duration::from_secs(60);

impl Inbound {
    /// Writes a message to its ring.
    pub(super) fn deliver(
        &mut self,
        key: StreamKey,
        stream: &mut IncomingStream,
        message: OpenedMessage,
        until: Duration,
        now: Duration,
    ) -> StepOutcome {
        let Some((header, Some(route))) = stream.header else { return StepOutcome::Over };
        let found = self.routes.get(&header.route);
        let Some(stand_in) = found.and_then(|route| route.writers.get(&message.writer)) else {
            if found.is_some() && now < until {
                self.waiting.insert((until, key));
                return wait(stream, StreamStep::Writer(message, until));
            }
            self.waiting.remove(&(until, key));
            // Its copy was delivered while its publisher was still there.
            let is_known =
                self.copies.newest_delivered((header.route, header.of)) >= Some(message.number);
            if !is_known {
                self.counters.lost(&self.topic(header.route), "no_route", 1);
            }
            if !is_known && header.acknowledged {
                // The sender would keep it for as long as the link stands.
                self.receipts.dropped((header.route, header.of), message.number, now);
            }
            self.release(stream);
            return StepOutcome::Go;
        };
        self.waiting.remove(&(until, key));
        let of_topic = route.kind == Kind::Topic;
        let acknowledged = header.reliable && (of_topic || header.acknowledged);
        let flow = (header.route, header.of);
        let (sequence, length) = (message.number, message.payload.len());
        let last = match route.kind {
            Kind::Topic | Kind::Request => stand_in.last_sequence(),
            Kind::Response => found.and_then(|route| route.clients.get(&header.of)).copied(),
        };
        let before = stand_in.dropped(sequence);
        if acknowledged && before == EarlierFate::Dropped {
            self.receipts.dropped_again(flow, sequence, now);
            self.release(stream);
            return StepOutcome::Go;
        }
        if acknowledged && (before == EarlierFate::Passed || last >= Some(sequence)) {
            self.receipts.came(flow, sequence, length, now);
            self.copies.handle_sample(flow, sequence);
            self.release(stream);
            return StepOutcome::Go;
        }
        if !header.reliable && last >= Some(sequence) {
            // A newer sample overtook it: readers drop it.
            self.counters.lost(&self.topic(header.route), "late", 1);
            self.release(stream);
            return StepOutcome::Over;
        }
        let stand_in = Rc::clone(stand_in);
        let limit = found.map(|route| &route.limit).filter(|limit| !limit.is_none()).cloned();
        let message = match &limit {
            Some(limit) => match self.pass_limit(key, stream, limit, message, now) {
                Ok(message) => message,
                Err(Some(next)) => return next,
                Err(None) => {
                    if acknowledged {
                        stand_in.drop_sample(sequence);
                    }
                    return self.after_drop(stream, acknowledged, sequence, now);
                }
            },
            None => message,
        };
        let OpenedMessage { meta, payload, .. } = &message;
        let since = &mut stream.short_since;
        let Some(there) = self.write(&stand_in, header, *meta, payload, since, now) else {
            return self.wait_for_room(key, stream, message, now);
        };
        if let Some(limit) = &limit {
            limit.pass(&header.of, length, now);
        }
        if acknowledged
            && route.kind == Kind::Response
            && let Some(found) = self.routes.get_mut(&header.route)
        {
            found.clients.entry(header.of).and_modify(|last| *last = sequence);
        }
        if !there {
            return self.after_drop(stream, acknowledged, sequence, now);
        }
        if acknowledged {
            self.receipts.came(flow, sequence, length, now);
            self.copies.handle_sample(flow, sequence);
            self.handle_decided(flow);
        }
        self.release(stream);
        if header.reliable { StepOutcome::Go } else { StepOutcome::Over }
    }

    /// Continues after a message that was dropped and counted. Reports that to the peer if it waits for an
    /// acknowledgement.
    fn after_drop(
        &mut self,
        stream: &mut IncomingStream,
        acknowledged: bool,
        sequence: u64,
        now: Duration,
    ) -> StepOutcome {
        let Some((header, _)) = stream.header else { return StepOutcome::Over };
        if acknowledged {
            self.receipts.dropped((header.route, header.of), sequence, now);
            self.handle_decided((header.route, header.of));
        }
        self.release(stream);
        if header.reliable { StepOutcome::Go } else { StepOutcome::Over }
    }

    /// Writes a sample to its ring. Returns whether it was written; `None` if the ring is full. `short_since` is the
    /// time since which memory alone has been missing.
    pub(super) fn write(
        &mut self,
        stand_in: &Rc<StandIn>,
        header: StreamHeader,
        meta: Meta,
        payload: &[u8],
        short_since: &mut Option<Duration>,
        now: Duration,
    ) -> Option<bool> {
        let written = stand_in.try_write(&header.of, meta, payload, now);
        if let Err(RingError::Short(_)) = &written
            && self.may_wait(header)
            && now < *short_since.get_or_insert(now) + LONGEST_SHORT
        {
            return None;
        }
        *short_since = None;
        match written {
            Ok(Written::Yes) => {
                self.counters.arrived(payload.len());
                self.announce_later(stand_in);
                Some(true)
            }
            Ok(Written::Nobody) => {
                self.counters.lost(&self.topic(header.route), "no_client", 1);
                Some(false)
            }
            Err(RingError::Full) => None,
            Err(RingError::Short(why)) => {
                if header.reliable {
                    stand_in.drop_sample(meta.sequence);
                }
                self.lost("held", header, &why, now);
                Some(false)
            }
            Err(RingError::Lost(why)) => {
                self.lost("ring", header, &why, now);
                Some(false)
            }
        }
    }

    /// Returns whether the stream's next message may wait here: calls may, and samples whose publisher waits for its
    /// readers anyway.
    pub(super) fn may_wait(&self, header: StreamHeader) -> bool {
        let waits = |route: &RouteIn| route.route.kind != Kind::Topic || route.keeps_all;
        header.reliable && self.routes.get(&header.route).is_some_and(waits)
    }

    /// Makes a message wait because its ring is full.
    pub(super) fn wait_for_room(
        &mut self,
        key: StreamKey,
        stream: &mut IncomingStream,
        message: OpenedMessage,
        now: Duration,
    ) -> StepOutcome {
        self.full.insert(key);
        self.full_retry.get_or_insert(now + FULL_RETRY);
        wait(stream, StreamStep::Ring(message))
    }
}
