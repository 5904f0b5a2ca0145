//! Key announcements on the control stream: the CBOR maps of frame types 16 to 19
//! (docs/formats.md, section 4).

use axon_envelope::{IndexMask, KeyId};
use minicbor::{Decoder, Encoder, data::Type};

/// Most key_IDs in one ANNOUNCE.
pub const MAX_ANNOUNCED: usize = 16;
/// Longest key_ID on the control stream, in bytes.
pub const MAX_KEY_ID: usize = 128;
/// Longest reason in FAILED, in bytes.
pub const MAX_REASON: usize = 128;

/// Bytes of the proof in READY.
pub const PROOF_LEN: usize = 32;

const ANNOUNCE: u8 = 16;
const READY: u8 = 17;
const FAILED: u8 = 18;
const RETIRE: u8 = 19;

/// One key announcement.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum KeyMessage {
    /// From a sender: the receiver should fetch these keys. 1 to [`MAX_ANNOUNCED`].
    Announce(Vec<KeyId>),
    /// From a receiver: it holds this key, and the sender may seal under it.
    Ready {
        /// The key.
        key_id: KeyId,
        /// The proof of the receiver, see `keys::proof`.
        proof: [u8; PROOF_LEN],
    },
    /// From a receiver: it cannot get this key.
    Failed {
        /// The key.
        key_id: KeyId,
        /// Why, for log and status.
        reason: String,
    },
    /// From a sender: it seals nothing more under this key.
    Retire {
        /// The key.
        key_id: KeyId,
        /// Indexes that were sealed.
        used: IndexMask,
        /// The used indices that went on reliable streams.
        reliable: IndexMask,
    },
}

/// The reason why bytes are not a key announcement.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum MessageError {
    /// The frame type is another one's.
    #[error("frame type {0} is no key announcement")]
    Type(u8),
    /// The bytes are not one CBOR map with integer keys.
    #[error("malformed CBOR: {0}")]
    Cbor(String),
    /// A key of the map that is needed is absent.
    #[error("the map lacks key {0}")]
    Missing(u8),
    /// A key is there twice.
    #[error("the map holds key {0} twice")]
    Repeated(u64),
    /// A value is outside what the format allows.
    #[error("{0}")]
    Range(&'static str),
}

impl From<minicbor::decode::Error> for MessageError {
    fn from(e: minicbor::decode::Error) -> Self {
        Self::Cbor(e.to_string())
    }
}

/// A violation of the rules for key announcements by a peer. The link is closed for it.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum KeyViolation {
    /// RETIRE with masks that contradict each other, or the messages that were opened.
    #[error("RETIRE for key_ID {0}: {1}")]
    Masks(KeyId, String),
    /// A message that has no place here.
    #[error("{0} was not expected here")]
    Unexpected(&'static str),
}

impl KeyViolation {
    /// Returns the application error code to close the connection with (docs/formats.md, section 6).
    pub fn code(&self) -> u64 {
        match self {
            Self::Masks(..) => 0x30,
            Self::Unexpected(_) => 0x32,
        }
    }
}

impl KeyMessage {
    /// Returns the frame's type byte.
    pub fn frame_type(&self) -> u8 {
        match self {
            Self::Announce(_) => ANNOUNCE,
            Self::Ready { .. } => READY,
            Self::Failed { .. } => FAILED,
            Self::Retire { .. } => RETIRE,
        }
    }

    /// Returns the message's name in the format.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Announce(_) => "ANNOUNCE",
            Self::Ready { .. } => "READY",
            Self::Failed { .. } => "FAILED",
            Self::Retire { .. } => "RETIRE",
        }
    }

    /// Appends the CBOR map, without the type byte.
    pub fn encode(&self, out: &mut Vec<u8>) {
        let mut e = Encoder::new(out);
        let done: Result<(), minicbor::encode::Error<std::convert::Infallible>> = (|| {
            match self {
                Self::Announce(key_ids) => {
                    e.map(1)?.u8(0)?.array(key_ids.len() as u64)?;
                    for key_id in key_ids {
                        e.str(text(key_id))?;
                    }
                }
                Self::Ready { key_id, proof } => {
                    e.map(2)?.u8(0)?.str(text(key_id))?.u8(1)?.bytes(proof)?;
                }
                Self::Failed { key_id, reason } => {
                    e.map(2)?.u8(0)?.str(text(key_id))?.u8(1)?.str(shortened(reason))?;
                }
                Self::Retire { key_id, used, reliable } => {
                    e.map(3)?.u8(0)?.str(text(key_id))?;
                    e.u8(1)?.u16(used.bits())?.u8(2)?.u16(reliable.bits())?;
                }
            }
            Ok(())
        })();
        done.expect("writing to a Vec cannot fail");
    }

    /// Reads the CBOR map behind a frame's type byte. Unknown keys are skipped.
    ///
    /// # Errors
    /// [`MessageError`], for any bytes that are not a map of this format, or exceed its bounds.
    pub fn decode(frame_type: u8, map: &[u8]) -> Result<Self, MessageError> {
        let mut fields = Fields::default();
        let mut d = Decoder::new(map);
        let pairs = d.map()?.ok_or(MessageError::Range("the map has no definite length"))?;
        for _ in 0..pairs {
            let key = d.u64()?;
            if let Some(bit) = key.try_into().ok().and_then(|k| 1u8.checked_shl(k)) {
                if fields.seen & bit != 0 {
                    return Err(MessageError::Repeated(key));
                }
                fields.seen |= bit;
            }
            match (frame_type, key) {
                (ANNOUNCE, 0) => fields.key_ids = key_ids(&mut d)?,
                (READY | FAILED | RETIRE, 0) => fields.key_id = Some(key_id(&mut d)?),
                (READY, 1) => {
                    let bytes = d.bytes()?.try_into();
                    fields.proof =
                        Some(bytes.map_err(|_| MessageError::Range("a proof has 32 bytes"))?);
                }
                (FAILED, 1) => {
                    let reason = d.str()?;
                    if reason.len() > MAX_REASON {
                        return Err(MessageError::Range("a reason has at most 128 bytes"));
                    }
                    fields.reason = Some(reason.to_owned());
                }
                (RETIRE, 1) => fields.used = Some(mask(&mut d)?),
                (RETIRE, 2) => fields.reliable = Some(mask(&mut d)?),
                _ => d.skip()?,
            }
        }
        if d.position() != map.len() {
            return Err(MessageError::Range("bytes follow the map"));
        }
        let missing = MessageError::Missing;
        Ok(match frame_type {
            ANNOUNCE if fields.key_ids.is_empty() => return Err(missing(0)),
            ANNOUNCE => Self::Announce(fields.key_ids),
            READY => Self::Ready {
                key_id: fields.key_id.ok_or(missing(0))?,
                proof: fields.proof.ok_or(missing(1))?,
            },
            FAILED => Self::Failed {
                key_id: fields.key_id.ok_or(missing(0))?,
                reason: fields.reason.ok_or(missing(1))?,
            },
            RETIRE => Self::Retire {
                key_id: fields.key_id.ok_or(missing(0))?,
                used: fields.used.ok_or(missing(1))?,
                reliable: fields.reliable.ok_or(missing(2))?,
            },
            other => return Err(MessageError::Type(other)),
        })
    }
}

#[derive(Default)]
struct Fields {
    /// Bit i: key i was read. No key of eight or more is defined; such keys are skipped, even if they are repeated.
    seen: u8,
    key_ids: Vec<KeyId>,
    key_id: Option<KeyId>,
    proof: Option<[u8; PROOF_LEN]>,
    reason: Option<String>,
    used: Option<IndexMask>,
    reliable: Option<IndexMask>,
}

/// Returns a key_ID's text, if the key_ID can be announced: text of at most [`MAX_KEY_ID`] bytes.
pub(crate) fn announceable(key_id: &KeyId) -> Option<&str> {
    let fits = key_id.as_bytes().len() <= MAX_KEY_ID;
    std::str::from_utf8(key_id.as_bytes()).ok().filter(|_| fits)
}

fn text(key_id: &KeyId) -> &str {
    std::str::from_utf8(key_id.as_bytes())
        .expect("key_IDs are checked to be text before they are announced")
}

/// Returns the longest prefix of a reason that the format permits, cut between characters.
fn shortened(reason: &str) -> &str {
    let fits = (0..=MAX_REASON.min(reason.len())).rev().find(|&i| reason.is_char_boundary(i));
    &reason[..fits.unwrap_or(0)]
}

fn key_ids(d: &mut Decoder<'_>) -> Result<Vec<KeyId>, MessageError> {
    match d.array()? {
        Some(n) if (1..=MAX_ANNOUNCED as u64).contains(&n) => (0..n).map(|_| key_id(d)).collect(),
        _ => Err(MessageError::Range("an ANNOUNCE names 1 to 16 key_IDs")),
    }
}

fn key_id(d: &mut Decoder<'_>) -> Result<KeyId, MessageError> {
    const RANGE: MessageError = MessageError::Range("a key_ID is text of 1 to 128 bytes");
    if d.datatype()? != Type::String {
        return Err(RANGE);
    }
    let text = d.str()?;
    if text.len() > MAX_KEY_ID {
        return Err(RANGE);
    }
    KeyId::new(text).map_err(|_| RANGE)
}

fn mask(d: &mut Decoder<'_>) -> Result<IndexMask, MessageError> {
    IndexMask::from_bits(d.u16()?).ok_or(MessageError::Range("a mask has bits 0 to 9"))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn id(text: &str) -> KeyId {
        KeyId::new(text).unwrap()
    }

    fn encode(m: &KeyMessage) -> Vec<u8> {
        let mut out = Vec::new();
        m.encode(&mut out);
        out
    }

    #[test]
    fn bounds_are_kept() {
        let announce = |ids: usize, len: usize| {
            let mut out = Vec::new();
            let mut e = Encoder::new(&mut out);
            e.map(1).unwrap().u8(0).unwrap().array(ids as u64).unwrap();
            for _ in 0..ids {
                e.str(&"k".repeat(len)).unwrap();
            }
            KeyMessage::decode(ANNOUNCE, &out)
        };
        assert!(matches!(announce(0, 1), Err(MessageError::Range(_))));
        assert!(matches!(announce(17, 1), Err(MessageError::Range(_))));
        assert!(matches!(announce(1, 0), Err(MessageError::Range(_))));
        assert!(matches!(announce(1, 129), Err(MessageError::Range(_))));
        assert!(announce(16, 128).is_ok());
        // A map that claims 2^63 pairs, an array that claims 2^63 items, key 0 twice, a mask with
        // bit 10.
        assert!(KeyMessage::decode(ANNOUNCE, &[0xbb, 0x80, 0, 0, 0, 0, 0, 0, 0]).is_err());
        assert!(KeyMessage::decode(ANNOUNCE, &[0xa1, 0, 0x9b, 0x80, 0, 0, 0, 0, 0, 0, 0]).is_err());
        assert_eq!(
            KeyMessage::decode(ANNOUNCE, &[0xa2, 0, 0x81, 0x61, b'k', 0, 0x81, 0x61, b'k']),
            Err(MessageError::Repeated(0))
        );
        assert!(matches!(
            KeyMessage::decode(RETIRE, &[0xa3, 0, 0x61, b'k', 1, 0x19, 4, 0, 2, 0]),
            Err(MessageError::Range(_))
        ));
        assert_eq!(
            KeyMessage::decode(READY, &[0xa1, 0, 0x61, b'k']),
            Err(MessageError::Missing(1))
        );
        assert_eq!(KeyMessage::decode(7, &[0xa0]), Err(MessageError::Type(7)));
        assert!(KeyMessage::decode(FAILED, &[0xa0, 0]).is_err());
    }

    #[test]
    fn unknown_keys_are_skipped() {
        let map = [0xa2, 0x18, 99, 0xa1, 0, 0x80, 0, 0x81, 0x61, b'k'];
        assert_eq!(KeyMessage::decode(ANNOUNCE, &map), Ok(KeyMessage::Announce(vec![id("k")])));
    }

    #[test]
    fn a_long_reason_is_cut_at_a_character() {
        let m = KeyMessage::Failed { key_id: id("k"), reason: "ä".repeat(100) + "x" };
        let KeyMessage::Failed { reason, .. } = KeyMessage::decode(FAILED, &encode(&m)).unwrap()
        else {
            panic!()
        };
        assert_eq!(reason, "ä".repeat(64));
    }

    proptest! {
        #[test]
        fn no_bytes_panic(
            frame_type in 15u8..21,
            bytes in proptest::collection::vec(any::<u8>(), 0..64),
        ) {
            let _ = KeyMessage::decode(frame_type, &bytes);
        }

        #[test]
        fn key_messages_survive_a_round_trip(
            name in "[!-~]{1,128}", proof: [u8; 32], reason in "[a-z ]{0,128}",
            used in 0u16..1024, n in 1usize..17,
        ) {
            let used = IndexMask::from_bits(used).unwrap();
            for m in [
                KeyMessage::Announce(vec![id(&name); n]),
                KeyMessage::Ready { key_id: id(&name), proof },
                KeyMessage::Failed { key_id: id(&name), reason },
                KeyMessage::Retire { key_id: id(&name), used, reliable: IndexMask::EMPTY },
            ] {
                prop_assert_eq!(KeyMessage::decode(m.frame_type(), &encode(&m)), Ok(m));
            }
        }
    }
}
