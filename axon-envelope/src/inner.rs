//! AXON's prefix of the plaintext: the fields that the receiver acts on. They are sealed, before
//! the payload.
//!
//! 64 bytes, big-endian:
//!
//! | offset | bytes | field                                                                     |
//! | ------ | ----- | ------------------------------------------------------------------------- |
//! | 0      | 16    | publisher's GID                                                           |
//! | 16     | 8     | sequence number, u64                                                      |
//! | 24     | 8     | source timestamp, i64, nanoseconds since the Unix epoch                   |
//! | 32     | 16    | request id: GID of the client; zero for a topic                           |
//! | 48     | 8     | request id: the client's sequence number, i64; zero for a topic           |
//! | 56     | 1     | flags; bit 0: the payload is one zstd frame; the others are zero          |
//! | 57     | 3     | age: milliseconds the message spent in the sender's hands, u24, saturating |
//! | 60     | 4     | length of the payload once decompressed, u32                              |
//!
//! The envelope itself does not read the prefix. Another application can seal any plaintext.

/// The length of an encoded [`Header`].
pub const LEN: usize = 64;

/// The largest age that a header can state, in milliseconds. It is more than four and a half hours.
pub const MAX_AGE_MS: u32 = (1 << 24) - 1;

const FLAG_ZSTD: u8 = 1;

/// The fields before a payload.
///
/// ```
/// use axon_envelope::inner::{Header, RequestId};
///
/// let header = Header {
///     gid: [1; 16],
///     sequence: 7,
///     source_timestamp: 1_700_000_000_000_000_000,
///     request_id: RequestId::default(),
///     compressed: false,
///     age_ms: 3,
///     uncompressed_len: 2,
/// };
/// let plaintext = [&header.encode()[..], b"hi"].concat();
/// assert_eq!(Header::decode(&plaintext).unwrap(), (header, &b"hi"[..]));
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Header {
    /// The publisher's GID. For a request it is the client's, for a response the server's.
    pub gid: [u8; 16],
    /// The publisher's message count.
    pub sequence: u64,
    /// The time of publication by the sender's clock, in nanoseconds since the Unix epoch.
    pub source_timestamp: i64,
    /// The call to which a request or response belongs. It is zero for a topic.
    pub request_id: RequestId,
    /// Whether the payload is one zstd frame.
    pub compressed: bool,
    /// The milliseconds that the message spent in the sender's hands. [`MAX_AGE_MS`] stands for all
    /// larger values.
    pub age_ms: u32,
    /// The payload's length in bytes after decompression.
    pub uncompressed_len: u32,
}

/// A service call: the client and its count of calls.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash)]
pub struct RequestId {
    /// The client's GID.
    pub client: [u8; 16],
    /// The client's sequence number of the call.
    pub sequence: i64,
}

/// The reason why plaintext does not begin with a valid inner header.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The plaintext has fewer than [`LEN`] bytes.
    #[error("inner header cut short: {0} bytes of 64")]
    Truncated(usize),
    /// An undefined flag is set.
    #[error("inner header flags {0:#04x}: only bit 0 (zstd) is defined")]
    Flags(u8),
    /// The length of an uncompressed payload differs from the stated one.
    #[error("inner header states {stated} bytes of payload, {given} follow")]
    Length {
        /// The length in the header.
        stated: u32,
        /// The length of the bytes after the header.
        given: usize,
    },
}

impl Header {
    /// Encodes the header as it stands before the payload.
    pub fn encode(&self) -> [u8; LEN] {
        let mut out = [0; LEN];
        out[0..16].copy_from_slice(&self.gid);
        out[16..24].copy_from_slice(&self.sequence.to_be_bytes());
        out[24..32].copy_from_slice(&self.source_timestamp.to_be_bytes());
        out[32..48].copy_from_slice(&self.request_id.client);
        out[48..56].copy_from_slice(&self.request_id.sequence.to_be_bytes());
        out[56] = if self.compressed { FLAG_ZSTD } else { 0 };
        out[57..60].copy_from_slice(&self.age_ms.min(MAX_AGE_MS).to_be_bytes()[1..]);
        out[60..64].copy_from_slice(&self.uncompressed_len.to_be_bytes());
        out
    }

    /// Splits opened plaintext into header and payload.
    ///
    /// The length of a compressed payload is still a claim: decompress into a buffer of that length
    /// and no more.
    ///
    /// # Errors
    /// [`Error`] if the plaintext is too short, sets an undefined flag, or states a length that an
    /// uncompressed payload does not have.
    pub fn decode(plaintext: &[u8]) -> Result<(Self, &[u8]), Error> {
        let Some((head, payload)) = plaintext.split_first_chunk::<LEN>() else {
            return Err(Error::Truncated(plaintext.len()));
        };
        let flags = head[56];
        if flags & !FLAG_ZSTD != 0 {
            return Err(Error::Flags(flags));
        }
        let header = Self {
            gid: field(head, 0),
            sequence: u64::from_be_bytes(field(head, 16)),
            source_timestamp: i64::from_be_bytes(field(head, 24)),
            request_id: RequestId {
                client: field(head, 32),
                sequence: i64::from_be_bytes(field(head, 48)),
            },
            compressed: flags & FLAG_ZSTD != 0,
            age_ms: u32::from_be_bytes([0, head[57], head[58], head[59]]),
            uncompressed_len: u32::from_be_bytes(field(head, 60)),
        };
        if !header.compressed && u32::try_from(payload.len()) != Ok(header.uncompressed_len) {
            let error = Error::Length { stated: header.uncompressed_len, given: payload.len() };
            return Err(error);
        }
        Ok((header, payload))
    }
}

fn field<const N: usize>(head: &[u8; LEN], at: usize) -> [u8; N] {
    let mut out = [0; N];
    out.copy_from_slice(&head[at..at + N]);
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use alloc::vec::Vec;

    fn sample(compressed: bool, uncompressed_len: u32) -> Header {
        Header {
            gid: *b"0123456789abcdef",
            sequence: u64::MAX - 1,
            source_timestamp: -2,
            request_id: RequestId { client: [0xcc; 16], sequence: i64::MIN },
            compressed,
            age_ms: MAX_AGE_MS,
            uncompressed_len,
        }
    }

    #[test]
    fn every_cut_and_every_undefined_bit_is_refused() {
        let bytes = sample(false, 0).encode();
        for cut in 0..LEN {
            assert_eq!(Header::decode(&bytes[..cut]), Err(Error::Truncated(cut)));
        }
        for bit in 1..8 {
            let mut changed = bytes;
            changed[56] = 1 << bit;
            assert_eq!(Header::decode(&changed), Err(Error::Flags(1 << bit)));
        }
    }

    #[test]
    fn an_age_beyond_24_bits_saturates() {
        for (age_ms, stated) in [(0, 0), (66_051, 66_051), (1 << 24, MAX_AGE_MS)] {
            let bytes = Header { age_ms, ..sample(true, 1) }.encode();
            assert_eq!(Header::decode(&bytes).unwrap().0.age_ms, stated);
        }
    }

    #[test]
    fn the_stated_length_binds_an_uncompressed_payload_only() {
        let message = |header: Header| [&header.encode()[..], b"abc"].concat();
        for stated in [0, 2, 4, u32::MAX] {
            let error = Error::Length { stated, given: 3 };
            assert_eq!(Header::decode(&message(sample(false, stated))), Err(error));
        }
        let plain: Vec<u8> = message(sample(false, 3));
        assert_eq!(Header::decode(&plain), Ok((sample(false, 3), &b"abc"[..])));
        let zstd = message(sample(true, 9_000));
        assert_eq!(Header::decode(&zstd), Ok((sample(true, 9_000), &b"abc"[..])));
    }
}
