//! Payloads that both ends know: a function of the sequence number.

use std::str::FromStr;

/// The lengths of the samples of a stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sizes {
    /// Zero bytes to 300 KB: samples inline, in the ring, in one packet, and in many.
    Mixed,
    /// Some hundred bytes.
    Small,
}

const MIXED: [usize; 12] = [0, 1, 95, 96, 97, 1_100, 1_500, 4_096, 20_000, 65_535, 65_536, 300_000];

impl Sizes {
    /// Returns the name that a test process takes as argument.
    pub fn name(self) -> &'static str {
        match self {
            Self::Mixed => "mixed",
            Self::Small => "small",
        }
    }
}

impl FromStr for Sizes {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        [Self::Mixed, Self::Small]
            .into_iter()
            .find(|sizes| sizes.name() == name)
            .ok_or_else(|| format!("no such sizes: {name}"))
    }
}

/// Fills `out` with the payload of the sample `sequence`, which is unlike every other's.
pub fn payload(sizes: Sizes, sequence: u64, out: &mut Vec<u8>) {
    let length = match sizes {
        Sizes::Mixed => MIXED[(sequence % 12) as usize],
        Sizes::Small => 8 + (sequence % 400) as usize,
    };
    out.clear();
    out.reserve(length + 8);
    let mut state = sequence.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    while out.len() < length {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        out.extend_from_slice(&state.to_le_bytes());
    }
    out.truncate(length);
}
