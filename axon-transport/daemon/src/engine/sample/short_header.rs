//! The short header of a topic's sample: the part of an inner header that its data stream does not determine.
//!
//! The stream names the publisher. The number and the time are coded as differences from those of the stream's previous
//! sample. A header consists of three LEB128 numbers: the difference of the sequence numbers, the difference of the
//! source timestamps in zigzag coding, and the age in milliseconds. So most short headers take 4 to 7 bytes, where an
//! inner header takes 64.

/// The longest header: two numbers of 64 bits and one of 32.
const MAX_HEADER_BYTES: usize = 10 + 10 + 5;

/// The content of a short header.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct ShortHeader {
    pub(crate) sequence: u64,
    /// Nanoseconds since the Unix epoch.
    pub(crate) source_timestamp: i64,
    pub(crate) age_ms: u32,
}

/// The coder for the short headers of one stream, on either side. Each header depends on the one before; the state
/// begins with zeros.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct ShortHeaders {
    sequence: u64,
    source_timestamp: i64,
}

/// A header's bytes.
pub(crate) struct Encoded {
    bytes: [u8; MAX_HEADER_BYTES],
    length: usize,
}

impl Encoded {
    /// Returns the bytes.
    pub(crate) fn as_slice(&self) -> &[u8] {
        &self.bytes[..self.length]
    }

    fn put(&mut self, mut value: u64) {
        while value >= 0x80 {
            self.push(value as u8 | 0x80);
            value >>= 7;
        }
        self.push(value as u8);
    }

    fn push(&mut self, byte: u8) {
        self.bytes[self.length] = byte;
        self.length += 1;
    }
}

impl ShortHeaders {
    /// Writes the header of the next sample.
    pub(crate) fn write(&mut self, told: ShortHeader) -> Encoded {
        let mut encoded = Encoded { bytes: [0; MAX_HEADER_BYTES], length: 0 };
        // Differences wrap: a number or time of any value can follow any other.
        encoded.put(told.sequence.wrapping_sub(self.sequence));
        let later = told.source_timestamp.wrapping_sub(self.source_timestamp);
        encoded.put((later << 1 ^ later >> 63) as u64);
        encoded.put(told.age_ms.into());
        *self = Self { sequence: told.sequence, source_timestamp: told.source_timestamp };
        encoded
    }

    /// Reads the header of the next sample, and returns it and the payload behind it.
    ///
    /// # Errors
    /// The peer broke the format.
    pub(crate) fn read<'a>(
        &mut self,
        message: &'a [u8],
    ) -> Result<(ShortHeader, &'a [u8]), &'static str> {
        let mut rest = message;
        let sequence = self.sequence.wrapping_add(take(&mut rest)?);
        let later = take(&mut rest)?;
        let later = (later >> 1) as i64 ^ -((later & 1) as i64);
        let source_timestamp = self.source_timestamp.wrapping_add(later);
        let age_ms = take(&mut rest)?;
        let age_ms = u32::try_from(age_ms).map_err(|_| "a short header with too great an age")?;
        *self = Self { sequence, source_timestamp };
        Ok((ShortHeader { sequence, source_timestamp, age_ms }, rest))
    }
}

/// Takes a number in LEB128 from the front.
fn take(from: &mut &[u8]) -> Result<u64, &'static str> {
    let mut value = 0;
    for shift in (0..u64::BITS).step_by(7) {
        let Some((byte, rest)) = from.split_first() else { return Err("a cut short header") };
        *from = rest;
        let bits = u64::from(byte & 0x7f);
        // The tenth byte has room for one bit.
        if shift == 63 && *byte > 1 {
            break;
        }
        value |= bits << shift;
        if *byte < 0x80 {
            return Ok(value);
        }
    }
    Err("a short header with a number of more than 64 bits")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn told(sequence: u64, source_timestamp: i64, age_ms: u32) -> ShortHeader {
        ShortHeader { sequence, source_timestamp, age_ms }
    }

    #[test]
    fn any_header_comes_back_behind_any_other() {
        let numbers = [0, 1, 2, 127, 128, 1 << 40, u64::MAX - 1, u64::MAX];
        let times = [0, 1, -1, 1_700_000_000_123_456_789, i64::MIN, i64::MAX];
        let (mut writing, mut reading) = (ShortHeaders::default(), ShortHeaders::default());
        for (sequence, time) in numbers.into_iter().flat_map(|n| times.map(|time| (n, time))) {
            for age in [0, 127, 128, u32::MAX] {
                let header = writing.write(told(sequence, time, age));
                let message = [header.as_slice(), b"payload"].concat();
                let read = reading.read(&message).unwrap();
                assert_eq!(read, (told(sequence, time, age), &b"payload"[..]));
                assert_eq!(writing, reading);
            }
        }
    }

    #[test]
    fn headers_of_a_fast_publisher_are_short() {
        let mut headers = ShortHeaders::default();
        let now = 1_700_000_000_123_456_789;
        assert!(headers.write(told(1, now, 0)).as_slice().len() <= 12);
        assert_eq!(headers.write(told(2, now + 1000, 0)).as_slice().len(), 4);
        assert_eq!(headers.write(told(3, now + 10_001_000, 3)).as_slice().len(), 6);
    }

    #[test]
    fn malformed_short_headers_are_refused_and_change_no_state() {
        let nine = [0x80; 9];
        let cases: [&[u8]; 6] = [
            &[],
            &[1],
            &[1, 2],
            &[1, 0x80],
            // 2^64, and an age of 2^32.
            &[&nine[..], &[2, 0, 0]].concat(),
            &[1, 2, 0x80, 0x80, 0x80, 0x80, 0x10],
        ];
        for case in cases {
            let mut headers = ShortHeaders { sequence: 5, source_timestamp: 6 };
            headers.read(case).unwrap_err();
            assert_eq!(headers, ShortHeaders { sequence: 5, source_timestamp: 6 }, "{case:?}");
        }
    }
}
