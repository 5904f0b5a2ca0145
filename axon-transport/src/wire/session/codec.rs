//! Encodes messages as the bytes of a packet, and decodes them.

use minicbor::{Decode, Encode};

use super::{MAX_PACKET, SessionMessage};

/// The reason why bytes are not a message, or why a message cannot be encoded.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CodecError {
    /// The packet is empty.
    #[error("an empty packet")]
    Empty,
    /// The packet is larger than permitted.
    #[error("a message of {0} bytes; a packet holds {MAX_PACKET}")]
    TooLarge(usize),
    /// The map is not the one that the type requires.
    #[error("message type {kind}: {source}")]
    Malformed {
        /// The message's type byte.
        kind: u8,
        /// The error of the decoder.
        source: minicbor::decode::Error,
    },
    /// There are bytes after the map.
    #[error("message type {0}: bytes after the map")]
    Trailing(u8),
}

/// The map of a message without content.
#[derive(Clone, Copy, Debug, Encode, Decode)]
#[cbor(map)]
struct Empty {}

impl SessionMessage {
    /// Encodes the message as a packet.
    ///
    /// # Errors
    /// [`CodecError::TooLarge`] if the message does not fit in one packet.
    pub fn encode(&self) -> Result<Vec<u8>, CodecError> {
        let (kind, body) = match self {
            Self::Hello(m) => (1, minicbor::to_vec(m)),
            Self::Welcome(m) => (2, minicbor::to_vec(m)),
            Self::Refused(m) => (3, minicbor::to_vec(m)),
            Self::Endpoint(m) => (4, minicbor::to_vec(m)),
            Self::EndpointGone(m) => (5, minicbor::to_vec(m)),
            Self::Graph(m) => (6, minicbor::to_vec(m)),
            Self::Match(m) => (7, minicbor::to_vec(m)),
            Self::Attach(m) => (8, minicbor::to_vec(m)),
            Self::Grant(m) => (9, minicbor::to_vec(m)),
            Self::Detach(m) => (10, minicbor::to_vec(m)),
            Self::Unmatch(m) => (11, minicbor::to_vec(m)),
            Self::StatusRequest => (12, minicbor::to_vec(Empty {})),
            Self::Status(m) => (13, minicbor::to_vec(m)),
            Self::Resync => (14, minicbor::to_vec(Empty {})),
            Self::Segment(m) => (15, minicbor::to_vec(m)),
            Self::SegmentGone(m) => (16, minicbor::to_vec(m)),
            Self::Need(m) => (17, minicbor::to_vec(m)),
            Self::Leaving(m) => (18, minicbor::to_vec(m)),
            Self::GivenUp(m) => (19, minicbor::to_vec(m)),
            Self::Fence(m) => (20, minicbor::to_vec(m)),
            Self::Unmet(m) => (21, minicbor::to_vec(m)),
            Self::Matched(m) => (24, minicbor::to_vec(m)),
            Self::SampleFragment(m) => (25, minicbor::to_vec(m)),
            Self::Credit(m) => (26, minicbor::to_vec(m)),
            Self::Asserted(m) => (27, minicbor::to_vec(m)),
            Self::Reload => (28, minicbor::to_vec(Empty {})),
            Self::AccessCheck(m) => (29, minicbor::to_vec(m)),
            Self::Unknown(kind) => (*kind, minicbor::to_vec(Empty {})),
        };
        // Encoding into a `Vec` cannot fail.
        let body = body.unwrap_or_default();
        if body.len() + 1 > MAX_PACKET {
            return Err(CodecError::TooLarge(body.len() + 1));
        }
        let mut packet = Vec::with_capacity(body.len() + 1);
        packet.push(kind);
        packet.extend_from_slice(&body);
        Ok(packet)
    }

    /// Returns whether a packet is part of a status.
    pub(crate) fn is_status(packet: &[u8]) -> bool {
        packet.first() == Some(&13)
    }

    /// Decodes a packet.
    ///
    /// # Errors
    /// The packet is empty, too large, or not the map that its type requires.
    pub fn decode(packet: &[u8]) -> Result<Self, CodecError> {
        if packet.len() > MAX_PACKET {
            return Err(CodecError::TooLarge(packet.len()));
        }
        let (&kind, body) = packet.split_first().ok_or(CodecError::Empty)?;
        Ok(match kind {
            1 => Self::Hello(map(kind, body)?),
            2 => Self::Welcome(map(kind, body)?),
            3 => Self::Refused(map(kind, body)?),
            4 => Self::Endpoint(map(kind, body)?),
            5 => Self::EndpointGone(map(kind, body)?),
            6 => Self::Graph(map(kind, body)?),
            7 => Self::Match(map(kind, body)?),
            8 => Self::Attach(map(kind, body)?),
            9 => Self::Grant(map(kind, body)?),
            10 => Self::Detach(map(kind, body)?),
            11 => Self::Unmatch(map(kind, body)?),
            12 => map::<Empty>(kind, body).map(|_| Self::StatusRequest)?,
            13 => Self::Status(map(kind, body)?),
            14 => map::<Empty>(kind, body).map(|_| Self::Resync)?,
            15 => Self::Segment(map(kind, body)?),
            16 => Self::SegmentGone(map(kind, body)?),
            17 => Self::Need(map(kind, body)?),
            18 => Self::Leaving(map(kind, body)?),
            19 => Self::GivenUp(map(kind, body)?),
            20 => Self::Fence(map(kind, body)?),
            21 => Self::Unmet(map(kind, body)?),
            24 => Self::Matched(map(kind, body)?),
            25 => Self::SampleFragment(map(kind, body)?),
            26 => Self::Credit(map(kind, body)?),
            27 => Self::Asserted(map(kind, body)?),
            28 => map::<Empty>(kind, body).map(|_| Self::Reload)?,
            29 => Self::AccessCheck(map(kind, body)?),
            _ => Self::Unknown(kind),
        })
    }
}

fn map<'b, T: Decode<'b, ()>>(kind: u8, body: &'b [u8]) -> Result<T, CodecError> {
    let mut decoder = minicbor::Decoder::new(body);
    let value = decoder.decode().map_err(|source| CodecError::Malformed { kind, source })?;
    if decoder.position() == body.len() { Ok(value) } else { Err(CodecError::Trailing(kind)) }
}
