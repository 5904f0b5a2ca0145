//! The history of peers that asked for a topic and stopped reading it, with the times that they must wait to be served
//! again. The module does no I/O.

use std::{collections::HashMap, rc::Rc, time::Duration};

use crate::engine::account::{Charge, Meter};
use crate::engine::route::RouteKey;

/// The longest wait.
const LONGEST: Duration = Duration::from_secs(320);
/// A stall is forgiven after this time, and this multiple of the limit, of reading without a stall. The
/// multiple is twice the longest time that a peer can hold up a publisher without being cut; otherwise waits
/// would not double.
const FORGIVEN: (Duration, u32) = (Duration::from_secs(600), 192);
/// Bytes that are remembered of all peers, and of one peer at most. Each peer gets half of the rest.
const ROOM: (usize, usize) = (8 << 20, 1 << 20);
/// Bytes that a stall counts in addition to its names.
const ENTRY: usize = 200;
/// The most peers that are remembered.
const PEERS: usize = 4096;
/// Shortest time between two removals of forgiven stalls.
const SWEEP: Duration = Duration::from_secs(1);

/// The stalls of all peers, by proven identity, so that a new link or daemon ID does not reset them.
#[derive(Debug)]
pub(crate) struct StallHistory {
    of: HashMap<String, PeerStalls>,
    room: Rc<Meter>,
    swept: Option<Duration>,
}

/// The stalls of one peer.
#[derive(Debug)]
struct PeerStalls {
    room: Rc<Meter>,
    routes: HashMap<RouteKey, (RouteStall, Charge)>,
    /// The stall of all routes for which there was no room. A peer gains nothing by stalling very many
    /// routes.
    others: Option<RouteStall>,
}

#[derive(Clone, Copy, Debug)]
struct RouteStall {
    wait: Duration,
    until: Duration,
    /// The time at which the stall is forgotten.
    forgiven: Duration,
}

impl RouteStall {
    /// Creates the stall that follows an earlier one.
    fn after(before: Option<Self>, limit: Duration, now: Duration) -> Self {
        let before = before.filter(|before| !before.is_forgiven(now));
        let wait = before.map_or(limit, |before| (before.wait * 2).min(LONGEST.max(limit)));
        let until = now + wait;
        Self { wait, until, forgiven: until + FORGIVEN.0.max(limit * FORGIVEN.1) }
    }

    fn is_forgiven(&self, now: Duration) -> bool {
        now >= self.forgiven
    }
}

impl PeerStalls {
    /// Returns the stall of a route.
    fn get(&self, key: &RouteKey) -> Option<RouteStall> {
        self.routes.get(key).map(|(stall, _)| *stall).or(self.others)
    }

    /// Returns when the last wait is over.
    fn until(&self) -> Option<Duration> {
        let routes = self.routes.values().map(|(stall, _)| stall);
        routes.chain(&self.others).map(|stall| stall.until).max()
    }
}

impl Default for StallHistory {
    fn default() -> Self {
        Self { of: HashMap::new(), room: Meter::new(ROOM.0), swept: None }
    }
}

impl StallHistory {
    /// Records that a peer was disconnected from a topic after it read nothing for `limit`. Returns how long
    /// the peer must wait.
    pub(crate) fn add(
        &mut self,
        who: &str,
        key: &RouteKey,
        limit: Duration,
        now: Duration,
    ) -> Duration {
        self.sweep(now);
        if self.of.len() >= PEERS && !self.of.contains_key(who) {
            let first = self.of.iter().min_by_key(|(_, of)| of.until());
            let first = first.map(|(who, _)| who.clone());
            first.map(|who| self.of.remove(&who));
        }
        let of = self.of.entry(who.to_owned()).or_insert_with(|| PeerStalls {
            room: Meter::within(&self.room, ROOM.1),
            routes: HashMap::new(),
            others: None,
        });
        let stall = RouteStall::after(of.get(key), limit.max(Duration::from_secs(1)), now);
        if let Some((known, _)) = of.routes.get_mut(key) {
            *known = stall;
        } else if let Some(charge) = of.room.charge(ENTRY + key.bytes()) {
            of.routes.insert(key.clone(), (stall, charge));
        } else {
            of.others = Some(stall);
        }
        stall.wait
    }

    /// Removes forgiven stalls.
    fn sweep(&mut self, now: Duration) {
        if self.swept.is_some_and(|swept| now < swept + SWEEP) {
            return;
        }
        self.swept = Some(now);
        self.of.retain(|_, of| {
            of.routes.retain(|_, (stall, _)| !stall.is_forgiven(now));
            of.others = of.others.filter(|others| !others.is_forgiven(now));
            of.until().is_some()
        });
    }

    /// Returns how long the peer must still wait for this route.
    pub(crate) fn left(&self, who: &str, key: &RouteKey, now: Duration) -> Option<Duration> {
        let stall = self.of.get(who)?.get(key)?;
        Some(stall.until.saturating_sub(now)).filter(|left| !left.is_zero())
    }
}

#[cfg(test)]
mod tests {
    use axon_envelope::Kind;

    use super::*;

    const NOW: Duration = Duration::from_secs(1000);

    fn key(number: usize) -> RouteKey {
        RouteKey { kind: Kind::Topic, topic: format!("/{number}"), type_name: "T".into() }
    }

    #[test]
    fn repeated_stall_doubles_the_pause_up_to_a_limit_and_expires() {
        let (mut stalls, ten) = (StallHistory::default(), Duration::from_secs(10));
        let (mut now, mut waits) = (NOW, Vec::new());
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
        now += ten * FORGIVEN.1;
        assert_eq!(stalls.add("pin arm", &key(0), ten, now), ten);
    }

    /// A peer that empties the key store is cut after 96 times the limit, each time.
    #[test]
    fn pause_grows_with_each_stall_of_full_length() {
        let (mut stalls, ten) = (StallHistory::default(), Duration::from_secs(10));
        let (mut now, mut waits) = (NOW, Vec::new());
        for _ in 0..7 {
            now += ten * 97;
            let wait = stalls.add("pin arm", &key(0), ten, now);
            now += wait;
            waits.push(wait.as_secs());
        }
        assert_eq!(waits, [10, 20, 40, 80, 160, 320, 320]);
    }

    #[test]
    fn stalls_on_many_topics_pause_all_routes_of_the_peer() {
        let (mut stalls, ten, now) = (StallHistory::default(), Duration::from_secs(10), NOW);
        stalls.add("pin leg", &key(0), ten, now);
        for number in 0..60_000 {
            stalls.add("pin arm", &key(number), ten, now);
        }
        assert!(stalls.room.held() <= ROOM.1 + ENTRY + 10, "{} bytes", stalls.room.held());
        for number in (0..70_000).step_by(1_000) {
            assert!(stalls.left("pin arm", &key(number), now).is_some(), "{number}");
        }
        assert_eq!(stalls.left("pin leg", &key(0), now), Some(ten));
        assert_eq!(stalls.left("pin leg", &key(1), now), None);
        stalls.add("pin leg", &key(1), ten, now);
        assert_eq!(stalls.left("pin leg", &key(1), now), Some(ten));
        assert_eq!(stalls.left("pin leg", &key(2), now), None);
        // After that time the peer counts like any other.
        let later = now + LONGEST + ten * FORGIVEN.1;
        stalls.add("pin tail", &key(0), ten, later);
        assert_eq!((stalls.of.len(), stalls.left("pin arm", &key(5), later)), (1, None));
    }

    #[test]
    fn of_very_many_addresses_those_whose_wait_ends_last_are_remembered() {
        let (mut stalls, now) = (StallHistory::default(), NOW);
        for number in 0..PEERS + 10 {
            let at = now + Duration::from_millis(number as u64);
            stalls.add(&format!("address {number}"), &key(0), Duration::from_secs(60), at);
        }
        assert_eq!(stalls.of.len(), PEERS);
        assert!(stalls.left("address 0", &key(0), now).is_none());
        assert!(stalls.left("address 10", &key(0), now).is_some());
    }
}
