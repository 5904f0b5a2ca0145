//! Delivers the short samples that are complete in the last chunk from QUIC, without a step of the stream for each.

use std::{rc::Rc, time::Duration};

use axon_envelope::{Kind, Route};
use bytes::{Buf, Bytes};

use super::{
    ENDED, Inbound, LONG_MESSAGE_BYTES, LinkViolation, RouteIn, StreamKey,
    incoming::{IncomingStream, OpenedMessage, StreamStep},
    reading::{StepOutcome, malformed, permit_short, refused, told},
};
use crate::engine::sample::stream_header::StreamHeader;
use crate::engine::{
    sample::{
        dropped::EarlierFate,
        protection::{MAX_OVERHEAD, Open, writer_of},
        short_header::ShortHeader,
    },
    stand_in::StandIn,
};

/// Size in bytes of the length in front of each message.
const LENGTH: usize = 4;

/// The destination of the samples of a run.
struct BatchTarget {
    header: StreamHeader,
    route: Route,
    stand_in: Rc<StandIn>,
    /// The maximum length of a message.
    most: u64,
    now: Duration,
}

/// The samples to be acknowledged after a run.
#[derive(Default)]
struct BatchProgress {
    newest: Option<u64>,
    samples: u64,
    bytes: usize,
}

impl Inbound {
    /// Delivers the complete samples of a topic's RELIABLE stream that have arrived. Returns `None` if the stream
    /// continues with a step.
    ///
    /// # Errors
    /// The peer broke a rule.
    pub(super) fn run(
        &mut self,
        key: StreamKey,
        stream: &mut IncomingStream,
        open: &mut Open<'_>,
        now: Duration,
    ) -> Result<Option<StepOutcome>, LinkViolation> {
        let Some((header, Some(route))) = stream.header else { return Ok(None) };
        if !header.reliable || route.kind != Kind::Topic || !stream.gathered.is_empty() {
            return Ok(None);
        }
        // If there are limits, each sample has a step of its own.
        let unlimited = |of: &&RouteIn| of.limit.is_none();
        let writers = |of: &RouteIn| of.writers.get(&header.of).cloned();
        let Some(stand_in) = self.routes.get(&header.route).filter(unlimited).and_then(writers)
        else {
            return Ok(None);
        };
        let most = self.max_message + MAX_OVERHEAD as u64;
        let (to, mut came) =
            (BatchTarget { header, route, stand_in, most, now }, BatchProgress::default());
        let mut envelope = std::mem::take(&mut self.envelope);
        let next = self.deliver_all(&to, stream, open, &mut envelope, &mut came);
        self.envelope = envelope;
        let flow = (header.route, header.of);
        if let Some(newest) = came.newest {
            self.receipts.came_all(flow, newest, came.samples, came.bytes, now);
            self.copies.handle_sample(flow, newest);
        }
        self.handle_decided(flow);
        match next? {
            None => Ok(None),
            Some(StreamStep::Ring(message)) => {
                Ok(Some(self.wait_for_room(key, stream, message, now)))
            }
            Some(step) => {
                stream.step = step;
                Ok(Some(StepOutcome::Go))
            }
        }
    }

    /// Delivers samples until none is complete, or one has to wait: for space in the ring, or for its decompression.
    /// Returns the stream's next step.
    fn deliver_all(
        &mut self,
        to: &BatchTarget,
        stream: &mut IncomingStream,
        open: &mut Open<'_>,
        envelope: &mut Vec<u8>,
        came: &mut BatchProgress,
    ) -> Result<Option<StreamStep>, LinkViolation> {
        let now = to.now;
        let IncomingStream { chunk, headers, short_since, .. } = stream;
        while let Some(body) = next_body(chunk, to.most) {
            let (told, payload): (ShortHeader, &[u8]) = match headers {
                Some(headers) => {
                    permit_short(to.route, open)?;
                    headers.read(body).map_err(malformed)?
                }
                None => {
                    // The envelope is opened in place.
                    envelope.clear();
                    envelope.extend_from_slice(body);
                    let opened = open.open(envelope, to.route, now).map_err(refused)?;
                    let Some(opened) = opened else {
                        self.lost("no_link", to.header, ENDED, now);
                        chunk.advance(LENGTH + body.len());
                        continue;
                    };
                    writer_of(to.route.kind, to.header.of, false, &opened.header)
                        .map_err(malformed)?;
                    if opened.header.compressed {
                        let sent = Bytes::copy_from_slice(opened.sent());
                        chunk.advance(LENGTH + body.len());
                        return Ok(Some(StreamStep::Unpack(opened.header, sent)));
                    }
                    (told(&opened.header), opened.sent())
                }
            };
            let (length, bytes) = (LENGTH + body.len(), payload.len());
            let flow = (to.header.route, to.header.of);
            let before = to.stand_in.dropped(told.sequence);
            if before == EarlierFate::Dropped {
                self.receipts.dropped_again(flow, told.sequence, now);
                chunk.advance(length);
                continue;
            }
            let is_new = to.stand_in.last_sequence() < Some(told.sequence);
            if is_new && before == EarlierFate::Unknown {
                let meta = self.meta(told, now);
                match self.write(&to.stand_in, to.header, meta, payload, short_since, now) {
                    Some(true) => {}
                    Some(false) => {
                        self.receipts.dropped(flow, told.sequence, now);
                        chunk.advance(length);
                        continue;
                    }
                    None => {
                        let payload = Bytes::copy_from_slice(payload);
                        chunk.advance(length);
                        let (writer, number) = (to.header.of, meta.sequence);
                        let message = OpenedMessage { writer, number, meta, payload };
                        return Ok(Some(StreamStep::Ring(message)));
                    }
                }
            }
            came.newest = came.newest.max(Some(told.sequence));
            came.samples += 1;
            came.bytes += bytes;
            chunk.advance(length);
        }
        Ok(None)
    }
}

/// Returns the body at the front of a chunk, if it is complete and short.
fn next_body(chunk: &Bytes, most: u64) -> Option<&[u8]> {
    let (length, rest) = chunk.split_first_chunk::<LENGTH>()?;
    let length = u32::from_be_bytes(*length) as usize;
    if length > LONG_MESSAGE_BYTES || length as u64 > most { None } else { rest.get(..length) }
}
