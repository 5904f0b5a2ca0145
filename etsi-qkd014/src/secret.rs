//! A byte buffer that never leaves a copy behind: not when it grows, not when it is dropped.

use zeroize::{Zeroize, Zeroizing};

pub(crate) struct SecretBuf {
    bytes: Zeroizing<Vec<u8>>,
    limit: usize,
}

/// The buffer would exceed its limit.
#[derive(Debug)]
pub(crate) struct LimitExceeded;

impl SecretBuf {
    /// `expected` bytes are allocated at once, which the sender may have lied about: it is taken
    /// as a hint within the limit.
    pub(crate) fn new(expected: usize, limit: usize) -> Self {
        Self { bytes: Zeroizing::new(Vec::with_capacity(expected.min(limit).min(64 << 10))), limit }
    }

    pub(crate) fn extend(&mut self, more: &[u8]) -> Result<(), LimitExceeded> {
        let len = self.bytes.len().checked_add(more.len()).ok_or(LimitExceeded)?;
        if len > self.limit {
            return Err(LimitExceeded);
        }
        if len > self.bytes.capacity() {
            // `Vec` would grow by itself, and free the old block with the secret in it.
            let mut grown = Vec::with_capacity((len * 2).min(self.limit).max(len));
            grown.extend_from_slice(&self.bytes);
            self.bytes.zeroize();
            self.bytes = Zeroizing::new(grown);
        }
        self.bytes.extend_from_slice(more);
        Ok(())
    }
}

impl std::ops::Deref for SecretBuf {
    type Target = [u8];
    fn deref(&self) -> &[u8] {
        &self.bytes
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_refuses_what_exceeds_the_limit() {
        let mut buf = SecretBuf::new(usize::MAX, 10);
        assert!(buf.extend(&[1; 11]).is_err());
        buf.extend(&[1; 10]).unwrap();
        assert!(buf.extend(&[1]).is_err());
        assert_eq!(&*buf, &[1; 10]);
    }

    #[test]
    fn it_grows_to_the_limit_exactly() {
        let mut buf = SecretBuf::new(0, 1000);
        for i in 0..1000 {
            buf.extend(&[i as u8]).unwrap();
        }
        assert_eq!(buf.len(), 1000);
        assert!(buf.iter().enumerate().all(|(i, b)| *b == i as u8));
    }
}
