//! Samples from a peer: data streams in, stand-ins out (`docs/formats.md`, section 7).

use std::{
    fmt::Display,
    sync::Arc,
    time::{Duration, Instant},
};

use axon_envelope::{Kind, Route};
use axon_shm::{Meta, PublishError, ids::Gid, internal::monotonic};
use axon_transport::internal::{log_limit::LogLimit, session::Written};
use quinn::{Connection, RecvStream, VarInt};
use tokio::sync::{mpsc, watch};

use super::{
    counters::Counting,
    establish::close,
    intake::Intake,
    pieces::Pieces,
    protection::{MAX_OVERHEAD, Protection, RefusedMessage, writer},
    receipts::Receipts,
    ring_wakeups::RingWakeups,
    routes_in::RoutesIn,
    stand_in::StandIn,
};
use crate::link::CloseCode;

const STREAM_HEADER: usize = 24;
/// A message that is longer once it is decompressed holds up no other task while that is done.
const LONG: usize = 64 << 10;
const RELIABLE: u8 = 1;
const BEST_EFFORT: u8 = 2;
/// A stream for a route that is gone is stopped with this.
const NO_ROUTE: VarInt = VarInt::from_u32(CloseCode::OutOfOrder as u32);

/// Everything a data stream of one connection needs.
#[derive(Clone)]
pub(super) struct Inbound {
    /// The connection.
    pub(super) connection: Connection,
    /// Its routes.
    pub(super) routes: Arc<RoutesIn>,
    /// How its messages are protected.
    pub(super) protection: Protection,
    /// What arrives.
    pub(super) counters: Counting,
    /// Wakes a publish that waits for room.
    pub(super) ring_wakeups: RingWakeups,
    /// Largest payload accepted.
    pub(super) max_message: u64,
    /// Held by each stream that is read; its other end goes when what is left of them is not wanted.
    pub(super) wanted: watch::Receiver<()>,
    /// Memory for what comes.
    pub(super) intake: Arc<Intake>,
    /// What the peer is told of it.
    pub(super) receipts: Arc<Receipts>,
    /// Samples that could not be published here, for the log.
    pub(super) losses: Arc<LogLimit>,
    /// What was refused, for the log and status.
    pub(super) refused: mpsc::Sender<(CloseCode, String)>,
}

/// Why a stream ends.
enum End {
    /// It was read to its end, or the connection is gone.
    Finished,
    /// The peer broke the protocol: the connection is closed.
    Violation(CloseCode, String),
}

impl Inbound {
    /// Accepts data streams until the connection ends.
    pub(super) async fn run(self) {
        while let Ok(stream) = self.connection.accept_uni().await {
            let inbound = self.clone();
            tokio::spawn(async move {
                if let End::Violation(code, reason) = inbound.stream(stream).await {
                    // The peer learns that an envelope was refused, never why.
                    let told = match code {
                        CloseCode::Envelope => "an envelope was refused",
                        _ => &reason,
                    };
                    close(&inbound.connection, code, told);
                    let _ = inbound.refused.try_send((code, reason));
                }
            });
        }
    }

    async fn stream(&self, stream: RecvStream) -> End {
        let mut stream = Pieces::new(stream);
        let mut header = [0; STREAM_HEADER];
        if !stream.exact(&mut header).await {
            return End::Finished;
        }
        let (kind, number, gid) = match parse_header(&header) {
            Ok(parsed) => parsed,
            Err(reason) => return End::Violation(CloseCode::Malformed, reason.into()),
        };
        let Some((route, feeding)) = self.routes.stream(number, gid).await else {
            // Unsubscribed, or the publisher is gone from the graph: its samples may still be
            // under way.
            self.counters.lost(&self.topic(number), "no_route", 1);
            stream.stop(NO_ROUTE);
            return End::Finished;
        };
        let _feeding = feeding.lock().await;
        stream.take_many();
        let from = From { number, route, gid, reliable: kind == RELIABLE };
        let mut body = Vec::new();
        loop {
            match self.message(&mut stream, &mut body, from).await {
                Ok(true) if kind == RELIABLE => {}
                Ok(_) => return End::Finished,
                Err((code, reason)) => return End::Violation(code, reason),
            }
        }
    }

    /// Reads and publishes one message; false when the stream ended before it.
    async fn message(
        &self,
        stream: &mut Pieces,
        body: &mut Vec<u8>,
        from: From,
    ) -> Result<bool, (CloseCode, String)> {
        let mut prefix = [0; 4];
        if !stream.exact(&mut prefix).await {
            return Ok(false);
        }
        let length = u64::from(u32::from_be_bytes(prefix));
        let limit = self.max_message + MAX_OVERHEAD as u64;
        if length > limit {
            let text = format!("a message of {length} bytes, at most {limit} are allowed");
            return Err((CloseCode::TooLarge, text));
        }
        let mut room = self.intake.room(length as usize).await;
        // There is room for as much as the length claims, of which what really arrives is used.
        body.clear();
        body.reserve_exact(length as usize);
        let mut left = length as usize;
        while left > 0 {
            let Some(piece) = stream.next(left).await else { return Ok(false) };
            body.extend_from_slice(&piece);
            left -= piece.len();
        }
        let refused = |e: RefusedMessage| {
            let code = match e {
                RefusedMessage::Envelope { .. } => CloseCode::Envelope,
                RefusedMessage::Malformed(_) => CloseCode::Malformed,
            };
            (code, e.to_string())
        };
        let Some(opened) = self.protection.open(body, from.route).map_err(refused)? else {
            // Nothing is wrong with it. The rest is read to be counted.
            let why = "the link ended before they were read";
            self.lost("no_link", from.number, from.gid, &why);
            return Ok(true);
        };
        let gid = writer(from.route.kind, from.gid, &opened.header)
            .map_err(|text| (CloseCode::Malformed, text.to_owned()))?;
        if opened.header.compressed {
            self.intake.expand(&mut room).await;
        }
        // `expand` lets one at a time through: no peer has several threads work for it.
        let long =
            if opened.header.compressed { opened.header.uncompressed_len as usize } else { 0 };
        let payload = aside(long, || opened.payload(self.max_message)).map_err(refused)?;
        let meta = Meta {
            sequence: opened.header.sequence,
            source_timestamp: opened.header.source_timestamp,
            published: published(opened.header.age_ms),
        };
        match self.routes.writer(from.number, gid).await {
            Some(stand_in) => {
                let came = Came { meta, payload: &payload, long };
                self.take_in(&stand_in, from, came).await;
            }
            None => self.counters.lost(&self.topic(from.number), "no_route", 1),
        }
        drop(payload);
        Intake::shrink(body);
        Ok(true)
    }

    /// Writes into the stand-in's ring, and has the peer told if it awaits that. What came over an
    /// earlier link and was sent again is there already.
    async fn take_in(&self, stand_in: &StandIn, from: From, came: Came<'_>) {
        let From { number, gid, reliable, route } = from;
        let Came { meta, payload, .. } = came;
        let told = reliable && route.kind == Kind::Topic;
        if told && stand_in.last_sequence() >= Some(meta.sequence) {
            return self.receipts.came(number, gid, meta.sequence, payload.len());
        }
        let there = self.publish(stand_in, from, came).await;
        match told {
            true if there => self.receipts.came(number, gid, meta.sequence, payload.len()),
            true => self.receipts.dropped(number, gid, meta.sequence),
            false => {}
        }
    }

    /// Writes into the stand-in's ring; waits for a reader that keeps all, which in turn holds the peer's
    /// stream back: as long as the link stands, and beyond that for what had come when a successor took
    /// over. Whether it is there.
    async fn publish(&self, stand_in: &StandIn, from: From, came: Came<'_>) -> bool {
        let Came { meta, payload, long } = came;
        let mut waiting = None;
        loop {
            match aside(long, || stand_in.try_write(&from.gid, meta, payload)) {
                Ok(Written::Yes) => {
                    self.counters.arrived(payload.len());
                    return true;
                }
                Ok(Written::Nobody) => {
                    self.counters.lost(&self.topic(from.number), "no_client", 1);
                    return false;
                }
                Err(PublishError::Blocked { .. }) if self.wanted.has_changed().is_ok() => {
                    // Tried once more with the first wake-up: there may have been room since.
                    let (wakeups, _) = waiting.get_or_insert_with(|| {
                        (self.ring_wakeups.subscribe(), self.ring_wakeups.wait_for_room())
                    });
                    // The timeout only covers a link that ends meanwhile.
                    let _ =
                        tokio::time::timeout(Duration::from_millis(100), wakeups.changed()).await;
                }
                Err(error) => {
                    self.lost("ring", from.number, stand_in.gid(), &error);
                    return false;
                }
            }
        }
    }

    /// The name of a route's topic.
    fn topic(&self, number: u32) -> Arc<str> {
        self.routes.topic(number).unwrap_or_else(|| "(a route that ended)".into())
    }

    /// A sample of this route came here and is lost.
    fn lost(&self, cause: &'static str, number: u32, gid: Gid, error: &dyn Display) {
        let topic = self.topic(number);
        self.counters.lost(&topic, cause, 1);
        if let Some(samples) = self.losses.count(Instant::now()) {
            tracing::warn!(%topic, %gid, %error, samples, "samples from a peer are lost");
        }
    }
}

/// When a sample of this age was published, on this host's monotonic clock.
fn published(age_ms: u32) -> u64 {
    // 0 would be now.
    monotonic().saturating_sub(u64::from(age_ms) * 1_000_000).max(1)
}

/// Does `work` on so many bytes; if they are many, while another thread has this one's other tasks.
fn aside<T>(bytes: usize, work: impl FnOnce() -> T) -> T {
    if bytes > LONG { tokio::task::block_in_place(work) } else { work() }
}

/// A message that came.
#[derive(Clone, Copy)]
struct Came<'a> {
    meta: Meta,
    payload: &'a [u8],
    /// Bytes of it that a peer made of few.
    long: usize,
}

/// Where a stream says that it comes from.
#[derive(Clone, Copy)]
struct From {
    number: u32,
    route: Route,
    /// A publisher; of a service the client.
    gid: Gid,
    reliable: bool,
}

fn parse_header(header: &[u8; STREAM_HEADER]) -> Result<(u8, u32, Gid), &'static str> {
    let kind = header[0];
    if !matches!(kind, RELIABLE | BEST_EFFORT) {
        return Err("a data stream of unknown kind");
    }
    if header[1..4] != [0; 3] {
        return Err("a data stream with unknown flags");
    }
    let mut route = [0; 4];
    route.copy_from_slice(&header[4..8]);
    let mut gid = [0; 16];
    gid.copy_from_slice(&header[8..]);
    Ok((kind, u32::from_be_bytes(route), Gid(gid)))
}

/// The header of a data stream.
pub(crate) fn stream_header(reliable: bool, route: u32, gid: Gid) -> [u8; STREAM_HEADER] {
    let mut header = [0; STREAM_HEADER];
    header[0] = if reliable { RELIABLE } else { BEST_EFFORT };
    header[4..8].copy_from_slice(&route.to_be_bytes());
    header[8..].copy_from_slice(&gid.0);
    header
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn decompression_of_a_long_message_leaves_the_worker_to_other_tasks() {
        let mut builder = tokio::runtime::Builder::new_multi_thread();
        let runtime = builder.worker_threads(1).enable_all().build().unwrap();
        let (say, hear) = std::sync::mpsc::channel();
        let long = runtime.spawn(async move {
            let other = tokio::spawn(async move { say.send(()).unwrap() });
            // It ends once another task of the only worker ran.
            let heard = aside(LONG + 1, || hear.recv_timeout(Duration::from_secs(60)));
            other.await.unwrap();
            heard
        });
        assert_eq!(runtime.block_on(long).unwrap(), Ok(()));
    }

    #[test]
    fn a_stream_header_comes_back_and_anything_else_is_refused() {
        let gid = Gid([7; 16]);
        assert_eq!(parse_header(&stream_header(true, 9, gid)), Ok((RELIABLE, 9, gid)));
        assert_eq!(parse_header(&stream_header(false, 9, gid)), Ok((BEST_EFFORT, 9, gid)));
        let mut unknown = stream_header(true, 9, gid);
        unknown[0] = 3;
        assert!(parse_header(&unknown).is_err());
        let mut flags = stream_header(true, 9, gid);
        flags[3] = 1;
        assert!(parse_header(&flags).is_err());
    }
}
