//! `[[limit]]`: how much a party may send here and get from here.

use std::{fmt, num::NonZeroU32, sync::Arc};

use super::{Party, TopicPattern, Verb, party::PartyPattern};

/// The samples that a limit lets pass. The time of a sample is that at which this host's daemon has it.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct RateLimit {
    /// Samples, or requests, a second.
    pub rate: Option<f64>,
    /// Bytes of their payload a second.
    pub bytes: Option<f64>,
    /// How many may pass at once after a pause.
    pub burst: NonZeroU32,
    /// What becomes of the others.
    pub over: Over,
    /// Whether all topics together may have so much. Else each may.
    pub together: bool,
}

/// What becomes of samples beyond a limit.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Over {
    /// The newest waits until it may pass. It replaces the one that waited before.
    #[default]
    DropOldest,
    /// They are dropped as they come.
    DropNewest,
    /// They wait for their turn. A KEEP_ALL publisher waits with them; of a KEEP_LAST publisher those within its depth
    /// wait.
    Hold,
}

impl Over {
    /// Each of them.
    pub const ALL: [Self; 3] = [Self::DropOldest, Self::DropNewest, Self::Hold];

    /// As rules spell it.
    pub const fn name(self) -> &'static str {
        match self {
            Self::DropOldest => "drop-oldest",
            Self::DropNewest => "drop-newest",
            Self::Hold => "hold",
        }
    }
}

impl RateLimit {
    /// So many samples a second of each topic, of which the newest waits for its turn.
    pub(crate) fn of_rate(rate: f64) -> Self {
        let burst = NonZeroU32::MIN;
        Self { rate: Some(rate), bytes: None, burst, over: Over::DropOldest, together: false }
    }
}

impl fmt::Display for RateLimit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(rate) = self.rate {
            write!(f, "{rate} a second")?;
        }
        if let Some(bytes) = self.bytes {
            let comma = if self.rate.is_some() { ", " } else { "" };
            let (bytes, unit) = match bytes {
                b if b >= 1e6 => (b / 1e6, "MB"),
                b if b >= 1e3 => (b / 1e3, "kB"),
                b => (b, "B"),
            };
            write!(f, "{comma}{bytes} {unit}/s")?;
        }
        if self.burst > NonZeroU32::MIN {
            write!(f, ", {} at once", self.burst)?;
        }
        write!(f, ", {}", self.over.name())?;
        if self.together { f.write_str(", all topics together") } else { Ok(()) }
    }
}

/// One `[[limit]]`.
#[derive(Debug)]
pub(super) struct LimitRule {
    pub(super) peers: Vec<PartyPattern>,
    /// What the party does that is limited, and with which topics and services.
    pub(super) uses: Vec<(Verb, TopicPattern)>,
    pub(super) limit: PlacedLimit,
}

/// A limit, and where it is written.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct PlacedLimit {
    /// What it lets pass.
    pub limit: RateLimit,
    /// The file, as decisions name it.
    pub file: Arc<str>,
    /// The line of the file.
    pub line: u32,
}

impl fmt::Display for PlacedLimit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "line {} of {}: {}", self.line, self.file, self.limit)
    }
}

impl LimitRule {
    pub(super) fn names(&self, party: Party<'_>) -> bool {
        self.peers.iter().any(|peer| peer.fits(party))
    }

    pub(super) fn fits(&self, verb: Verb, name: &str) -> bool {
        self.uses.iter().any(|(used, pattern)| *used == verb && pattern.fits(name))
    }
}
