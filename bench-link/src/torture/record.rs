//! When which daemon was killed, and what the path was like: what may explain a loss.

use crate::path::Settings;

pub(super) const SECOND: u64 = 1_000_000_000;

pub(super) struct DaemonKill {
    pub(super) host: usize,
    pub(super) at: u64,
    /// The path was left alone before and after, and no other daemon was killed later or earlier.
    pub(super) calm: bool,
}

/// Times are nanoseconds of the monotonic clock.
#[derive(Default)]
pub(super) struct Record {
    pub(super) kills: Vec<DaemonKill>,
    /// From when on the path was so.
    pub(super) paths: Vec<(u64, Settings)>,
}

impl Record {
    /// Whether a daemon was killed in this time.
    pub(super) fn has_kill(&self, from: u64, to: u64) -> bool {
        self.kills.iter().any(|kill| (from..=to).contains(&kill.at))
    }

    /// Whether the daemon of this host was killed in this time.
    pub(super) fn has_kill_on(&self, host: usize, from: u64, to: u64) -> bool {
        self.kills.iter().any(|kill| kill.host == host && (from..=to).contains(&kill.at))
    }

    /// Whether a daemon was killed in this time over a path that was not left alone.
    pub(super) fn has_rough_kill(&self, from: u64, to: u64) -> bool {
        self.kills.iter().any(|kill| !kill.calm && (from..=to).contains(&kill.at))
    }

    /// Whether the path was cut or poor at any moment of this time.
    pub(super) fn was_poor(&self, from: u64, to: u64) -> bool {
        let ends = self.paths.iter().skip(1).map(|(at, _)| *at).chain([u64::MAX]);
        let mut all = self.paths.iter().zip(ends);
        all.any(|((begin, path), end)| {
            let is_poor = path.is_cut || path.loss.share > 0.02 || path.rate < 20e6;
            is_poor && *begin <= to && end >= from
        })
    }
}
