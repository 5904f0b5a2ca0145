//! The envelope's header, which is in the clear: a parser for received headers, and the template
//! that a sealer completes.

use alloc::boxed::Box;
use alloc::vec::Vec;

use crate::channel::{KeyId, MAX_ID_LEN};
use crate::route::{Kind, Route, TopicHash};

/// The first bytes of every envelope.
pub const MAGIC: [u8; 8] = *b"AXQKD001";
/// The length of the AES-GCM nonce: 8 random bytes, drawn once per key, and the index as a
/// big-endian u32.
pub const NONCE_LEN: usize = 12;
/// The length of the shortest header, with both IDs of one byte.
pub const MIN_HEADER_LEN: usize = FIXED_LEN + 2;
/// The length of the longest header, with both IDs of 255 bytes.
pub const MAX_HEADER_LEN: usize = FIXED_LEN + 2 * MAX_ID_LEN;

const KIND_AT: usize = 8;
const FLAGS_AT: usize = 9;
const INDEX_AT: usize = 10;
const TOPIC_AT: usize = 11;
const SENDER_AT: usize = 27;
const FIXED_LEN: usize = SENDER_AT + 1 + 1 + NONCE_LEN;

/// An envelope's header, parsed and not yet authenticated.
///
/// Everything in it is a claim of the sender until the envelope has opened.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Header<'a> {
    /// The route that the message claims.
    pub route: Route,
    /// The message's index under the key. It can be 10 or more; an envelope with that index is
    /// refused when it is opened.
    pub index: u8,
    /// The SAE ID of the sender, 1 to 255 bytes.
    pub sender: &'a [u8],
    /// The key_ID of the sealing key, 1 to 255 bytes.
    pub key_id: &'a [u8],
    /// The nonce of the AEAD. Its last four bytes are the index.
    pub nonce: [u8; NONCE_LEN],
}

/// The reason why bytes are not an AXQKD001 header.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum HeaderError {
    /// The bytes end inside the header or the tag.
    #[error("cut short: {given} bytes where at least {needed} are needed")]
    Truncated {
        /// The number of bytes needed, as far as the header could be read.
        needed: usize,
        /// The number of bytes given.
        given: usize,
    },
    /// The bytes do not begin with `AXQKD001`.
    #[error("does not begin with AXQKD001: another protocol or another version")]
    Magic,
    /// The kind is not topic, request or response.
    #[error("kind {0}: only 0 (topic), 1 (request) and 2 (response) exist")]
    Kind(u8),
    /// A flag is set that this version does not define.
    #[error("flags {0:#04x}: this version defines none")]
    Flags(u8),
    /// The sender's SAE ID is empty.
    #[error("the sender's SAE ID is empty")]
    EmptySender,
    /// The key_ID is empty.
    #[error("the key_ID is empty")]
    EmptyKeyId,
    /// The nonce's counter differs from the index.
    #[error("the nonce's counter is not the index")]
    NonceIndex,
    /// A header that was given separately has bytes after its end.
    #[error("{0} bytes behind the header's end")]
    Trailing(usize),
}

impl<'a> Header<'a> {
    /// Parses the header at the start of `bytes`. Also returns its length.
    ///
    /// It allocates nothing, and reads at most [`MAX_HEADER_LEN`] bytes. Each header has one
    /// encoding. A sealer can produce every header that this function accepts, except one with an
    /// index of ten or more.
    /// ```
    /// # use axon_envelope::{Header, HeaderError};
    /// assert_eq!(Header::parse(b"AXQKD002................................."),
    /// Err(HeaderError::Magic));
    /// ```
    ///
    /// # Errors
    /// [`HeaderError`], which depends only on these bytes, never on a key.
    pub fn parse(bytes: &'a [u8]) -> Result<(Self, usize), HeaderError> {
        let mut rest = Reader { bytes, at: 0 };
        if rest.take::<8>()? != &MAGIC {
            return Err(HeaderError::Magic);
        }
        let [kind] = *rest.take()?;
        let kind = Kind::from_byte(kind).ok_or(HeaderError::Kind(kind))?;
        let [flags] = *rest.take()?;
        if flags != 0 {
            return Err(HeaderError::Flags(flags));
        }
        let [index] = *rest.take()?;
        let topic = TopicHash(*rest.take()?);
        let sender = rest.id(HeaderError::EmptySender)?;
        let key_id = rest.id(HeaderError::EmptyKeyId)?;
        let nonce: [u8; NONCE_LEN] = *rest.take()?;
        if nonce[8..] != u32::from(index).to_be_bytes() {
            return Err(HeaderError::NonceIndex);
        }
        Ok((Self { route: Route { kind, topic }, index, sender, key_id, nonce }, rest.at))
    }
}

struct Reader<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Reader<'a> {
    fn take<const N: usize>(&mut self) -> Result<&'a [u8; N], HeaderError> {
        let field = self.bytes[self.at..].first_chunk().ok_or_else(|| self.truncated(N))?;
        self.at += N;
        Ok(field)
    }

    fn id(&mut self, empty: HeaderError) -> Result<&'a [u8], HeaderError> {
        let [length] = *self.take()?;
        let length = usize::from(length);
        if length == 0 {
            return Err(empty);
        }
        let id = self.bytes.get(self.at..self.at + length);
        let id = id.ok_or_else(|| self.truncated(length))?;
        self.at += length;
        Ok(id)
    }

    fn truncated(&self, field: usize) -> HeaderError {
        HeaderError::Truncated { needed: self.at + field, given: self.bytes.len() }
    }
}

/// A sealer's header, complete except for kind, topic and index.
pub(crate) struct Template(Box<[u8]>);

impl Template {
    pub(crate) fn new(sender: &[u8], key_id: &KeyId, nonce_prefix: [u8; 8]) -> Self {
        let key_id = key_id.as_bytes();
        let mut header = Vec::with_capacity(FIXED_LEN + sender.len() + key_id.len());
        header.extend_from_slice(&MAGIC);
        header.resize(SENDER_AT, 0);
        for id in [sender, key_id] {
            // `KeyId` and `Channel` hold IDs of at most 255 bytes.
            header.push(id.len() as u8);
            header.extend_from_slice(id);
        }
        header.extend_from_slice(&nonce_prefix);
        header.extend_from_slice(&[0; 4]);
        Self(header.into_boxed_slice())
    }

    pub(crate) fn len(&self) -> usize {
        self.0.len()
    }

    /// Writes the header of message `index` into `out`, which has exactly [`Self::len`] bytes.
    /// Returns the nonce.
    pub(crate) fn write(&self, route: Route, index: u8, out: &mut [u8]) -> [u8; NONCE_LEN] {
        out.copy_from_slice(&self.0);
        out[KIND_AT] = route.kind as u8;
        out[FLAGS_AT] = 0;
        out[INDEX_AT] = index;
        out[TOPIC_AT..SENDER_AT].copy_from_slice(&route.topic.0);
        let nonce = out.last_chunk_mut::<NONCE_LEN>().expect("a header ends with its nonce");
        nonce[8..].copy_from_slice(&u32::from(index).to_be_bytes());
        *nonce
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use alloc::vec;

    const ROUTE: Route = Route { kind: Kind::Response, topic: TopicHash([9; 16]) };

    fn header(sender: &[u8], key_id: &[u8], index: u8) -> Vec<u8> {
        let template = Template::new(sender, &KeyId::new(key_id).unwrap(), [5; 8]);
        let mut out = vec![0; template.len()];
        template.write(ROUTE, index, &mut out);
        out
    }

    fn parse_changed(at: usize, value: u8) -> Result<(), HeaderError> {
        let mut bytes = header(b"alice", b"key", 3);
        bytes[at] = value;
        Header::parse(&bytes).map(|_| ())
    }

    #[test]
    fn every_truncated_header_reports_the_needed_length() {
        let bytes = header(b"alice", b"key", 3);
        for cut in 0..bytes.len() {
            match Header::parse(&bytes[..cut]) {
                Err(HeaderError::Truncated { needed, given }) => {
                    assert_eq!(given, cut);
                    assert!(needed > cut && needed <= bytes.len());
                }
                other => panic!("cut at {cut}: {other:?}"),
            }
        }
    }

    #[test]
    fn each_malformed_field_is_named() {
        assert_eq!(parse_changed(7, b'2'), Err(HeaderError::Magic));
        assert_eq!(parse_changed(KIND_AT, 3), Err(HeaderError::Kind(3)));
        assert_eq!(parse_changed(FLAGS_AT, 0x80), Err(HeaderError::Flags(0x80)));
        assert_eq!(parse_changed(INDEX_AT, 4), Err(HeaderError::NonceIndex));
        assert_eq!(parse_changed(SENDER_AT, 0), Err(HeaderError::EmptySender));
        assert_eq!(parse_changed(SENDER_AT + 6, 0), Err(HeaderError::EmptyKeyId));
        let bytes = header(b"alice", b"key", 3);
        let err = HeaderError::Truncated { needed: SENDER_AT + 1 + 255, given: bytes.len() };
        assert_eq!(parse_changed(SENDER_AT, 255), Err(err));
    }

    #[test]
    fn shortest_and_longest_headers_parse() {
        for (ids, len) in [(1, MIN_HEADER_LEN), (255, MAX_HEADER_LEN)] {
            let bytes = header(&vec![b'a'; ids], &vec![b'k'; ids], 255);
            assert_eq!(bytes.len(), len);
            let (parsed, used) = Header::parse(&bytes).unwrap();
            assert_eq!((used, parsed.index, parsed.route), (len, 255, ROUTE));
            assert_eq!((parsed.sender.len(), parsed.key_id.len()), (ids, ids));
        }
    }
}
