//! Samples that identify themselves in each byte.

/// The length of the longest sample in bytes.
pub(crate) const LONGEST: usize = 25_000_000;
/// One of this many samples may be as long as that.
const RARITY: u64 = 50;

/// Pseudo-random numbers that follow from a seed (splitmix64).
pub(crate) struct Random(pub(crate) u64);

impl Random {
    pub(crate) fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    pub(crate) fn below(&mut self, bound: u64) -> u64 {
        self.next() % bound
    }

    /// Returns a length of 0 to 8 MiB, each power of two being equally likely, or now and then up
    /// to [`LONGEST`].
    pub(crate) fn length(&mut self) -> usize {
        let power = self.below(25);
        let most = match power {
            _ if self.below(RARITY) == 0 => LONGEST as u64,
            24 => 0,
            _ => 1 << power,
        };
        usize::try_from(self.below(most + 1)).expect("at most some million")
    }
}

/// Returns the word at `index` of the pattern of sample `sequence`, for the publisher whose GID
/// begins with `publisher`.
fn word(publisher: u64, sequence: u64, index: u64) -> u64 {
    (publisher ^ sequence.rotate_left(32)).wrapping_add(index.wrapping_mul(0x9e37_79b9_7f4a_7c15))
}

pub(crate) fn fill(publisher: u64, sequence: u64, out: &mut [u8]) {
    let (words, rest) = out.as_chunks_mut::<8>();
    let last = word(publisher, sequence, words.len() as u64).to_le_bytes();
    rest.copy_from_slice(&last[..rest.len()]);
    for (index, chunk) in (0..).zip(words) {
        *chunk = word(publisher, sequence, index).to_le_bytes();
    }
}

/// Returns whether `bytes`, from byte `at` of the sample on, match its pattern. `at` is a multiple
/// of 8.
pub(crate) fn is_whole(publisher: u64, sequence: u64, at: usize, bytes: &[u8]) -> bool {
    let (words, rest) = bytes.as_chunks::<8>();
    let first = at as u64 / 8;
    let expected = |index: usize| word(publisher, sequence, first + index as u64);
    let whole = |(index, chunk): (usize, &[u8; 8])| u64::from_le_bytes(*chunk) == expected(index);
    words.iter().enumerate().all(whole)
        && *rest == expected(words.len()).to_le_bytes()[..rest.len()]
}
