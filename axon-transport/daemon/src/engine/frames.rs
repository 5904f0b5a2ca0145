//! Collects the buffers of one write to a stream: short messages are copied together, long payloads are not
//! copied.

use bytes::Bytes;

/// Up to here a payload is copied to its neighbours.
const COPIED: usize = 4096;

/// The frames of some messages, one after the other.
#[derive(Debug, Default)]
pub(crate) struct Frames {
    /// Complete pieces.
    pieces: Vec<Bytes>,
    /// The piece that grows.
    growing: Vec<u8>,
}

impl Frames {
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

    /// Adds what `write` makes of so many zeros at most: as many bytes of their front as it says. If it
    /// fails, nothing.
    pub(crate) fn fill<E>(
        &mut self,
        most: usize,
        write: impl FnOnce(&mut [u8]) -> Result<usize, E>,
    ) -> Result<(), E> {
        if most > COPIED {
            self.close();
        }
        let at = self.growing.len();
        if at == 0 && most > self.growing.capacity() {
            // Zeroed memory is what the allocator may have anyway.
            self.growing = vec![0; most];
        } else {
            self.growing.resize(at + most, 0);
        }
        let written = write(&mut self.growing[at..]);
        self.growing.truncate(at + written.as_ref().copied().unwrap_or(0));
        written.map(drop)
    }

    /// Takes what there is.
    pub(crate) fn take(&mut self) -> Vec<Bytes> {
        self.close();
        std::mem::take(&mut self.pieces)
    }

    /// Bytes since the last [`take`](Self::take).
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
    fn everything_is_there_in_order_and_what_is_long_is_not_copied() {
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
    fn what_fails_leaves_nothing_and_what_is_shorter_than_announced_no_gap() {
        let mut frames = Frames::default();
        frames.copy(b"a");
        for most in [4, COPIED + 4] {
            assert_eq!(frames.fill(most, |_| Err("no")), Err("no"));
            let write = |out: &mut [u8]| {
                assert!(out.len() == most && out.iter().all(|byte| *byte == 0));
                out[..2].copy_from_slice(b"bc");
                Ok::<_, &str>(2)
            };
            assert_eq!(frames.fill(most, write), Ok(()));
        }
        frames.copy(b"d");
        assert_eq!(bytes(&mut frames), b"abcbcd");
    }
}
