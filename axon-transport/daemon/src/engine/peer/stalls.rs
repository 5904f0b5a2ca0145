//! Remembers peers that asked for a topic and stopped reading it, and how long they wait before they are
//! served again. Plain data in, data out.

use std::{
    collections::HashMap,
    time::{Duration, Instant},
};

use super::routes::RouteKey;

/// The longest wait.
const LONGEST: Duration = Duration::from_secs(320);
/// A peer that read for so long is as good as any.
const FORGIVEN: Duration = Duration::from_secs(600);
/// Stalls that are remembered, of all peers.
const REMEMBERED: usize = 4096;

/// What is known of peers that stalled, by who they proved to be, so that a new link or daemon id is no
/// way around it.
#[derive(Debug, Default)]
pub(crate) struct Stalls(HashMap<(String, RouteKey), Stall>);

#[derive(Debug)]
struct Stall {
    wait: Duration,
    until: Instant,
}

impl Stalls {
    /// A peer was disconnected from a topic after it read nothing for `limit`. How long it waits.
    pub(crate) fn add(
        &mut self,
        who: &str,
        key: &RouteKey,
        limit: Duration,
        now: Instant,
    ) -> Duration {
        self.0.retain(|_, stall| now < stall.until + FORGIVEN);
        let limit = limit.max(Duration::from_secs(1));
        let place = (who.to_owned(), key.clone());
        let wait =
            self.0.get(&place).map_or(limit, |stall| (stall.wait * 2).min(LONGEST.max(limit)));
        if self.0.len() >= REMEMBERED && !self.0.contains_key(&place) {
            let first = self.0.iter().min_by_key(|(_, stall)| stall.until);
            let first = first.map(|(place, _)| place.clone());
            first.map(|place| self.0.remove(&place));
        }
        self.0.insert(place, Stall { wait, until: now + wait });
        wait
    }

    /// How long this peer is not served this yet.
    pub(crate) fn left(&self, who: &str, key: &RouteKey, now: Instant) -> Option<Duration> {
        let stall = self.0.get(&(who.to_owned(), key.clone()))?;
        Some(stall.until.saturating_duration_since(now)).filter(|left| !left.is_zero())
    }
}

#[cfg(test)]
mod tests {
    use axon_envelope::Kind;

    use super::*;

    fn key(number: usize) -> RouteKey {
        RouteKey { kind: Kind::Topic, topic: format!("/{number}"), type_name: "T".into() }
    }

    #[test]
    fn a_peer_that_stalls_again_waits_twice_as_long_up_to_a_limit_and_is_forgiven() {
        let (mut stalls, ten) = (Stalls::default(), Duration::from_secs(10));
        let (mut now, mut waits) = (Instant::now(), Vec::new());
        for _ in 0..7 {
            let wait = stalls.add("pin arm", &key(0), ten, now);
            assert_eq!(stalls.left("pin arm", &key(0), now), Some(wait));
            assert_eq!(stalls.left("pin arm", &key(1), now), None);
            assert_eq!(stalls.left("pin leg", &key(0), now), None);
            now += wait;
            assert_eq!(stalls.left("pin arm", &key(0), now), None);
            waits.push(wait.as_secs());
        }
        assert_eq!(waits, [10, 20, 40, 80, 160, 320, 320]);
        now += FORGIVEN;
        assert_eq!(stalls.add("pin arm", &key(0), ten, now), ten);
    }

    #[test]
    fn what_is_remembered_is_bounded() {
        let (mut stalls, now) = (Stalls::default(), Instant::now());
        for number in 0..REMEMBERED + 10 {
            stalls.add("pin arm", &key(number), Duration::from_secs(10), now);
        }
        assert_eq!(stalls.0.len(), REMEMBERED);
    }
}
