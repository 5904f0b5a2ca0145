//! What the application publishes, as the daemon is to get it: a relay for each publisher. It stands for
//! those with whom the daemon says that this publisher is matched: whom the publisher counts, it reaches.

use std::collections::{BTreeMap, BTreeSet};

use super::Served;
use crate::{
    graph::{Endpoint, EndpointKind},
    ids::Gid,
    qos::{Durability, History, Liveliness, Qos, Reliability},
    relay::{
        MAX_MATCHED,
        flow::{Channel, Departing},
    },
    session::{EndpointSpec, Subscription},
    shm::Sample,
};

pub(super) struct Relay {
    subscription: Subscription,
    stands_for: BTreeSet<Gid>,
    /// Samples that it has lost, as far as the daemon knows.
    lost: u64,
}

impl Relay {
    /// When its publisher was last alive, if that has a lease.
    pub(super) fn assertions(&self) -> Vec<(Gid, u64)> {
        self.subscription.assertions()
    }

    /// The daemon has its publisher's samples up to this number.
    pub(super) fn acknowledge(&self, sequence: u64) {
        self.subscription.acknowledge(sequence);
    }

    /// The next sample of its publisher.
    pub(super) fn take(&mut self, publisher: &Gid) -> Option<Departing<Sample>> {
        let (content, now) = self.subscription.take_from(publisher)?;
        let before = std::mem::replace(&mut self.lost, now);
        // Where the publisher has granted anew, it counts from 0.
        let lost = now.checked_sub(before).unwrap_or(now);
        Some(Departing { meta: content.meta(), lost, content })
    }
}

impl Served<'_> {
    pub(super) fn update_relays(&mut self) {
        let mut wanted: BTreeMap<Gid, BTreeSet<Gid>> = BTreeMap::new();
        for publisher in self.own.values().filter(|e| e.kind == EndpointKind::Publisher) {
            let gid = publisher.gid;
            let readers = self.matched.get(&gid).cloned().unwrap_or_default();
            // History goes ahead of those who will ask for it; what is left is carried to its end.
            let history = publisher.qos.durability == Durability::TransientLocal;
            let rest = self.ending.contains_key(&gid) && self.relays.contains_key(&gid);
            if history || rest || !readers.is_empty() {
                wanted.insert(gid, readers);
            }
        }
        self.relays.retain(|publisher, _| wanted.contains_key(publisher));
        for (publisher, stands_for) in wanted {
            let gids: Vec<Gid> = stands_for.iter().take(MAX_MATCHED).copied().collect();
            if let Some(relay) = self.relays.get_mut(&publisher) {
                if relay.stands_for != stands_for {
                    relay.subscription.set_stands_for(gids);
                    relay.stands_for = stands_for;
                }
                continue;
            }
            let Endpoint { topic, type_name, qos, .. } = &*self.own[&publisher];
            let spec = EndpointSpec::new(&**topic, &**type_name, requested(qos));
            match self.common.outside.create_relay_of(publisher, spec, gids) {
                Ok(subscription) => {
                    self.relays.insert(publisher, Relay { subscription, stands_for, lost: 0 });
                }
                Err(error) => tracing::error!(topic, %error, "nothing is relayed"),
            }
        }
    }

    /// Whether all that a publisher has published is with the daemon.
    pub(super) fn is_published(&self, publisher: &Gid) -> bool {
        let relay = self.relays.get(publisher);
        relay.is_none_or(|relay| !relay.subscription.has_from(publisher))
            && self.pipe.outgoing.is_idle(&Channel::of(*publisher))
    }
}

/// What a relay requests to get all that its publisher offers: whether that is held back is up to the
/// publisher's QoS, as ever.
fn requested(offered: &Qos) -> Qos {
    let newest =
        offered.reliability == Reliability::BestEffort && offered.history == History::KeepLast;
    Qos {
        history: if newest { History::KeepLast } else { History::KeepAll },
        deadline: None,
        lifespan: None,
        liveliness: Liveliness::Automatic,
        lease: None,
        ..*offered
    }
}
