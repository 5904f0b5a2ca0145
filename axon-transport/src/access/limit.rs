//! `[[limit]]`: how much a party may send here and get from here.

use std::{fmt, num::NonZeroU32, sync::Arc};

use super::{Principal, TopicPattern, Verb, party::PartyPattern, pattern::segment_fits};

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
    pub overflow: Overflow,
    /// Whether all topics together may have so much. Else each may.
    pub together: bool,
}

/// The policy for samples beyond a limit.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Overflow {
    /// The newest waits until it may pass. It replaces the one that waited before.
    #[default]
    DropOldest,
    /// They are dropped as they come.
    DropNewest,
    /// They wait for their turn. A KEEP_ALL publisher waits with them; of a KEEP_LAST publisher those within its depth
    /// wait.
    Hold,
}

impl Overflow {
    /// All policies.
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
        Self {
            rate: Some(rate),
            bytes: None,
            burst,
            overflow: Overflow::DropOldest,
            together: false,
        }
    }
}

impl fmt::Display for RateLimit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(rate) = self.rate {
            write!(f, "{rate} a second")?;
        }
        if let Some(bytes) = self.bytes {
            let comma = if self.rate.is_some() { ", " } else { "" };
            write!(f, "{comma}{}", bytes_text(bytes))?;
        }
        if self.rate.is_some() && self.burst > NonZeroU32::MIN {
            write!(f, ", {} at once", self.burst)?;
        }
        write!(f, ", {}", self.overflow.name())?;
        if self.together { f.write_str(", all topics together") } else { Ok(()) }
    }
}

/// So many bytes a second, with a unit.
fn bytes_text(bytes: f64) -> String {
    match bytes {
        b if b >= 1e6 => format!("{} MB/s", b / 1e6),
        b if b >= 1e3 => format!("{} kB/s", b / 1e3),
        b => format!("{b} B/s"),
    }
}

impl fmt::Display for EgressLimit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&bytes_text(self.bytes))
    }
}

/// One `[[limit]]`.
#[derive(Debug)]
pub(super) struct LimitRule {
    pub(super) peers: Vec<PartyPattern>,
    pub(super) limits: LimitKind,
}

/// What a `[[limit]]` limits.
#[derive(Debug)]
pub(super) enum LimitKind {
    /// What the party does, with which topics and services.
    Uses(Vec<(Verb, TopicPattern)>, PlacedLimit),
    /// All that is sent to it.
    Egress(EgressLimit),
}

/// A `[[limit]]` of network interfaces: each interface that it names may send so much.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct InterfaceLimit {
    /// The interfaces, in whose names `*` stands for any characters.
    pub interfaces: Vec<String>,
    /// What leaves by each of them, for all peers together.
    pub limit: EgressLimit,
}

impl InterfaceLimit {
    /// Whether it names this interface.
    pub fn names(&self, interface: &str) -> bool {
        self.interfaces.iter().any(|pattern| segment_fits(pattern, interface))
    }
}

/// The bytes a second that leave this host for a party, or by an interface.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct EgressLimit {
    /// Bytes a second, with the headers of IP and UDP.
    pub bytes: f64,
    /// The file, as decisions name it.
    pub file: Arc<str>,
    /// The line of the file.
    pub line: u32,
}

/// A limit, and where it is written.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct PlacedLimit {
    /// What it lets pass.
    pub limit: RateLimit,
    /// The topics and services of the entry as written there, in alphabetical order; `**` where it names none.
    pub names: Arc<str>,
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
    pub(super) fn names(&self, party: Principal<'_>) -> bool {
        self.peers.iter().any(|peer| peer.fits(party))
    }

    /// The limit, if it is on this use.
    pub(super) fn of(&self, verb: Verb, name: &str) -> Option<&PlacedLimit> {
        let LimitKind::Uses(uses, limit) = &self.limits else { return None };
        let fits = uses.iter().any(|(used, pattern)| *used == verb && pattern.fits(name));
        fits.then_some(limit)
    }

    /// The limit, if it is on all that is sent.
    pub(super) fn egress(&self) -> Option<&EgressLimit> {
        match &self.limits {
            LimitKind::Egress(limit) => Some(limit),
            LimitKind::Uses(..) => None,
        }
    }

    /// How decisions name the file.
    pub(super) fn file(&self) -> &str {
        match &self.limits {
            LimitKind::Uses(_, limit) => &limit.file,
            LimitKind::Egress(limit) => &limit.file,
        }
    }
}
