//! KEEP_ALL relays of peers whose daemon was killed or restarted. They hold what the peer did not acknowledge, until
//! the next daemon there asks for the topic for the same subscriptions.

use std::{
    collections::HashMap,
    rc::{Rc, Weak},
    time::Duration,
};

use super::{Peer, routes::RelaySpec};
use crate::engine::{
    account::{Charge, Meter},
    outbound::{Source, UnfinishedFlows},
    peer::routes::RouteKey,
    rings::RingReader,
};

/// A relay is kept for so long.
const PATIENCE: Duration = Duration::from_secs(10);
/// Relays that are kept. An identity gets half of what the others leave. What further ones hold is given up at once.
const MOST: usize = 2048;

/// The relays that are kept.
pub(crate) struct KeptRelays {
    all: Vec<KeptRelay>,
    room: Rc<Meter>,
    /// That of each identity.
    rooms: HashMap<String, Weak<Meter>>,
}

struct KeptRelay {
    /// The identity that the peer proved.
    identity: String,
    key: RouteKey,
    spec: RelaySpec,
    reader: Rc<dyn RingReader>,
    /// What is known of its route's flows, those of all its relays.
    unfinished: Rc<UnfinishedFlows>,
    since: Duration,
    until: Duration,
    /// It counts among those that are kept, and still among the relays of the identity.
    _charges: [Charge; 2],
    /// Those of its relay.
    lanes: Charge,
}

impl KeptRelay {
    /// Whether a peer with this identity may adopt it for a relay of this kind.
    fn fits(&self, key: &RouteKey, spec: &RelaySpec, identity: &str) -> bool {
        let same = |gid| self.spec.stands_for.contains(gid);
        let is_same_topic = self.key == *key && self.spec.is(spec);
        is_same_topic && self.identity == identity && spec.stands_for.iter().any(same)
    }
}

impl Default for KeptRelays {
    fn default() -> Self {
        Self { all: Vec::new(), room: Meter::new(MOST), rooms: HashMap::new() }
    }
}

impl KeptRelays {
    /// What an identity may have kept.
    fn room_of(&mut self, identity: &str) -> Rc<Meter> {
        if let Some(room) = self.rooms.get(identity).and_then(Weak::upgrade) {
            return room;
        }
        self.rooms.retain(|_, room| room.strong_count() > 0);
        let room = Meter::within(&self.room, MOST);
        self.rooms.insert(identity.to_owned(), Rc::downgrade(&room));
        room
    }

    /// Takes the KEEP_ALL relays of a peer that is gone.
    pub(crate) fn add(&mut self, peer: &mut Peer, now: Duration) {
        let room = self.room_of(&peer.identity);
        for (number, served) in peer.served.iter_mut() {
            let lanes = served.lanes.amount() / served.sources.len().max(1);
            let (sources, unfinished) = peer.outbound.take_kept(number, room.left(), now);
            let unfinished = Rc::new(unfinished);
            for source in sources {
                let Source::Relay(spec, reader) = source else { continue };
                let Some(place) = room.charge(1) else { continue };
                let charges = [place, served.relays.split(1)];
                let identity = peer.identity.clone();
                let (key, since, until) = (served.key.clone(), now, now + PATIENCE);
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
    }

    /// Charges the `lanes` of a new relay as many. If the peer is about to adopt one that was kept, the lanes of that make
    /// room for them; it has none from then on, so [`adopt`](Self::adopt) has to follow. `None`: there are not so many, and
    /// what is kept stays charged.
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

    /// The relay that was kept, of a peer with this identity, for one of the subscriptions for which a new one is to
    /// stand. It begins with what was not acknowledged. Returns also what is known of the flows that it had: a daemon that
    /// follows another one is no way around the `limit` on those that take nothing, or too little. All the time for which a
    /// relay may be kept counts as half of the limit, so that a daemon that is slow to start has the other half.
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
        let kept = now.saturating_sub(since).min(PATIENCE);
        let idle = limit * kept.as_millis() as u32 / (2 * PATIENCE.as_millis() as u32);
        let mut unfinished = Rc::unwrap_or_clone(unfinished);
        unfinished.values_mut().for_each(|flow| flow.keep(kept, idle));
        Some((reader, unfinished))
    }

    /// How many there are.
    #[cfg(test)]
    pub(crate) fn len(&self) -> usize {
        self.all.len()
    }

    /// When [`give_up`](Self::give_up) is due.
    pub(crate) fn poll_timeout(&self) -> Option<Duration> {
        self.all.iter().map(|kept| kept.until).min()
    }

    /// Gives up what relays hold that were kept until now. Returns the samples, by topic.
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
