//! `[[limit]]`: limits on the data that a party sends to or receives from this host, or that leaves by an interface.

use std::{fmt, num::NonZeroU32, sync::Arc};

use super::{Principal, TopicPattern, Verb, party::PartyPattern, pattern::segment_fits};

/// A limit on the rate of samples. The time of a sample is the time at which this host's daemon has it.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct RateLimit {
    /// Samples or requests per second.
    pub rate: Option<f64>,
    /// Bytes of their payload per second.
    pub bytes: Option<f64>,
    /// Maximum number of samples that may pass at once after a pause.
    pub burst: NonZeroU32,
    /// The policy for the samples beyond the limit.
    pub overflow: Overflow,
    /// True if the limit applies to all topics together; false if it applies to each topic.
    pub together: bool,
}

/// The policy for samples beyond a limit.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Overflow {
    /// The newest sample waits until it may pass. It replaces the sample that waited before.
    #[default]
    DropOldest,
    /// Samples are dropped on arrival.
    DropNewest,
    /// Samples wait for their turn. A KEEP_ALL publisher waits with them. For a KEEP_LAST publisher, only the samples
    /// within its history depth wait.
    Hold,
}

impl Overflow {
    /// All policies.
    pub const ALL: [Self; 3] = [Self::DropOldest, Self::DropNewest, Self::Hold];

    /// Returns the name in rules.
    pub const fn name(self) -> &'static str {
        match self {
            Self::DropOldest => "drop-oldest",
            Self::DropNewest => "drop-newest",
            Self::Hold => "hold",
        }
    }
}

impl RateLimit {
    /// Creates a limit of `rate` samples per second for each topic. The newest sample waits for its turn.
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

/// Returns a number of bytes per second as text with a unit.
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

/// The subject of a `[[limit]]`.
#[derive(Debug)]
pub(super) enum LimitKind {
    /// Actions of the party on topics and services.
    Uses(Vec<(Verb, TopicPattern)>, PlacedLimit),
    /// All output to the party.
    Egress(EgressLimit),
}

/// A `[[limit]]` of network interfaces. It limits each interface that it names.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct InterfaceLimit {
    /// The interfaces. A `*` in a name stands for any characters.
    pub interfaces: Vec<String>,
    /// Limit on the output of each interface, for all peers together.
    pub limit: EgressLimit,
}

impl InterfaceLimit {
    /// Returns whether the limit names this interface.
    pub fn names(&self, interface: &str) -> bool {
        self.interfaces.iter().any(|pattern| segment_fits(pattern, interface))
    }
}

/// A limit on the output of this host to a party, or by an interface.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct EgressLimit {
    /// Bytes per second, including the headers of IP and UDP.
    pub bytes: f64,
    /// The name of the file in decisions.
    pub file: Arc<str>,
    /// The line in the file.
    pub line: u32,
}

/// A limit and its place in a file.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct PlacedLimit {
    /// The limit.
    pub limit: RateLimit,
    /// The topics and services of the entry as written there, in alphabetical order; `**` if it names none.
    pub names: Arc<str>,
    /// The name of the file in decisions.
    pub file: Arc<str>,
    /// The line in the file.
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

    /// Returns the limit if it applies to this use.
    pub(super) fn of(&self, verb: Verb, name: &str) -> Option<&PlacedLimit> {
        let LimitKind::Uses(uses, limit) = &self.limits else { return None };
        let fits = uses.iter().any(|(used, pattern)| *used == verb && pattern.fits(name));
        fits.then_some(limit)
    }

    /// Returns the limit if it applies to all output.
    pub(super) fn egress(&self) -> Option<&EgressLimit> {
        match &self.limits {
            LimitKind::Egress(limit) => Some(limit),
            LimitKind::Uses(..) => None,
        }
    }

    /// Returns the name of the file in decisions.
    pub(super) fn file(&self) -> &str {
        match &self.limits {
            LimitKind::Uses(_, limit) => &limit.file,
            LimitKind::Egress(limit) => &limit.file,
        }
    }
}
