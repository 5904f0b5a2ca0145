//! Seals and opens the body of a data message: the inner header and the payload, in `messages10` within an
//! AXQKD001 envelope (`docs/formats.md`, sections 3 and 7).

use std::{borrow::Cow, sync::Arc, time::Instant};

use axon_envelope::{Delivery, Kind, OpenError, Route, TAG_LEN, inner};
use axon_shm::ids::Gid;

use axon_transport::internal::session::unix_nanos;

use super::{
    frames::Frames,
    keyring::{Keyring, PeerKeys},
    queue::Sample,
};
use crate::keys::NoKey;

/// Largest inner header and envelope around a payload.
pub(crate) const MAX_OVERHEAD: usize = axon_envelope::MAX_HEADER_LEN + inner::LEN + TAG_LEN;
const LENGTH: usize = 4;

/// How one link protects its messages.
#[derive(Clone)]
pub(crate) enum Protection {
    /// By QUIC alone: `classic`, and `qkd` with `session`.
    Link,
    /// Each message in an envelope of its own.
    Envelope {
        /// The daemon's keys.
        keyring: Arc<Keyring>,
        /// Those of this peer.
        keys: Arc<PeerKeys>,
        /// The connection's number, to which the keys are bound.
        connection: u64,
    },
}

/// What an opened message says.
pub(crate) struct Opened<'a> {
    /// Publisher, sequence number, timestamp.
    pub(crate) header: inner::Header,
    /// The payload as it came.
    sent: &'a [u8],
}

impl<'a> Opened<'a> {
    /// The payload, decompressed where it was compressed, to at most `most` bytes.
    ///
    /// # Errors
    /// [`RefusedMessage::Malformed`].
    pub(crate) fn payload(&self, most: u64) -> Result<Cow<'a, [u8]>, RefusedMessage> {
        if !self.header.compressed {
            return Ok(self.sent.into());
        }
        let length = u64::from(self.header.uncompressed_len);
        if length > most {
            let text = format!("{length} bytes when decompressed, at most {most} allowed");
            return Err(RefusedMessage::Malformed(text));
        }
        let payload = zstd::bulk::decompress(self.sent, length as usize)
            .ok()
            .filter(|p| p.len() as u64 == length)
            .ok_or_else(|| RefusedMessage::Malformed("not one zstd frame as declared".into()))?;
        Ok(payload.into())
    }
}

/// Why a message is refused.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub(crate) enum RefusedMessage {
    /// The envelope; the cause is for the local log alone.
    #[error("{text}")]
    Envelope {
        /// Cause for log and status.
        text: String,
    },
    /// The inner header or the compression.
    #[error("{0}")]
    Malformed(String),
}

impl RefusedMessage {
    /// An envelope that was refused.
    pub(crate) fn of_envelope(error: &OpenError) -> Self {
        Self::Envelope { text: cause(error) }
    }
}

fn header(sample: &Sample) -> inner::Header {
    let age = sample.age().as_millis();
    let request_id = sample.client.map_or_else(inner::RequestId::default, |client| {
        inner::RequestId { client: client.0, sequence: number(sample.info.sequence) }
    });
    inner::Header {
        gid: sample.info.publisher.0,
        sequence: sample.info.sequence,
        source_timestamp: unix_nanos(sample.info.source_timestamp),
        request_id,
        compressed: false,
        age_ms: u32::try_from(age).unwrap_or(u32::MAX),
        // Bounded by AXON_MAX_MESSAGE_MB, which is far below 4 GiB.
        uncompressed_len: u32::try_from(sample.payload.len()).unwrap_or(u32::MAX),
    }
}

/// The number of a call as its request id has it.
fn number(sequence: u64) -> i64 {
    // From 1 on, and one at a time.
    i64::try_from(sequence).unwrap_or(i64::MAX)
}

impl Protection {
    /// Adds `length || body` of `sample` to `frames`.
    ///
    /// # Errors
    /// [`NoKey`] in `messages10` when no READY key is left for this kind of delivery: then nothing was
    /// added.
    pub(crate) fn write(
        &self,
        sample: &Sample,
        route: Route,
        delivery: Delivery,
        frames: &mut Frames,
    ) -> Result<(), NoKey> {
        let header = header(sample).encode();
        let plain = header.len() + sample.payload.len();
        match self {
            Self::Link => {
                frames.copy(&(plain as u32).to_be_bytes());
                frames.copy(&header);
                frames.share(&sample.payload);
                Ok(())
            }
            Self::Envelope { keyring, keys, connection } => {
                keys.with_sender(keyring, |now, sender| {
                    // A successor holds the keys by now: what it binds them to is not this connection.
                    if sender.attached() != Some(*connection) {
                        return Err(NoKey::Detached);
                    }
                    let most = LENGTH + sender.overhead() + plain;
                    let slot = sender.slot(now, delivery)?;
                    let parts: [&[u8]; 2] = [&header, &sample.payload];
                    frames.fill(most, |frame| {
                        let sealed = slot.seal_into(route, &parts, &mut frame[LENGTH..]);
                        // There is room for the longest header, and the payload is bounded.
                        let length = sealed.map_err(|_| NoKey::None)?;
                        frame[..LENGTH].copy_from_slice(&(length as u32).to_be_bytes());
                        Ok(LENGTH + length)
                    })
                })
            }
        }
    }

    /// So many more messages wait to be sealed: what the key supply plans by.
    pub(crate) fn demand(&self, messages: u32) {
        if let Self::Envelope { keyring, keys, .. } = self {
            keys.with_sender(keyring, |now, sender| sender.demand(now, messages));
        }
    }

    /// Opens `body` in place. `None`: the connection is over on this side and its keys are gone, which it
    /// had before anything was sealed with them.
    ///
    /// # Errors
    /// [`RefusedMessage`]; nothing of the payload is handed on before its tag was verified.
    pub(crate) fn open<'a>(
        &self,
        body: &'a mut [u8],
        route: Route,
    ) -> Result<Option<Opened<'a>>, RefusedMessage> {
        let plain: &[u8] = match self {
            Self::Link => body,
            Self::Envelope { keyring, keys, connection } => {
                let opened = keys.with_receiver(keyring, |now, receiver| {
                    let Some(opener) = receiver.opener(*connection) else { return Ok(None) };
                    let start = body.as_ptr().addr();
                    match opener.open_in_place(now, route, body) {
                        Ok(plain) => {
                            let at = plain.as_ptr().addr() - start;
                            Ok(Some(at..at + plain.len()))
                        }
                        Err(error) => Err(RefusedMessage::of_envelope(&error)),
                    }
                })?;
                let Some(range) = opened else { return Ok(None) };
                &body[range]
            }
        };
        let (header, payload) =
            inner::Header::decode(plain).map_err(|e| RefusedMessage::Malformed(e.to_string()))?;
        Ok(Some(Opened { header, sent: payload }))
    }
}

/// For the local log: never told to the peer.
fn cause(error: &OpenError) -> String {
    match error.cause() {
        Some(cause) => format!("envelope refused: {cause}"),
        None => format!("envelope refused: {error}"),
    }
}

/// A sample as it was taken from a relay.
pub(crate) fn sample(info: axon_transport::MessageInfo, payload: Vec<u8>) -> Sample {
    Sample { info, client: None, payload: payload.into(), since: Instant::now() }
}

/// Who wrote a message that came in the stream of `of`: the publisher that the stream is of, the
/// client whose requests are in it, or a server that answers the client whose responses are in it.
///
/// # Errors
/// The inner header says that it belongs elsewhere.
pub(crate) fn writer(kind: Kind, of: Gid, header: &inner::Header) -> Result<Gid, &'static str> {
    let writer = Gid(header.gid);
    let call = inner::RequestId { client: of.0, sequence: number(header.sequence) };
    let fits = match kind {
        Kind::Topic => writer == of && header.request_id == inner::RequestId::default(),
        Kind::Request => writer == of && header.request_id == call,
        Kind::Response => header.request_id == call,
    };
    if fits { Ok(writer) } else { Err("a message names another publisher or call than its stream") }
}

#[cfg(test)]
mod tests {
    use super::*;
    use axon_transport::MessageInfo;

    #[test]
    fn what_belongs_to_another_stream_or_call_is_refused() {
        let (client, server) = (Gid([1; 16]), Gid([2; 16]));
        let info = |publisher| MessageInfo::of(publisher, 7);
        let topic = header(&sample(info(client), Vec::new()));
        let call = |of| header(&Sample { client: Some(client), ..sample(info(of), Vec::new()) });
        let (request, response) = (call(client), call(server));
        assert_eq!(writer(Kind::Topic, client, &topic), Ok(client));
        assert_eq!(writer(Kind::Request, client, &request), Ok(client));
        assert_eq!(writer(Kind::Response, client, &response), Ok(server));
        assert!(writer(Kind::Topic, server, &topic).is_err());
        assert!(writer(Kind::Topic, client, &request).is_err());
        assert!(writer(Kind::Request, client, &response).is_err());
        assert!(writer(Kind::Request, client, &topic).is_err());
        assert!(writer(Kind::Response, server, &response).is_err());
        let sequence = 8;
        let other = inner::Header { sequence, ..response };
        assert!(writer(Kind::Response, client, &other).is_err());
    }
}
