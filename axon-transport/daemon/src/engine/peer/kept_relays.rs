//! KEEP_ALL relays of peers whose daemon was killed or restarted. They hold the samples that the peer did not
//! acknowledge, until the peer's next daemon asks for the topic for the same subscriptions.

use std::{
    collections::HashMap,
    rc::{Rc, Weak},
    time::Duration,
};

use axon_shm::ids::Gid;

use super::routes::served::{ServedRoute, ServedRoutes};
use crate::engine::route::{RelaySpec, RouteKey};
use crate::engine::{
    account::{Charge, Meter},
    outbound::{Outbound, Source, UnfinishedFlows},
    rings::RingReader,
};

/// The time for which a relay is kept.
const RELAY_RETENTION: Duration = Duration::from_secs(10);
/// The most kept relays. An identity gets half of the rest. The samples of further relays are given up at
/// once.
const MAX_KEPT_RELAYS: usize = 2048;

/// The kept relays.
pub(crate) struct KeptRelays {
    all: Vec<KeptRelay>,
    room: Rc<Meter>,
    /// The bound of each identity.
    rooms: HashMap<String, Weak<Meter>>,
}

struct KeptRelay {
    /// The identity that the peer proved.
    identity: String,
    key: RouteKey,
    spec: RelaySpec,
    reader: Rc<dyn RingReader>,
    /// The unfinished flows of its route, including those of other relays of the route.
    unfinished: Rc<UnfinishedFlows>,
    since: Duration,
    until: Duration,
    /// The charge as a kept relay.
    _room: Charge,
    /// The charge that still counts it among the identity's relays.
    place: Charge,
    /// The charge for the relay's lanes.
    lanes: Charge,
}

/// The reason why a relay is not charged.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum NotCharged {
    /// The identity, or all together, have as many relays as they may.
    Relays,
    /// The lanes do not fit.
    Lanes,
}

impl KeptRelay {
    /// Returns whether a peer with this identity may adopt the relay for a relay of this kind.
    fn fits(&self, key: &RouteKey, spec: &RelaySpec, identity: &str) -> bool {
        let same = |gid| self.spec.stands_for.contains(gid);
        let is_same_topic = self.key == *key && self.spec.is(spec);
        is_same_topic && self.identity == identity && spec.stands_for.iter().any(same)
    }
}

impl Default for KeptRelays {
    fn default() -> Self {
        Self { all: Vec::new(), room: Meter::new(MAX_KEPT_RELAYS), rooms: HashMap::new() }
    }
}

impl KeptRelays {
    /// Returns the bound for an identity's kept relays.
    fn room_of(&mut self, identity: &str) -> Rc<Meter> {
        if let Some(room) = self.rooms.get(identity).and_then(Weak::upgrade) {
            return room;
        }
        self.rooms.retain(|_, room| room.strong_count() > 0);
        let room = Meter::within(&self.room, MAX_KEPT_RELAYS);
        self.rooms.insert(identity.to_owned(), Rc::downgrade(&room));
        room
    }

    /// Takes over the KEEP_ALL relays of a peer that is gone: `served` are its routes, `outbound` the samples to it.
    pub(super) fn add(
        &mut self,
        identity: &str,
        served: &mut ServedRoutes,
        outbound: &mut Outbound,
        now: Duration,
    ) {
        for (number, served) in served.iter_mut() {
            self.add_route(identity, number, served, outbound, now);
        }
    }

    /// Takes over the KEEP_ALL relays of one route, which its peer is about to ask for under another number.
    pub(super) fn add_route(
        &mut self,
        identity: &str,
        number: u32,
        served: &mut ServedRoute,
        outbound: &mut Outbound,
        now: Duration,
    ) {
        let room = self.room_of(identity);
        let lanes = served.lanes.amount() / served.sources.len().max(1);
        let (sources, unfinished) = outbound.take_kept(number, room.left(), now);
        let unfinished = Rc::new(unfinished);
        for source in sources {
            let Source::Relay(spec, reader) = source else { continue };
            let Some(place) = room.charge(1) else { continue };
            let (kept_room, place) = (place, served.relays.split(1));
            let identity = identity.to_owned();
            let (key, since, until) = (served.key.clone(), now, now + RELAY_RETENTION);
            let unfinished = Rc::clone(&unfinished);
            let lanes = served.lanes.split(lanes);
            self.all.push(KeptRelay {
                identity,
                key,
                spec,
                reader,
                unfinished,
                since,
                until,
                _room: kept_room,
                place,
                lanes,
            });
        }
    }

    /// Charges a place and `many` lanes for a new relay, each to the meter of the route's charge. If the peer is about to
    /// adopt a kept relay, the place and the lanes of that one are released to make room. The kept relay then has none,
    /// so [`adopt`](Self::adopt) must follow.
    ///
    /// # Errors
    /// The place or the lanes do not fit. The kept relay then keeps its charges.
    pub(super) fn charge(
        &mut self,
        key: &RouteKey,
        spec: &RelaySpec,
        identity: &str,
        (places, lanes): (&Charge, &Charge),
        many: usize,
    ) -> Result<(Charge, Charge), NotCharged> {
        let Some(kept) = self.all.iter_mut().find(|kept| kept.fits(key, spec, identity)) else {
            let place = places.more(1).ok_or(NotCharged::Relays)?;
            return Ok((place, lanes.more(many).ok_or(NotCharged::Lanes)?));
        };
        let place = exchange(&mut kept.place, places, 1).ok_or(NotCharged::Relays)?;
        match exchange(&mut kept.lanes, lanes, many) {
            Some(lanes) => Ok((place, lanes)),
            None => {
                kept.place = place;
                Err(NotCharged::Lanes)
            }
        }
    }

    /// Returns a kept relay for a peer with this identity and for one of the subscriptions of a new relay. It starts
    /// with the unacknowledged samples.
    ///
    /// Also returns the unfinished flows, so that a new daemon does not reset the `limit` on peers that take
    /// nothing or too little. The longest time for which a relay is kept counts as half of the limit. So a
    /// daemon that is slow to start has the other half.
    pub(super) fn adopt(
        &mut self,
        key: &RouteKey,
        spec: &RelaySpec,
        identity: &str,
        limit: Duration,
        now: Duration,
    ) -> Option<(Rc<dyn RingReader>, UnfinishedFlows)> {
        let at = self.all.iter().position(|kept| kept.fits(key, spec, identity))?;
        let KeptRelay { reader, since, unfinished, .. } = self.all.swap_remove(at);
        reader.take_back();
        reader.set_stands_for(spec.stands_for.clone());
        let kept = now.saturating_sub(since).min(RELAY_RETENTION);
        let idle = limit * kept.as_millis() as u32 / (2 * RELAY_RETENTION.as_millis() as u32);
        let mut unfinished = Rc::unwrap_or_clone(unfinished);
        unfinished.values_mut().for_each(|flow| flow.keep(kept, idle));
        Some((reader, unfinished))
    }

    /// Returns the number of kept relays.
    #[cfg(test)]
    pub(crate) fn len(&self) -> usize {
        self.all.len()
    }

    /// Returns when [`give_up`](Self::give_up) is due.
    pub(crate) fn poll_timeout(&self) -> Option<Duration> {
        self.all.iter().map(|kept| kept.until).min()
    }

    /// Gives up the samples of the relays whose time is over. Returns the samples by topic. `have_ended` returns whether
    /// these subscriptions of the host with this identity have ended: nobody misses their samples, so they do not count.
    pub(crate) fn give_up(
        &mut self,
        now: Duration,
        have_ended: impl Fn(&str, &[Gid]) -> bool,
    ) -> Vec<(String, u64)> {
        let mut lost = Vec::new();
        for kept in self.all.extract_if(.., |kept| kept.until <= now) {
            let KeptRelay { identity, key, spec, reader, .. } = kept;
            if have_ended(&identity, &spec.stands_for) {
                continue;
            }
            let mut all = 0;
            for (publisher, samples) in reader.unacknowledged() {
                reader.give_up(publisher, samples);
                all += samples;
            }
            if all > 0 {
                lost.push((key.topic, all));
            }
        }
        lost
    }
}

/// Exchanges a charge of a kept relay for one of `amount` of the other charge's meter. Returns `None` if that does not
/// fit; the kept relay then keeps its charge.
fn exchange(kept: &mut Charge, to: &Charge, amount: usize) -> Option<Charge> {
    let before = std::mem::replace(kept, to.meter().nothing());
    match before.exchange(to.meter(), amount) {
        Ok(charged) => Some(charged),
        Err(before) => {
            *kept = before;
            None
        }
    }
}

#[cfg(test)]
mod tests {
    use axon_envelope::Kind;
    use axon_shm::qos::Qos;
    use axon_transport::EndpointSpec;

    use super::*;
    use crate::engine::{rings::Rings, sim::rings::SimRings};

    const IDENTITY: &str = "robot";

    fn key() -> RouteKey {
        RouteKey { kind: Kind::Topic, topic: "/t".into(), type_name: "t".into() }
    }

    fn spec() -> RelaySpec {
        let stands_for = vec![Gid([1; 16])];
        RelaySpec { qos: Qos::keep_all(), depth: 0, type_hash: Vec::new(), stands_for }
    }

    /// Returns kept relays with one whose place is of `places` and whose two lanes are of `lanes`.
    fn kept(places: &Rc<Meter>, lanes: &Rc<Meter>) -> KeptRelays {
        let mut kept = KeptRelays::default();
        let room = kept.room_of(IDENTITY).charge(1).unwrap();
        let endpoint = EndpointSpec::new("/t", "t", Qos::keep_all());
        let reader = SimRings::new(0).open_reader(endpoint, spec().stands_for).unwrap();
        kept.all.push(KeptRelay {
            identity: IDENTITY.into(),
            key: key(),
            spec: spec(),
            reader,
            unfinished: Rc::default(),
            since: Duration::ZERO,
            until: RELAY_RETENTION,
            _room: room,
            place: places.charge(1).unwrap(),
            lanes: lanes.charge(2).unwrap(),
        });
        kept
    }

    fn charge(
        kept: &mut KeptRelays,
        identity: &str,
        (places, lanes): (&Rc<Meter>, &Rc<Meter>),
    ) -> Result<(Charge, Charge), NotCharged> {
        kept.charge(&key(), &spec(), identity, (&places.nothing(), &lanes.nothing()), 2)
    }

    #[test]
    fn a_peer_with_as_many_relays_as_it_may_have_adopts_its_kept_one() {
        let (places, lanes) = (Meter::new(1), Meter::new(2));
        let mut kept = kept(&places, &lanes);
        let charged = charge(&mut kept, IDENTITY, (&places, &lanes)).unwrap();
        assert!(kept.adopt(&key(), &spec(), IDENTITY, Duration::ZERO, Duration::ZERO).is_some());
        assert_eq!((places.held(), lanes.held()), (1, 2), "it counts once");
        drop(charged);
        assert_eq!((places.held(), lanes.held()), (0, 0));
    }

    #[test]
    fn a_kept_relay_makes_no_room_for_another_identity() {
        let (places, lanes) = (Meter::new(1), Meter::new(2));
        let mut kept = kept(&places, &lanes);
        let refused = charge(&mut kept, "other", (&places, &lanes)).unwrap_err();
        assert_eq!(refused, NotCharged::Relays);
        assert_eq!((places.held(), lanes.held()), (1, 2));
    }

    #[test]
    fn a_kept_relay_keeps_its_charges_if_the_new_one_does_not_fit() {
        let (places, lanes) = (Meter::new(1), Meter::new(2));
        let mut kept = kept(&places, &lanes);
        let (none, one) = (Meter::new(0), Meter::new(1));
        let no_place = charge(&mut kept, IDENTITY, (&none, &lanes)).unwrap_err();
        let no_lanes = charge(&mut kept, IDENTITY, (&places, &one)).unwrap_err();
        assert_eq!([no_place, no_lanes], [NotCharged::Relays, NotCharged::Lanes]);
        assert_eq!((places.held(), lanes.held(), one.held()), (1, 2, 0));
        assert_eq!(kept.give_up(RELAY_RETENTION, |_, _| false), []);
        assert_eq!((places.held(), lanes.held()), (0, 0));
    }
}
