//! What the application publishes, as the daemon is to get it: relays that take it, as many as there are
//! kinds of QoS on a topic.

use std::collections::{BTreeMap, BTreeSet, HashMap};

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

/// Samples of one pair that are passed over before others have their turn.
const BATCH: usize = 64;

/// Publishers whose samples are taken by one relay.
#[derive(Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Group {
    topic: String,
    type_name: String,
    best_effort: bool,
    volatile: bool,
    /// How many samples each keeps for whoever has not taken them; `None` where a reader may have all.
    depth: Option<u32>,
}

impl Group {
    pub(super) fn of(endpoint: &Endpoint) -> Self {
        let Qos { reliability, durability, history, depth, .. } = endpoint.qos;
        let best_effort = reliability == Reliability::BestEffort;
        Self {
            topic: endpoint.topic.clone(),
            type_name: endpoint.type_name.clone(),
            best_effort,
            volatile: durability == Durability::Volatile,
            depth: (best_effort && history == History::KeepLast).then_some(depth),
        }
    }

    /// What a relay requests to get all that its publishers offer: whether one is held back is up to
    /// the publisher's QoS, as ever.
    fn qos(&self) -> Qos {
        Qos {
            reliability: if self.best_effort {
                Reliability::BestEffort
            } else {
                Reliability::Reliable
            },
            durability: if self.volatile {
                Durability::Volatile
            } else {
                Durability::TransientLocal
            },
            history: if self.depth.is_some() { History::KeepLast } else { History::KeepAll },
            depth: self.depth.unwrap_or(1),
            deadline: None,
            lifespan: None,
            liveliness: Liveliness::Automatic,
            lease: None,
        }
    }
}

pub(super) struct Relay {
    subscription: Subscription,
    stands_for: BTreeSet<Gid>,
}

impl Relay {
    /// When each of its publishers that has a lease was last alive.
    pub(super) fn assertions(&self) -> Vec<(Gid, u64)> {
        self.subscription.assertions()
    }
}

impl Served<'_> {
    pub(super) fn update_relays(&mut self) {
        let mut wanted: BTreeMap<Group, BTreeSet<Gid>> = BTreeMap::new();
        for endpoint in self.own.values().filter(|e| e.kind == EndpointKind::Publisher) {
            let group = Group::of(endpoint);
            let readers = self.matched.get(&endpoint.gid);
            // History goes ahead of those who will ask for it; what is left is carried to its end.
            let rest = self.ending.contains_key(&endpoint.gid) && self.relays.contains_key(&group);
            if readers.is_none_or(BTreeSet::is_empty) && group.volatile && !rest {
                continue;
            }
            wanted.entry(group).or_default().extend(readers.into_iter().flatten());
        }
        self.relays.retain(|group, _| wanted.contains_key(group));
        for (group, stands_for) in wanted {
            let gids: Vec<Gid> = stands_for.iter().take(MAX_MATCHED).copied().collect();
            if let Some(relay) = self.relays.get_mut(&group) {
                if relay.stands_for != stands_for {
                    relay.subscription.set_stands_for(gids);
                    relay.stands_for = stands_for;
                }
                continue;
            }
            let spec = EndpointSpec::new(&*group.topic, &*group.type_name, group.qos());
            match self.common.outside.create_relay(spec, gids) {
                Ok(subscription) => {
                    self.relays.insert(group, Relay { subscription, stands_for });
                }
                Err(error) => tracing::error!(topic = group.topic, %error, "nothing is relayed"),
            }
        }
    }

    /// Whether all that a publisher has published is with the daemon.
    pub(super) fn is_published(&self, publisher: &Endpoint) -> bool {
        let relay = self.relays.get(&Group::of(publisher));
        relay.is_none_or(|relay| !relay.subscription.has_from(&publisher.gid))
            && self.pipe.outgoing.is_idle(&Channel::of(publisher.gid))
    }

    /// Takes what goes by way of another relay; whether there was any.
    pub(super) fn pass_over(&self) -> bool {
        let mut any = false;
        for (group, relay) in &self.relays {
            for publisher in self.own.values().filter(|e| {
                e.kind == EndpointKind::Publisher
                    && e.topic == group.topic
                    && e.type_name == group.type_name
                    && Group::of(e) != *group
            }) {
                for _ in 0..BATCH {
                    if relay.subscription.take_from(&publisher.gid).is_none() {
                        break;
                    }
                    any = true;
                }
            }
        }
        any
    }
}

pub(super) fn take(
    publisher: &Endpoint,
    relays: &BTreeMap<Group, Relay>,
    lost: &mut HashMap<Gid, u64>,
) -> Option<Departing<Sample>> {
    let relay = relays.get(&Group::of(publisher))?;
    let (content, now) = relay.subscription.take_from(&publisher.gid)?;
    let before = lost.insert(publisher.gid, now).unwrap_or(0);
    // A relay that attached anew counts from 0.
    let lost = now.checked_sub(before).unwrap_or(now);
    Some(Departing { meta: content.meta(), lost, content })
}
