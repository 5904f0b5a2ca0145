//! Frames of the control stream: `length u32 || type u8 || CBOR map`, bit 7 of the type for zstd.

use minicbor::{Decode, Encode};

use super::LinkMessage;

/// Largest frame before both HELLOs were checked, in bytes after the length.
pub const MAX_FRAME_BEFORE_HELLO: usize = 4 * 1024;
/// Largest frame afterwards.
pub const MAX_FRAME: usize = 1024 * 1024;
/// Largest map after decompression.
pub const MAX_INFLATED: usize = 4 * 1024 * 1024;

/// A map smaller than this is not worth compressing.
const COMPRESS_FROM: usize = 1024;
const COMPRESSED: u8 = 0x80;
const ZSTD_LEVEL: i32 = 1;

/// What is wrong with a frame.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum FrameError {
    /// Longer than allowed at this point.
    #[error("a frame of {length} bytes, at most {limit} are allowed here")]
    TooLarge {
        /// The length stated.
        length: usize,
        /// The bound in force.
        limit: usize,
    },
    /// No type byte.
    #[error("an empty frame")]
    Empty,
    /// The compressed map is broken or longer than it says.
    #[error("the compressed map is broken: {0}")]
    Compression(&'static str),
    /// The map is not what its type says.
    #[error("message type {kind}: {reason}")]
    Malformed {
        /// The type byte.
        kind: u8,
        /// What the decoder says.
        reason: String,
    },
}

/// Checks the length in front of a frame before anything is allocated for it.
///
/// # Errors
/// [`FrameError::TooLarge`] and [`FrameError::Empty`].
pub fn read_length(prefix: [u8; 4], limit: usize) -> Result<usize, FrameError> {
    match u32::from_be_bytes(prefix) as usize {
        0 => Err(FrameError::Empty),
        length if length > limit => Err(FrameError::TooLarge { length, limit }),
        length => Ok(length),
    }
}

/// Whether `frame` (without its length) has a type that this version knows.
pub(crate) fn is_known(frame: &[u8]) -> bool {
    frame.first().is_some_and(|kind| LinkMessage::is_known(kind & !COMPRESSED))
}

/// Bytes of the map in `frame` (without its length) once it is decompressed, as the frame says.
pub fn unpacked_length(frame: &[u8]) -> usize {
    match frame.split_first() {
        Some((kind, body)) if kind & COMPRESSED != 0 => {
            body.first_chunk::<4>().map_or(0, |length| u32::from_be_bytes(*length) as usize)
        }
        _ => frame.len(),
    }
}

impl LinkMessage {
    /// The frame of this message with its length in front.
    ///
    /// # Errors
    /// [`FrameError::TooLarge`] when it exceeds [`MAX_FRAME`] even compressed.
    pub fn to_frame(&self) -> Result<Vec<u8>, FrameError> {
        let (kind, map) = self.encode();
        let mut frame = vec![0; 4];
        let compressed = (map.len() >= COMPRESS_FROM && map.len() <= MAX_INFLATED)
            .then(|| zstd::bulk::compress(&map, ZSTD_LEVEL).ok())
            .flatten()
            .filter(|c| c.len() + 4 < map.len());
        match compressed {
            Some(body) => {
                frame.push(kind | COMPRESSED);
                // At most MAX_INFLATED, checked above.
                frame.extend_from_slice(&(map.len() as u32).to_be_bytes());
                frame.extend_from_slice(&body);
            }
            None => {
                frame.push(kind);
                frame.extend_from_slice(&map);
            }
        }
        let length = frame.len() - 4;
        if length > MAX_FRAME {
            return Err(FrameError::TooLarge { length, limit: MAX_FRAME });
        }
        frame[..4].copy_from_slice(&(length as u32).to_be_bytes());
        Ok(frame)
    }

    /// The message in `frame` (without its length), or `None` for a type this version does not
    /// know. A compressed map may have at most `inflated` bytes.
    ///
    /// # Errors
    /// [`FrameError`]; never panics, and allocates no more than `inflated` for the map.
    pub fn from_frame(frame: &[u8], inflated: usize) -> Result<Option<Self>, FrameError> {
        let (&kind, body) = frame.split_first().ok_or(FrameError::Empty)?;
        if kind & COMPRESSED == 0 {
            return Self::decode(kind, body);
        }
        // Nothing is decompressed in order to be passed over.
        if !is_known(frame) {
            return Ok(None);
        }
        let (length, body) =
            body.split_first_chunk::<4>().ok_or(FrameError::Compression("no length"))?;
        let length = u32::from_be_bytes(*length) as usize;
        if length > inflated {
            return Err(FrameError::TooLarge { length, limit: inflated });
        }
        let map = zstd::bulk::decompress(body, length)
            .map_err(|_| FrameError::Compression("not one zstd frame of the stated length"))?;
        if map.len() != length {
            return Err(FrameError::Compression("shorter than stated"));
        }
        Self::decode(kind & !COMPRESSED, &map)
    }
}

/// The CBOR map of `value`.
pub(super) fn to_map<T: Encode<()>>(value: &T) -> Vec<u8> {
    // Writing into a vector cannot fail, and none of our maps has an encoder that does.
    minicbor::to_vec(value).unwrap_or_default()
}

/// A value from its CBOR map; nothing may follow it.
pub(super) fn from_map<'b, T: Decode<'b, ()>>(kind: u8, map: &'b [u8]) -> Result<T, FrameError> {
    let malformed = |reason: String| FrameError::Malformed { kind, reason };
    let mut decoder = minicbor::Decoder::new(map);
    let value = decoder.decode().map_err(|e| malformed(e.to_string()))?;
    if decoder.position() != map.len() {
        return Err(malformed("bytes after the map".into()));
    }
    Ok(value)
}
