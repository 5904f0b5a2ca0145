//! Frames of the control stream: `length u32 || type u8 || CBOR map`, bit 7 of the type for zstd.

use minicbor::{Decode, Encode};

use super::LinkMessage;

/// Largest frame before both HELLOs were checked, in bytes after the length.
pub const MAX_FRAME_BEFORE_HELLO: usize = 4 * 1024;
/// Largest frame after that.
pub const MAX_FRAME: usize = 1024 * 1024;
/// Largest map after decompression, in bytes.
pub const MAX_INFLATED: usize = 4 * 1024 * 1024;

/// Smallest map that is compressed, in bytes.
const COMPRESS_FROM: usize = 1024;
const COMPRESSED: u8 = 0x80;
const ZSTD_LEVEL: i32 = 1;

/// A fault of a frame.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum FrameError {
    /// The frame is longer than allowed at this point.
    #[error("a frame of {length} bytes, at most {limit} are allowed here")]
    TooLarge {
        /// The stated length.
        length: usize,
        /// The limit at this point.
        limit: usize,
    },
    /// The frame has no type byte.
    #[error("an empty frame")]
    Empty,
    /// The compressed map is broken, or does not have the stated length.
    #[error("the compressed map is broken: {0}")]
    Compression(&'static str),
    /// The map does not match its type.
    #[error("message type {kind}: {reason}")]
    Malformed {
        /// The type byte.
        kind: u8,
        /// The decoder's error.
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

/// Returns whether `frame` (without its length) has a type that this version knows.
pub(crate) fn is_known(frame: &[u8]) -> bool {
    frame.first().is_some_and(|kind| LinkMessage::is_known(kind & !COMPRESSED))
}

/// Returns the number of bytes of the map in `frame` (without its length) after decompression, as the frame states it.
/// For an uncompressed map it is the length of `frame`.
pub fn unpacked_length(frame: &[u8]) -> usize {
    match frame.split_first() {
        Some((kind, body)) if kind & COMPRESSED != 0 => {
            body.first_chunk::<4>().map_or(0, |length| u32::from_be_bytes(*length) as usize)
        }
        _ => frame.len(),
    }
}

impl LinkMessage {
    /// Returns the frame of this message with its length in front.
    ///
    /// # Errors
    /// [`FrameError::TooLarge`] if it exceeds [`MAX_FRAME`] even compressed.
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

    /// Returns the message in `frame` (without its length), or `None` for a type that this version does not know. A
    /// compressed map may have at most `inflated` bytes.
    ///
    /// # Errors
    /// [`FrameError`]; never panics, and allocates no more than `inflated` for the map.
    pub fn from_frame(frame: &[u8], inflated: usize) -> Result<Option<Self>, FrameError> {
        let (&kind, body) = frame.split_first().ok_or(FrameError::Empty)?;
        if kind & COMPRESSED == 0 {
            return Self::decode(kind, body);
        }
        // A frame of an unknown type is skipped without decompression.
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

/// Returns the CBOR map of `value`.
pub(super) fn to_map<T: Encode<()>>(value: &T) -> Vec<u8> {
    // A write to a vector cannot fail, and no message has an encoder that fails.
    minicbor::to_vec(value).unwrap_or_default()
}

/// Decodes a value from its CBOR map; no bytes may follow it.
pub(super) fn from_map<'b, T: Decode<'b, ()>>(kind: u8, map: &'b [u8]) -> Result<T, FrameError> {
    let malformed = |reason: String| FrameError::Malformed { kind, reason };
    let mut decoder = minicbor::Decoder::new(map);
    let value = decoder.decode().map_err(|e| malformed(e.to_string()))?;
    if decoder.position() != map.len() {
        return Err(malformed("bytes after the map".into()));
    }
    Ok(value)
}
