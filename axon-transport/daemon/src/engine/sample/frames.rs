//! Collects the buffers of one write to a stream: short messages are copied together, long payloads are not
//! copied.

use bytes::Bytes;

/// Maximum length of a payload that is copied next to its neighbours.
const COPIED: usize = 4096;

/// The frames of some messages, one after the other.
#[derive(Debug, Default)]
pub(crate) struct Frames {
    /// Complete pieces.
    pieces: Vec<Bytes>,
    /// The piece under construction.
    growing: Vec<u8>,
}

impl Frames {
    /// Reserves room in one allocation for this many copied bytes.
    pub(crate) fn reserve(&mut self, bytes: usize) {
        self.growing.reserve_exact(bytes);
    }

    /// Adds a copy of `bytes`.
    pub(crate) fn copy(&mut self, bytes: &[u8]) {
        self.growing.extend_from_slice(bytes);
    }

    /// Adds `payload`, by reference where it is long.
    pub(crate) fn share(&mut self, payload: &Bytes) {
        if payload.len() <= COPIED {
            return self.copy(payload);
        }
        self.close();
        self.pieces.push(payload.clone());
    }

    /// Calls `write`, which must append at most `most` bytes to its buffer. If `most` is large, the bytes get an
    /// allocation of their own. If `write` fails, nothing is added.
    pub(crate) fn append<E>(
        &mut self,
        most: usize,
        write: impl FnOnce(&mut Vec<u8>) -> Result<(), E>,
    ) -> Result<(), E> {
        if most > COPIED {
            self.close();
            self.growing.reserve_exact(most);
        }
        let at = self.growing.len();
        let written = write(&mut self.growing);
        if written.is_err() {
            self.growing.truncate(at);
        }
        written
    }

    /// Takes all pieces.
    pub(crate) fn take(&mut self) -> Vec<Bytes> {
        self.close();
        std::mem::take(&mut self.pieces)
    }

    /// Returns the number of bytes since the last [`take`](Self::take).
    pub(crate) fn len(&self) -> usize {
        self.pieces.iter().map(Bytes::len).sum::<usize>() + self.growing.len()
    }

    fn close(&mut self) {
        if !self.growing.is_empty() {
            self.pieces.push(std::mem::take(&mut self.growing).into());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bytes(frames: &mut Frames) -> Vec<u8> {
        frames.take().concat()
    }

    #[test]
    fn frames_keep_their_order_and_long_pieces_are_not_copied() {
        let mut frames = Frames::default();
        let long = Bytes::from(vec![7; COPIED + 1]);
        frames.copy(b"ab");
        frames.share(&Bytes::from_static(b"cd"));
        frames.share(&long);
        frames.copy(b"ef");
        let pieces = frames.take();
        assert_eq!(pieces.len(), 3, "{pieces:?}");
        assert_eq!((&pieces[0][..], &pieces[2][..]), (&b"abcd"[..], &b"ef"[..]));
        assert_eq!(pieces[1].as_ptr(), long.as_ptr());
        assert!(frames.take().is_empty());
    }

    #[test]
    fn a_failed_append_leaves_no_bytes() {
        let mut frames = Frames::default();
        frames.copy(b"a");
        for most in [4, COPIED + 4] {
            let fails = |out: &mut Vec<u8>| {
                out.extend_from_slice(b"xy");
                Err("no")
            };
            assert_eq!(frames.append(most, fails), Err("no"));
            let write = |out: &mut Vec<u8>| {
                out.extend_from_slice(b"bc");
                Ok::<_, &str>(())
            };
            assert_eq!(frames.append(most, write), Ok(()));
        }
        frames.copy(b"d");
        assert_eq!(bytes(&mut frames), b"abcbcd");
    }
}
