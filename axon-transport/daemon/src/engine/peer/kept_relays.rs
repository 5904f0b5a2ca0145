//! KEEP_ALL relays of peers whose daemon was killed or restarted. They hold the samples that the peer did not
//! acknowledge, until the peer's next daemon asks for the topic for the same subscriptions.

use std::{
    collections::HashMap,
    rc::{Rc, Weak},
    time::Duration,
};

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
    /// One charge as a kept relay, and one that still counts it among the identity's relays.
    _charges: [Charge; 2],
    /// The charge for the relay's lanes.
    lanes: Charge,
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
            let charges = [place, served.relays.split(1)];
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
                _charges: charges,
                lanes,
            });
        }
    }

    /// Charges `many` lanes for a new relay. If the peer is about to adopt a kept relay, the lanes of that
    /// one are released to make room. The kept relay then has no lanes, so [`adopt`](Self::adopt) must
    /// follow. Returns `None` if the lanes do not fit; the kept relay then keeps its charge.
    pub(super) fn charge_lanes(
        &mut self,
        key: &RouteKey,
        spec: &RelaySpec,
        identity: &str,
        lanes: &Charge,
        many: usize,
    ) -> Option<Charge> {
        let Some(kept) = self.all.iter_mut().find(|kept| kept.fits(key, spec, identity)) else {
            return lanes.more(many);
        };
        let before = std::mem::replace(&mut kept.lanes, lanes.meter().nothing());
        match before.exchange(lanes.meter(), many) {
            Ok(charged) => Some(charged),
            Err(before) => {
                kept.lanes = before;
                None
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

    /// Gives up the samples of the relays whose time is over. Returns the samples by topic.
    pub(crate) fn give_up(&mut self, now: Duration) -> Vec<(String, u64)> {
        let mut lost = Vec::new();
        for KeptRelay { key, reader, .. } in self.all.extract_if(.., |kept| kept.until <= now) {
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
