//! The form of a message in a data stream: its length, then the message, which in `messages10` is sealed as an AXQKD001
//! envelope.

use std::time::Duration;

use axon_envelope::{Delivery, Kind, OpenError, Route, Slot, TAG_LEN, inner};
use axon_shm::ids::Gid;
use bytes::Bytes;

use super::{
    frames::Frames,
    short_header::{ShortHeader, ShortHeaders},
};
use crate::{
    engine::rings::RingSample,
    keys::{KeyReceiver, KeySender, NoKey},
};
use axon_transport::internal::session::unix_nanos;

/// Largest inner header and envelope around a payload.
pub(crate) const MAX_OVERHEAD: usize = axon_envelope::MAX_HEADER_LEN + inner::LEN + TAG_LEN;

/// Bytes of the length before each message.
const LENGTH: usize = 4;

/// Protects the messages that leave over one connection.
pub(crate) enum Seal<'a> {
    /// TLS alone protects them.
    Link,
    /// Each message is sealed under a KME key.
    Envelope {
        /// The keys towards the peer.
        sender: &'a mut KeySender,
        /// The connection.
        connection: u64,
    },
}

impl Seal<'_> {
    /// Announces that the sender will need keys for this many more messages.
    pub(crate) fn demand(&mut self, messages: u32, now: Duration) {
        if let Self::Envelope { sender, .. } = self {
            sender.demand(now, messages);
        }
    }

    /// Returns whether this host's KME gives no keys for the peer, and none is left.
    pub(crate) fn lacks_keys_of_kme(&self) -> bool {
        matches!(self, Self::Envelope { sender, .. } if sender.lacks_keys_of_kme())
    }

    /// Returns the short headers for a new stream, if its messages have short headers: an envelope contains the inner
    /// header.
    pub(crate) fn short_headers(&self) -> Option<ShortHeaders> {
        matches!(self, Self::Link).then(ShortHeaders::default)
    }

    /// Adds a message to `frames`, behind its inner header or, with `short`, behind a short one. A short header cannot
    /// mark compression, so a compressed sample is not sent over a stream with short headers.
    ///
    /// # Errors
    /// There is no key for the message. Nothing is added then.
    pub(crate) fn write(
        &mut self,
        sample: &RingSample,
        route: Route,
        delivery: Delivery,
        short: Option<&mut ShortHeaders>,
        frames: &mut Frames,
        now: Duration,
    ) -> Result<(), NoKey> {
        match (self, short) {
            (Self::Link, Some(short)) => {
                debug_assert!(
                    !sample.is_compressed(),
                    "a short header says nothing of compression"
                );
                let header = short.write(ShortHeader {
                    sequence: sample.info.sequence,
                    source_timestamp: unix_nanos(sample.info.source_timestamp),
                    age_ms: age(sample, now),
                });
                plain(header.as_slice(), &sample.payload, frames);
                Ok(())
            }
            (Self::Link, None) => {
                plain(&header(sample, now).encode(), &sample.payload, frames);
                Ok(())
            }
            (Self::Envelope { sender, connection }, _) => {
                if sender.attached() != Some(*connection) {
                    return Err(NoKey::Detached);
                }
                envelope(sender.slot(now, delivery)?, sample, route, frames, now)
            }
        }
    }

    /// Adds the copy of a message that leaves over `connection`, which stands by.
    ///
    /// # Errors
    /// There is no key for the copy. Nothing is added then.
    pub(crate) fn write_copy(
        &mut self,
        sample: &RingSample,
        route: Route,
        connection: u64,
        frames: &mut Frames,
        now: Duration,
    ) -> Result<(), NoKey> {
        match self {
            Self::Link => {
                plain(&header(sample, now).encode(), &sample.payload, frames);
                Ok(())
            }
            Self::Envelope { sender, .. } => {
                sender.demand_copies(now, 1);
                envelope(sender.copy_slot(now, connection)?, sample, route, frames, now)
            }
        }
    }
}

/// Adds a message in its envelope.
///
/// # Errors
/// The key cannot seal it. Nothing is added then.
fn envelope(
    slot: Slot<'_>,
    sample: &RingSample,
    route: Route,
    frames: &mut Frames,
    now: Duration,
) -> Result<(), NoKey> {
    let header = header(sample, now).encode();
    let length = slot.overhead() + header.len() + sample.payload.len();
    frames.append(LENGTH + length, |frame| {
        frame.extend_from_slice(&(length as u32).to_be_bytes());
        // The message is sealed in the buffer from which it is sent.
        let at = frame.len();
        frame.resize(at + slot.header_len(), 0);
        frame.extend_from_slice(&header);
        frame.extend_from_slice(&sample.payload);
        frame.resize(at + length, 0);
        slot.seal_in_place(route, &mut frame[at..]).map_err(|_| NoKey::None)
    })
}

/// Adds a message that has no envelope.
fn plain(header: &[u8], payload: &Bytes, frames: &mut Frames) {
    let length = header.len() + payload.len();
    frames.copy(&(length as u32).to_be_bytes());
    frames.copy(header);
    frames.share(payload);
}

/// Returns a sample's age in milliseconds.
fn age(sample: &RingSample, now: Duration) -> u32 {
    u32::try_from(sample.age(now).as_millis()).unwrap_or(u32::MAX)
}

/// Returns the header of a message.
fn header(sample: &RingSample, now: Duration) -> inner::Header {
    inner::Header {
        gid: sample.info.publisher.0,
        sequence: sample.info.sequence,
        source_timestamp: unix_nanos(sample.info.source_timestamp),
        request_id: sample.call.unwrap_or_default(),
        compressed: sample.is_compressed(),
        age_ms: age(sample, now),
        uncompressed_len: u32::try_from(sample.length()).unwrap_or(u32::MAX),
    }
}

/// Returns the id of a client's call. ROS 2 has signed numbers.
pub(crate) fn call(client: Gid, sequence: u64) -> inner::RequestId {
    inner::RequestId { client: client.0, sequence: i64::try_from(sequence).unwrap_or(i64::MAX) }
}

/// Opens the messages that arrive over one connection.
pub(crate) enum Open<'a> {
    /// TLS alone protects them.
    Link,
    /// Each message is an envelope.
    Envelope {
        /// The keys of the peer.
        receiver: &'a mut KeyReceiver,
        /// The connection.
        connection: u64,
    },
}

/// A message that was opened.
pub(crate) struct OpenedSample<'a> {
    /// The header of the message.
    pub(crate) header: inner::Header,
    sent: &'a [u8],
}

impl<'a> OpenedSample<'a> {
    /// Parses a message without an envelope.
    ///
    /// # Errors
    /// The peer broke the format.
    pub(crate) fn plain(body: &'a [u8]) -> Result<Self, RefusedMessage> {
        let (header, sent) =
            inner::Header::decode(body).map_err(|e| RefusedMessage::Malformed(e.to_string()))?;
        Ok(Self { header, sent })
    }

    /// Returns the payload as it was sent: compressed, if the header says so.
    pub(crate) fn sent(&self) -> &'a [u8] {
        self.sent
    }
}

/// Returns the length of the payload after decompression, at most `most`.
///
/// # Errors
/// It would be longer.
pub(crate) fn unpacked_length(header: &inner::Header, most: u64) -> Result<usize, RefusedMessage> {
    let length = u64::from(header.uncompressed_len);
    if length > most {
        let text = format!("{length} bytes when decompressed, at most {most} allowed");
        return Err(RefusedMessage::Malformed(text));
    }
    Ok(length as usize)
}

/// Decompresses a payload to this length.
///
/// # Errors
/// The peer broke the format.
pub(crate) fn unpack(sent: &[u8], length: usize) -> Result<Vec<u8>, RefusedMessage> {
    zstd::bulk::decompress(sent, length)
        .ok()
        .filter(|payload| payload.len() == length)
        .ok_or_else(|| RefusedMessage::Malformed("not one zstd frame as declared".into()))
}

impl Open<'_> {
    /// Opens a message in place. `None`: the connection has no keys any more.
    ///
    /// # Errors
    /// The peer broke the format, or the envelope is refused.
    pub(crate) fn open<'a>(
        &mut self,
        body: &'a mut [u8],
        route: Route,
        now: Duration,
    ) -> Result<Option<OpenedSample<'a>>, RefusedMessage> {
        let Self::Envelope { receiver, connection } = self else {
            return OpenedSample::plain(body).map(Some);
        };
        let Some(opener) = receiver.opener(*connection) else { return Ok(None) };
        match opener.open_in_place(now, route, body) {
            Ok(plain) => OpenedSample::plain(plain).map(Some),
            Err(error) => Err(RefusedMessage::of_envelope(&error)),
        }
    }
}

/// Returns the writer of a message on the stream of publisher, or client, `of`. The header of a response contains the
/// number of the call twice. If the response is `numbered`, the header contains its own number in the flow and the
/// number of the call.
///
/// # Errors
/// The message names another writer or call than its stream.
pub(crate) fn writer_of(
    kind: Kind,
    of: Gid,
    numbered: bool,
    header: &inner::Header,
) -> Result<Gid, &'static str> {
    let writer = Gid(header.gid);
    let call = call(of, header.sequence);
    let fits = match kind {
        Kind::Topic => writer == of && header.request_id == inner::RequestId::default(),
        Kind::Request => writer == of && header.request_id == call,
        Kind::Response if numbered => {
            header.request_id.client == of.0 && header.request_id.sequence > 0
        }
        Kind::Response => header.request_id == call,
    };
    if fits { Ok(writer) } else { Err("a message names another publisher or call than its stream") }
}

/// The reason why a message is refused.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub(crate) enum RefusedMessage {
    /// The envelope; the cause is for the local log alone.
    #[error("{text}")]
    Envelope {
        /// Cause for log and status.
        text: String,
    },
    /// The inner header or the compression is malformed.
    #[error("{0}")]
    Malformed(String),
}

impl RefusedMessage {
    /// Makes the refusal of an envelope.
    pub(crate) fn of_envelope(error: &OpenError) -> Self {
        Self::Envelope { text: cause(error) }
    }
}

/// Returns the cause for the local log, which a peer never gets.
fn cause(error: &OpenError) -> String {
    match error.cause() {
        Some(cause) => format!("envelope refused: {cause}"),
        None => format!("envelope refused: {error}"),
    }
}
