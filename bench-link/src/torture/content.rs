//! Messages whose every byte follows from their writer and their number.

/// Bytes before the pattern: number, time and length.
const HEADER: usize = 24;
/// The shortest message.
pub(super) const SHORTEST: usize = 64;

/// Fills a message. `key` stands for its writer.
pub(super) fn fill(bytes: &mut [u8], key: u64, number: u64, sent: u64) {
    let length = bytes.len() as u64;
    let (header, body) = bytes.split_at_mut(HEADER);
    for (word, value) in header.as_chunks_mut::<8>().0.iter_mut().zip([number, sent, length]) {
        *word = value.to_le_bytes();
    }
    let (words, rest) = body.as_chunks_mut::<8>();
    let mut pattern = Pattern::new(key, number);
    for chunk in words {
        *chunk = pattern.next().to_le_bytes();
    }
    let last = pattern.next().to_le_bytes();
    rest.copy_from_slice(&last[..rest.len()]);
}

/// Returns the time of a message, or the reason why it is not whole.
pub(super) fn check(bytes: &[u8], key: u64, number: u64) -> Result<u64, String> {
    let Some((header, body)) = bytes.split_at_checked(HEADER) else {
        return Err(format!("{} bytes", bytes.len()));
    };
    let word = |index: usize| u64::from_le_bytes(header.as_chunks::<8>().0[index]);
    if word(0) != number {
        return Err(format!("it carries the number {}", word(0)));
    }
    if word(2) != bytes.len() as u64 {
        return Err(format!("{} bytes of {}", bytes.len(), word(2)));
    }
    let (words, rest) = body.as_chunks::<8>();
    let mut pattern = Pattern::new(key, number);
    let wrong = words.iter().position(|chunk| *chunk != pattern.next().to_le_bytes());
    if let Some(at) = wrong {
        return Err(format!("its bytes are wrong from {} of {} on", HEADER + 8 * at, bytes.len()));
    }
    if *rest != pattern.next().to_le_bytes()[..rest.len()] {
        return Err("its last bytes are wrong".to_owned());
    }
    Ok(word(1))
}

/// A message of an even number is random, which no compressor shortens; one of an odd number repeats a word.
struct Pattern {
    state: u64,
    step: u64,
}

impl Pattern {
    fn new(key: u64, number: u64) -> Self {
        let step = if number.is_multiple_of(2) { 0x9e37_79b9_7f4a_7c15 } else { 0 };
        Self { state: key ^ number.rotate_left(32), step }
    }

    fn next(&mut self) -> u64 {
        self.state = self.state.wrapping_add(self.step);
        let z = (self.state ^ (self.state >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z ^ (z >> 27)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_altered_or_foreign_message_is_not_whole() {
        for number in [6, 7] {
            let mut bytes = vec![0; 101];
            fill(&mut bytes, 5, number, 9);
            assert_eq!(check(&bytes, 5, number), Ok(9));
            assert!(check(&bytes, 4, number).is_err());
            assert!(check(&bytes, 5, number + 1).is_err());
            assert!(check(&bytes[..100], 5, number).is_err());
            for at in [0, 17, 24, 60, 100] {
                let mut altered = bytes.clone();
                altered[at] ^= 1;
                assert!(check(&altered, 5, number).is_err(), "{at}");
            }
        }
    }
}
