//! Reads chunked request bodies (RFC 9112, 7.1).

use std::ops::Range;

use tokio::io::{AsyncRead, AsyncReadExt};

use super::http::{MAX_BODY, MAX_HEAD, NoRequest, TOO_LARGE};

/// Longest line with a chunk's length and extensions, in bytes.
const MAX_LINE: usize = 256;

const MALFORMED: NoRequest = NoRequest::Refused(400, "the body's chunks cannot be read");

/// Reads a body and its trailer, which begin at `at` of `buffer`. Returns the body, and the index in `buffer` behind
/// it. Ignores extensions and the trailer.
///
/// # Errors
/// The body is too large, its chunks are ambiguous, or the client is gone.
pub(super) async fn read<S: AsyncRead + Unpin>(
    stream: &mut S,
    buffer: &mut Vec<u8>,
    at: usize,
) -> Result<(Vec<u8>, usize), NoRequest> {
    let mut input = Input { stream, buffer, at };
    let mut body = Vec::new();
    loop {
        let line = input.line(MAX_LINE).await?.ok_or(MALFORMED)?;
        let size = size(&input.buffer[line]).ok_or(MALFORMED)?;
        if size > (MAX_BODY - body.len()) as u64 {
            return Err(TOO_LARGE);
        }
        let size = size as usize;
        if size == 0 {
            break;
        }
        let chunk = input.bytes(size + 2).await?;
        let (data, end) = input.buffer[chunk].split_at(size);
        if end != b"\r\n" {
            return Err(MALFORMED);
        }
        body.extend_from_slice(data);
    }
    let mut trailer = 0;
    loop {
        let line = match MAX_HEAD.checked_sub(trailer) {
            Some(left) => input.line(left).await?,
            None => None,
        };
        let line = line.ok_or(NoRequest::Refused(431, "the trailer is larger than 16 KiB"))?;
        if line.is_empty() {
            return Ok((body, input.at));
        }
        trailer += line.len() + 2;
    }
}

/// The bytes from a client. Bytes that were read are removed from the buffer before more are added.
struct Input<'a, S> {
    stream: &'a mut S,
    buffer: &'a mut Vec<u8>,
    at: usize,
}

impl<S: AsyncRead + Unpin> Input<'_, S> {
    async fn more(&mut self) -> Result<(), NoRequest> {
        self.buffer.drain(..self.at);
        self.at = 0;
        match self.stream.read_buf(self.buffer).await {
            Ok(1..) => Ok(()),
            _ => Err(NoRequest::Closed),
        }
    }

    /// Returns the range of the next `count` bytes.
    async fn bytes(&mut self, count: usize) -> Result<Range<usize>, NoRequest> {
        while self.buffer.len() - self.at < count {
            self.more().await?;
        }
        let from = self.at;
        self.at += count;
        Ok(from..self.at)
    }

    /// Returns the range of the next line without its end; `None` if it is longer than `longest` bytes.
    async fn line(&mut self, longest: usize) -> Result<Option<Range<usize>>, NoRequest> {
        loop {
            let rest = &self.buffer[self.at..];
            let within = &rest[..rest.len().min(longest + 2)];
            if let Some(length) = within.windows(2).position(|pair| pair == b"\r\n") {
                let from = self.at;
                self.at += length + 2;
                return Ok(Some(from..from + length));
            }
            if within.len() == longest + 2 {
                return Ok(None);
            }
            self.more().await?;
        }
    }
}

/// Returns the length of a chunk from its line; `None` if another reader of the same bytes could see another length.
fn size(line: &[u8]) -> Option<u64> {
    let digits = line.iter().take_while(|byte| byte.is_ascii_hexdigit()).count();
    let (number, rest) = line.split_at(digits);
    let is_extension = rest.trim_ascii_start().first().is_none_or(|byte| *byte == b';');
    if !is_extension || rest.iter().any(|byte| byte.is_ascii_control() && *byte != b'\t') {
        return None;
    }
    // The parser reports too many digits as an error.
    u64::from_str_radix(str::from_utf8(number).ok()?, 16).ok()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn the_length_of_a_chunk_is_hexadecimal_and_nothing_else() {
        for (line, wanted) in [("0", 0), ("aF", 175), ("010", 16), ("2;a", 2), ("2 ;a=\"b\"", 2)] {
            assert_eq!(size(line.as_bytes()), Some(wanted), "{line}");
        }
        for line in
            ["", ";a", "+1", "-1", "0x1", " 1", "1 1", "1\n", "1;\r", "1g", "10000000000000000"]
        {
            assert_eq!(size(line.as_bytes()), None, "{line:?}");
        }
    }

    proptest! {
        #[test]
        fn any_body_is_read_without_panic(bytes: Vec<u8>, before: u8) {
            let before = usize::from(before);
            let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
            let mut buffer = vec![b'x'; before];
            let _ = runtime.block_on(read(&mut &bytes[..], &mut buffer, before));
        }

        #[test]
        fn a_body_in_any_chunks_is_the_same_body(pieces: Vec<Vec<u8>>, behind: Vec<u8>) {
            let mut bytes = Vec::new();
            for piece in pieces.iter().filter(|piece| !piece.is_empty()) {
                bytes.extend(format!("{:x}\r\n", piece.len()).bytes());
                bytes.extend_from_slice(piece);
                bytes.extend(b"\r\n");
            }
            bytes.extend(b"0\r\n\r\n");
            bytes.extend_from_slice(&behind);
            let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
            let (mut stream, mut buffer) = (&bytes[..], Vec::new());
            let read = runtime.block_on(read(&mut stream, &mut buffer, 0));
            let Ok((body, at)) = read else { panic!("refused") };
            prop_assert_eq!(body, pieces.concat());
            buffer.drain(..at);
            buffer.extend_from_slice(stream);
            prop_assert_eq!(buffer, behind);
        }
    }
}
