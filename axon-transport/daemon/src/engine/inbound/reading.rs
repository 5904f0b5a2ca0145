//! Reads data streams step by step.

use std::time::Duration;

use axon_envelope::{Kind, Route, inner};
use axon_shm::{Meta, ids::Gid};
use bytes::Bytes;

use super::{
    ARRIVAL, ENDED, Inbound, LONG_MESSAGE_BYTES, LinkViolation, NO_ROUTE, StreamKey, TURN,
    copies::{AFTER, permit_length, permit_payload, read_after},
    incoming::{IncomingStream, OpenedMessage, Piece, StreamStep},
};
use crate::engine::sample::stream_header::{HEADER, StreamHeader};
use crate::{
    engine::{
        account::Charge,
        sample::{
            protection::{
                MAX_OVERHEAD, Open, OpenedSample, RefusedMessage, unpack, unpacked_length,
                writer_of,
            },
            short_header::{ShortHeader, ShortHeaders},
        },
    },
    link::CloseCode,
};

impl Inbound {
    /// Reads a stream as far as possible. Returns the number of bytes read, including those gained by decompression. A
    /// link that stands by carries `copies_alone`.
    ///
    /// # Errors
    /// The peer broke a rule.
    pub(crate) fn read(
        &mut self,
        key: StreamKey,
        quic: &mut quinn_proto::Connection,
        open: &mut Open<'_>,
        copies_alone: bool,
        now: Duration,
    ) -> Result<usize, LinkViolation> {
        if let Some(stream) = self.streams.get_mut(&key) {
            stream.copies_alone = copies_alone;
        }
        let read = self.read_turn(key, quic, open, now);
        if let Some(written) = self.written.take() {
            written.announce();
        }
        read
    }

    fn read_turn(
        &mut self,
        key: StreamKey,
        quic: &mut quinn_proto::Connection,
        open: &mut Open<'_>,
        now: Duration,
    ) -> Result<usize, LinkViolation> {
        let Some(mut stream) = self.streams.remove(&key) else { return Ok(0) };
        let mut read = 0;
        loop {
            let step = self.step(key, &mut stream, quic, open, &mut read, now);
            let next = match step {
                Ok(next) => next,
                Err(violation) => {
                    self.release(&mut stream);
                    self.end_turn(key, &stream);
                    return Err(violation);
                }
            };
            match next {
                StepOutcome::Go if read < TURN => {}
                StepOutcome::Go => {
                    stream.is_ready = true;
                    self.ready.push_back(key);
                    break;
                }
                StepOutcome::Wait => break,
                StepOutcome::Over => {
                    self.end_turn(key, &stream);
                    if stream.is_over(key.1, quic) {
                        return Ok(read);
                    }
                    stream.step = StreamStep::Over;
                    break;
                }
            }
        }
        self.streams.insert(key, stream);
        Ok(read)
    }

    fn step(
        &mut self,
        key: StreamKey,
        stream: &mut IncomingStream,
        quic: &mut quinn_proto::Connection,
        open: &mut Open<'_>,
        read: &mut usize,
        now: Duration,
    ) -> Result<StepOutcome, LinkViolation> {
        match std::mem::replace(&mut stream.step, StreamStep::Length) {
            StreamStep::Header => {
                let header = match stream.take(HEADER, key.1, quic, read) {
                    Piece::Whole(header) => header,
                    Piece::Later => return Ok(wait(stream, StreamStep::Header)),
                    Piece::End => return Ok(StepOutcome::Over),
                };
                let header = StreamHeader::parse(&header).map_err(malformed)?;
                stream.header = Some((header, None));
                stream.headers = header.short.then(ShortHeaders::default);
                stream.step = StreamStep::Election;
                Ok(StepOutcome::Go)
            }
            StreamStep::Election => {
                let Some((header, _)) = stream.header else { return Ok(StepOutcome::Over) };
                if header.copy {
                    stream.step = StreamStep::After;
                    return Ok(StepOutcome::Go);
                }
                if stream.copies_alone {
                    self.parked.insert(key);
                    return Ok(wait(stream, StreamStep::Election));
                }
                let turns = self.turns.entry((header.route, header.of)).or_default();
                turns.push_back(key);
                self.waiting.insert((now + ARRIVAL, key));
                stream.step = StreamStep::Turn(now + ARRIVAL);
                Ok(StepOutcome::Go)
            }
            StreamStep::After => {
                let after = match stream.take(AFTER, key.1, quic, read) {
                    Piece::Whole(after) => after,
                    Piece::Later => return Ok(wait(stream, StreamStep::After)),
                    Piece::End => return Ok(StepOutcome::Over),
                };
                stream.after = read_after(after);
                let Some((header, of_route)) = &mut stream.header else {
                    return Ok(StepOutcome::Over);
                };
                *of_route = self.routes.get(&header.route).map(|route| route.route);
                Ok(if of_route.is_some() { StepOutcome::Go } else { StepOutcome::Over })
            }
            StreamStep::Copy(copy) => Ok(self.deliver_copy(key, stream, copy, now)),
            StreamStep::Turn(until) => Ok(self.begin(key, stream, quic, until, now)),
            StreamStep::Length => {
                let copies = stream.header.is_some_and(|(header, _)| header.copy);
                if !copies && let Some(next) = self.run(key, stream, open, now)? {
                    return Ok(next);
                }
                let prefix = match stream.take(4, key.1, quic, read) {
                    Piece::Whole(prefix) => prefix,
                    Piece::Later => return Ok(wait(stream, StreamStep::Length)),
                    Piece::End => return Ok(StepOutcome::Over),
                };
                let mut bytes = [0; 4];
                bytes.copy_from_slice(&prefix);
                let length = u64::from(u32::from_be_bytes(bytes));
                if copies {
                    permit_length(length)?;
                }
                let limit = self.max_message + MAX_OVERHEAD as u64;
                if length > limit {
                    let text = format!("a message of {length} bytes, at most {limit} are allowed");
                    return Err((CloseCode::TooLarge, text));
                }
                stream.step = StreamStep::Room(length as usize);
                Ok(StepOutcome::Go)
            }
            StreamStep::Room(length) => {
                if length > LONG_MESSAGE_BYTES {
                    // One message may always be read, whatever its length.
                    let Some(room) = self.intake.long.charge(length.min(self.intake.long.most()))
                    else {
                        self.without_room.add(key);
                        return Ok(wait(stream, StreamStep::Room(length)));
                    };
                    stream.room = Some(room);
                }
                stream.step = StreamStep::Body(length);
                Ok(StepOutcome::Go)
            }
            StreamStep::Body(length) => {
                // A message that has arrived completely needs no charge.
                if stream.room.is_none() && !stream.has(length) {
                    let room = self.intake.short.charge(length);
                    let Some(room) = room.or_else(|| self.spare.charge(length)) else {
                        self.without_room.add(key);
                        return Ok(wait(stream, StreamStep::Body(length)));
                    };
                    stream.room = Some(room);
                }
                let body = match stream.take(length, key.1, quic, read) {
                    Piece::Whole(body) => body,
                    Piece::Later => return Ok(wait(stream, StreamStep::Body(length))),
                    Piece::End => {
                        self.release(stream);
                        return Ok(StepOutcome::Over);
                    }
                };
                self.open(stream, body, open, now)
            }
            StreamStep::Unpack(header, sent) => self.unpack(key, stream, header, sent, read, now),
            StreamStep::Over => Ok(StepOutcome::Over),
            StreamStep::Writer(message, until) => {
                Ok(self.deliver(key, stream, message, until, now))
            }
            StreamStep::Ring(message) => Ok(self.deliver(key, stream, message, now, now)),
        }
    }

    /// Begins to read a stream once its route exists and it is the stream's turn.
    fn begin(
        &mut self,
        key: StreamKey,
        stream: &mut IncomingStream,
        quic: &mut quinn_proto::Connection,
        until: Duration,
        now: Duration,
    ) -> StepOutcome {
        let Some((header, _)) = stream.header else { return StepOutcome::Over };
        let route = self.routes.get(&header.route);
        let found = route.filter(|route| route.has_flow(&header.of));
        let Some(found) = found else {
            let until = if until == Duration::MAX { now + ARRIVAL } else { until };
            if route.is_some() && now < until {
                self.waiting.insert((until, key));
                return wait(stream, StreamStep::Turn(until));
            }
            self.waiting.remove(&(until, key));
            // The copies of its last samples were delivered while its publisher was still there.
            if self.copies.newest_delivered((header.route, header.of)).is_none() {
                self.counters.lost(&self.topic(header.route), "no_route", 1);
            }
            let _ = quic.recv_stream(key.1).stop(NO_ROUTE);
            return StepOutcome::Over;
        };
        stream.header = Some((header, Some(found.route)));
        self.waiting.remove(&(until, key));
        let turns = self.turns.get(&(header.route, header.of));
        if turns.is_some_and(|turns| turns.front() != Some(&key)) {
            // When the previous stream ends, this one becomes ready.
            return wait(stream, StreamStep::Turn(Duration::MAX));
        }
        stream.step = StreamStep::Length;
        StepOutcome::Go
    }

    /// Opens a message that has arrived.
    fn open(
        &mut self,
        stream: &mut IncomingStream,
        body: Bytes,
        open: &mut Open<'_>,
        now: Duration,
    ) -> Result<StepOutcome, LinkViolation> {
        let Some((header, Some(route))) = stream.header else { return Ok(StepOutcome::Over) };
        if let Some(short) = &mut stream.headers {
            permit_short(route, open)?;
            let (told, payload) = short.read(&body).map_err(malformed)?;
            let meta = self.meta(told, now);
            let (writer, number, payload) = (header.of, meta.sequence, body.slice_ref(payload));
            let message = OpenedMessage { writer, number, meta, payload };
            stream.step = StreamStep::Writer(message, now + ARRIVAL);
            return Ok(StepOutcome::Go);
        }
        let opened = match open_body(open, body, route, now) {
            // A copy may come after its key was retired. Its sample comes over the link in use.
            Ok(None) | Err(RefusedMessage::Envelope { .. }) if header.copy => {
                self.release(stream);
                return Ok(StepOutcome::Over);
            }
            opened => opened.map_err(refused)?,
        };
        let Some((opened, payload)) = opened else {
            self.lost("no_link", header, ENDED, now);
            self.release(stream);
            return Ok(StepOutcome::Go);
        };
        let numbered = header.acknowledged && route.kind == Kind::Response;
        writer_of(route.kind, header.of, numbered, &opened).map_err(malformed)?;
        if header.copy {
            if opened.compressed {
                return Err(malformed("a copy that is compressed"));
            }
            permit_payload(payload.len())?;
            let message = self.message(header, route, &opened, payload, now);
            self.release(stream);
            stream.step = Self::copy_step(message, now);
            return Ok(StepOutcome::Go);
        }
        if opened.compressed {
            stream.step = StreamStep::Unpack(opened, payload);
            return Ok(StepOutcome::Go);
        }
        let message = self.message(header, route, &opened, payload, now);
        stream.step = StreamStep::Writer(message, now + ARRIVAL);
        Ok(StepOutcome::Go)
    }

    /// Decompresses a message once there is memory for it: a few bytes may become a long message, which then waits for
    /// its ring.
    fn unpack(
        &mut self,
        key: StreamKey,
        stream: &mut IncomingStream,
        header: inner::Header,
        sent: Bytes,
        read: &mut usize,
        now: Duration,
    ) -> Result<StepOutcome, LinkViolation> {
        let length = unpacked_length(&header, self.max_message).map_err(refused)?;
        let has = stream.room.as_ref().map_or(0, Charge::amount);
        let is_long = length > LONG_MESSAGE_BYTES;
        let most = if is_long { self.intake.long.most() } else { length };
        let more = length.min(most).saturating_sub(has);
        if more > 0 && stream.unpacked.is_none() {
            let room = match is_long {
                true => self.intake.long.charge(more),
                false => self.intake.short.charge(more).or_else(|| self.spare.charge(more)),
            };
            let Some(room) = room else {
                self.without_room.add(key);
                return Ok(wait(stream, StreamStep::Unpack(header, sent)));
            };
            stream.unpacked = Some(room);
        }
        let payload = unpack(&sent, length).map_err(refused)?.into();
        *read += length;
        let Some((of_stream, Some(route))) = stream.header else { return Ok(StepOutcome::Over) };
        let message = self.message(of_stream, route, &header, payload, now);
        stream.step = StreamStep::Writer(message, now + ARRIVAL);
        Ok(StepOutcome::Go)
    }

    /// Creates the message of a stream. Its writer was checked before.
    fn message(
        &self,
        of_stream: StreamHeader,
        route: Route,
        header: &inner::Header,
        payload: Bytes,
        now: Duration,
    ) -> OpenedMessage {
        let mut meta = self.meta(told(header), now);
        let number = meta.sequence;
        if of_stream.acknowledged && route.kind == Kind::Response {
            meta.sequence = header.request_id.sequence.unsigned_abs();
        }
        OpenedMessage { writer: Gid(header.gid), number, meta, payload }
    }

    /// Returns the metadata of a sample for the ring.
    pub(super) fn meta(&self, told: ShortHeader, now: Duration) -> Meta {
        Meta::at_nanos(told.sequence, told.source_timestamp)
            .with_published_nanos(self.published(told.age_ms, now))
    }

    /// Returns when a sample of this age was published, in nanoseconds of this host's CLOCK_MONOTONIC.
    fn published(&self, age_ms: u32, now: Duration) -> u64 {
        let arrived = self.epoch_nanos.saturating_add(now.as_nanos() as u64);
        // Zero would mean an infinite lifespan.
        arrived.saturating_sub(u64::from(age_ms) * 1_000_000).max(1)
    }

    /// Gives back the memory of a message, which another stream may wait for.
    pub(super) fn release(&mut self, stream: &mut IncomingStream) {
        let room = [stream.room.take(), stream.unpacked.take()];
        if room.iter().any(Option::is_some) {
            drop(room);
            self.try_without_room();
        }
    }

    pub(super) fn end_turn(&mut self, key: StreamKey, stream: &IncomingStream) {
        let Some((header, _)) = stream.header.filter(|(header, _)| !header.copy) else { return };
        let flow = (header.route, header.of);
        let Some(turns) = self.turns.get_mut(&flow) else { return };
        turns.retain(|other| *other != key);
        match turns.front().copied() {
            Some(next) => self.make_ready(next),
            None => {
                self.turns.remove(&flow);
                self.handle_decided(flow);
            }
        }
    }
}

/// The result of a step.
#[derive(Debug)]
pub(super) enum StepOutcome {
    /// Take the next step.
    Go,
    /// Nothing more can be done now.
    Wait,
    /// The stream is at its end.
    Over,
}

pub(super) fn wait(stream: &mut IncomingStream, step: StreamStep) -> StepOutcome {
    stream.step = step;
    StepOutcome::Wait
}

/// Checks that a stream of this route may have short headers.
///
/// # Errors
/// The peer broke the format.
pub(super) fn permit_short(route: Route, open: &Open<'_>) -> Result<(), LinkViolation> {
    match (route.kind, open) {
        (Kind::Topic, Open::Link) => Ok(()),
        _ => Err(malformed("a data stream has short headers that may not have them")),
    }
}

/// Returns the data of a message's inner header besides its writer.
pub(super) fn told(header: &inner::Header) -> ShortHeader {
    let inner::Header { sequence, source_timestamp, age_ms, .. } = *header;
    ShortHeader { sequence, source_timestamp, age_ms }
}

pub(super) fn malformed(reason: &str) -> LinkViolation {
    (CloseCode::Malformed, reason.to_owned())
}

pub(super) fn refused(error: RefusedMessage) -> LinkViolation {
    let code = match error {
        RefusedMessage::Envelope { .. } => CloseCode::Envelope,
        RefusedMessage::Malformed(_) => CloseCode::Malformed,
    };
    (code, error.to_string())
}

/// Opens a body. The payload, compressed if its header says so, shares its memory.
fn open_body(
    open: &mut Open<'_>,
    body: Bytes,
    route: Route,
    now: Duration,
) -> Result<Option<(inner::Header, Bytes)>, RefusedMessage> {
    // An envelope is opened in place, so it needs memory of its own.
    match open {
        Open::Link => {
            let opened = OpenedSample::plain(&body)?;
            let (header, sent) = (opened.header, body.slice_ref(opened.sent()));
            Ok(Some((header, sent)))
        }
        Open::Envelope { .. } => {
            let mut own = body.try_into_mut().unwrap_or_else(|shared| shared.as_ref().into());
            let start = own.as_ptr().addr();
            let Some(opened) = open.open(&mut own, route, now)? else { return Ok(None) };
            let (header, sent) = (opened.header, opened.sent());
            let at = sent.as_ptr().addr() - start;
            let range = at..at + sent.len();
            Ok(Some((header, own.freeze().slice(range))))
        }
    }
}
