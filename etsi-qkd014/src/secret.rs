//! A byte buffer that never leaves a copy behind, neither when it grows nor when it is dropped.

use std::io::{self, Read};

use secrecy::SecretSlice;
use zeroize::Zeroizing;

pub(crate) struct SecretBuf {
    bytes: Vec<u8>,
    limit: usize,
}

/// The buffer would exceed its limit.
#[derive(Debug)]
pub(crate) struct LimitExceeded;

impl SecretBuf {
    /// Creates a buffer that allocates `expected` bytes at once. The sender may have lied about
    /// them, so they are only a hint within the limit.
    pub(crate) fn new(expected: usize, limit: usize) -> Self {
        Self { bytes: Vec::with_capacity(expected.min(limit).min(64 << 10)), limit }
    }

    /// Reads everything from `source`; `None` if that is more than `limit` bytes.
    pub(crate) fn read_from(mut source: impl Read, limit: usize) -> io::Result<Option<Self>> {
        let mut content = Self::new(0, limit);
        let mut part = Zeroizing::new([0; 4096]);
        loop {
            match source.read(&mut part[..]) {
                Ok(0) => return Ok(Some(content)),
                Ok(length) if content.extend(&part[..length]).is_err() => return Ok(None),
                Ok(_) => {}
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error),
            }
        }
    }

    /// Returns the bytes in a block of exactly their size: `SecretSlice::from(Vec)` would have the
    /// allocator shrink the block, which may leave a copy behind.
    pub(crate) fn into_secret(self) -> SecretSlice<u8> {
        Box::<[u8]>::from(&self.bytes[..]).into()
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
            wipe(&mut self.bytes);
            self.bytes = grown;
        }
        self.bytes.extend_from_slice(more);
        Ok(())
    }
}

impl Drop for SecretBuf {
    fn drop(&mut self) {
        // Nothing was ever written beyond the length.
        wipe(&mut self.bytes);
    }
}

/// Zeroizes many bytes at once; `Zeroize` would go byte by byte. The barrier keeps the compiler
/// from removing it.
pub(crate) fn wipe(bytes: &mut [u8]) {
    bytes.fill(0);
    zeroize::optimization_barrier(bytes);
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
    fn the_buffer_refuses_bytes_beyond_its_limit() {
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
