//! Who is alive, where nobody publishes: in time for the shortest lease, those who said so.

use std::{
    collections::BTreeMap,
    time::{Duration, Instant},
};

use crate::{
    ids::Gid,
    session::message::{Asserted, Message},
};

/// The shortest time between two looks.
const SHORTEST: Duration = Duration::from_millis(5);
/// Publishers in one packet.
const PART: usize = 1024;

/// What one end tells the other of its publishers' leases.
#[derive(Default)]
pub(super) struct Alive {
    every: Option<Duration>,
    looked: Option<Instant>,
    told: BTreeMap<Gid, u64>,
}

impl Alive {
    /// These are the leases of the publishers whose samples cross, in nanoseconds.
    pub(super) fn watch(&mut self, leases: impl Iterator<Item = u64>) {
        self.every = leases.min().map(|least| (Duration::from_nanos(least) / 4).max(SHORTEST));
    }

    /// How long it is until the next look; `None` when nobody has a lease.
    pub(super) fn left(&self) -> Option<Duration> {
        let every = self.every?;
        Some(self.looked.map_or(Duration::ZERO, |looked| every.saturating_sub(looked.elapsed())))
    }

    /// If it is time: tells of those that have been alive since it was last told. `now` has when each was.
    pub(super) fn news(&mut self, now: impl Iterator<Item = (Gid, u64)>) -> Vec<Message> {
        if self.left() != Some(Duration::ZERO) {
            return Vec::new();
        }
        self.looked = Some(Instant::now());
        let mut alive: BTreeMap<Gid, u64> = BTreeMap::new();
        for (gid, at) in now {
            let last = alive.entry(gid).or_default();
            *last = at.max(*last);
        }
        let news = alive.iter().filter(|(gid, at)| self.told.get(gid) != Some(at));
        let news: Vec<Gid> = news.map(|(gid, _)| *gid).collect();
        self.told = alive;
        let parts = news.chunks(PART).map(<[_]>::to_vec);
        parts.map(|publishers| Message::Asserted(Asserted { publishers })).collect()
    }
}
