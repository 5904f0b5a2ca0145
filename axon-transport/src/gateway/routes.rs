//! Which topics a peer must send here, and under which QoS the gateway asks for them on the
//! other side: plain data in, data out.

use std::collections::{BTreeMap, BTreeSet};

use crate::{
    graph::{Endpoint, EndpointKind},
    ids::Gid,
    link::Subscriber,
    qos::{Durability, History, Qos, Reliability, compatible},
};

/// A topic and its type; endpoints match on both.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(super) struct TopicKey {
    /// Topic name.
    pub(super) topic: String,
    /// Type name.
    pub(super) type_name: String,
}

impl TopicKey {
    /// The key of `endpoint`.
    pub(super) fn of(endpoint: &Endpoint) -> Self {
        Self { topic: endpoint.topic.clone(), type_name: endpoint.type_name.clone() }
    }
}

/// What one topic needs from one peer.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Wanted {
    /// Subscriptions here that some publisher there serves.
    pub(super) subscribers: Vec<Subscriber>,
    /// Publishers there that serve some subscription here.
    pub(super) publishers: Vec<Endpoint>,
}

/// Matches a peer's publishers with this host's subscriptions.
pub(super) fn wanted<'a>(
    local: impl IntoIterator<Item = &'a Endpoint>,
    remote: impl IntoIterator<Item = &'a Endpoint>,
) -> BTreeMap<TopicKey, Wanted> {
    let mut subscriptions: BTreeMap<TopicKey, Vec<&Endpoint>> = BTreeMap::new();
    for endpoint in local.into_iter().filter(|e| e.kind == EndpointKind::Subscription) {
        subscriptions.entry(TopicKey::of(endpoint)).or_default().push(endpoint);
    }
    let mut routes: BTreeMap<TopicKey, Wanted> = BTreeMap::new();
    let mut counted = BTreeSet::new();
    for publisher in remote.into_iter().filter(|e| e.kind == EndpointKind::Publisher) {
        let key = TopicKey::of(publisher);
        let Some(candidates) = subscriptions.get(&key) else { continue };
        let served = candidates.iter().filter(|s| compatible(&publisher.qos, &s.qos).is_ok());
        let mut any = false;
        for subscription in served {
            any = true;
            if counted.insert(subscription.gid) {
                let subscriber = Subscriber { gid: subscription.gid, qos: subscription.qos };
                routes.entry(key.clone()).or_default().subscribers.push(subscriber);
            }
        }
        if any {
            routes.entry(key).or_default().publishers.push(publisher.clone());
        }
    }
    for route in routes.values_mut() {
        route.subscribers.sort_by_key(|s| s.gid);
        route.publishers.sort_by_key(|p| p.gid);
    }
    routes
}

/// One relay subscription that the sending side opens for a route.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct RelaySpec {
    /// What it requests locally.
    pub(super) qos: Qos,
    /// The peer's subscriptions that it stands for.
    pub(super) stands_for: Vec<Gid>,
}

/// The relays of a route.
///
/// Subscriptions are grouped by reliability and durability, because a relay must match exactly the
/// publishers that its subscriptions match, and because only a reliable one may hold a publisher
/// back. A publisher that two relays match is sent once, by the first that asks for more; see
/// [`serves`].
pub(super) fn relays(subscribers: &[Subscriber]) -> Vec<RelaySpec> {
    let mut groups: BTreeMap<(bool, bool), RelaySpec> = BTreeMap::new();
    for subscriber in subscribers {
        let qos = subscriber.qos;
        let key =
            (qos.reliability == Reliability::BestEffort, qos.durability == Durability::Volatile);
        let group = groups.entry(key).or_insert_with(|| RelaySpec {
            // Deadline, lifespan and liveliness are judged where the subscription lives.
            qos: Qos {
                deadline: None,
                lifespan: None,
                lease: None,
                liveliness: crate::qos::Liveliness::Automatic,
                ..qos
            },
            stands_for: Vec::new(),
        });
        group.qos.depth = group.qos.depth.max(qos.depth);
        if qos.history == History::KeepAll {
            group.qos.history = History::KeepAll;
        }
        group.stands_for.push(subscriber.gid);
    }
    groups.into_values().collect()
}

/// Which of a route's relays sends the samples of a publisher that offers `offered`: the first
/// that it is compatible with, in the order of [`relays`] (reliable before best effort,
/// transient local before volatile).
pub(super) fn serves(relays: &[RelaySpec], offered: &Qos) -> Option<usize> {
    relays.iter().position(|r| compatible(offered, &r.qos).is_ok())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn endpoint(number: u8, kind: EndpointKind, topic: &str, qos: Qos) -> Endpoint {
        Endpoint {
            gid: Gid([number; 16]),
            kind,
            topic: topic.into(),
            type_name: "t".into(),
            type_hash: vec![],
            qos,
            node: String::new(),
            namespace: String::new(),
            enclave: String::new(),
        }
    }

    #[test]
    fn only_topics_with_a_compatible_pair_are_wanted() {
        use EndpointKind::{Publisher, Subscription};
        let q = Qos::default();
        let local = [
            endpoint(1, Subscription, "/a", q),
            endpoint(2, Subscription, "/b", q),
            endpoint(3, Subscription, "/c", Qos::sensor_data()),
            endpoint(4, Publisher, "/d", q),
        ];
        let remote = [
            endpoint(11, Publisher, "/a", q),
            endpoint(12, Publisher, "/b", Qos::sensor_data()),
            endpoint(13, Publisher, "/c", Qos::sensor_data()),
            endpoint(14, Subscription, "/d", q),
            Endpoint { type_name: "other".into(), ..endpoint(15, Publisher, "/a", q) },
        ];
        let routes = wanted(&local, &remote);
        let topics: Vec<_> = routes.keys().map(|k| k.topic.as_str()).collect();
        assert_eq!(topics, ["/a", "/c"]);
        assert_eq!(routes.values().next().unwrap().publishers.len(), 1);
    }

    #[test]
    fn a_mixed_route_has_a_relay_per_group_and_sends_each_publisher_once() {
        let reliable = Subscriber { gid: Gid([1; 16]), qos: Qos::keep_all() };
        let best_effort = Subscriber { gid: Gid([2; 16]), qos: Qos::sensor_data() };
        let latched = Subscriber {
            gid: Gid([3; 16]),
            qos: Qos { durability: Durability::TransientLocal, ..Qos::default() },
        };
        let specs = relays(&[best_effort, reliable.clone(), latched]);
        assert_eq!(specs.len(), 3);
        assert_eq!(specs[1].stands_for, vec![reliable.gid]);
        assert_eq!(specs[1].qos.history, History::KeepAll);
        let offer = Qos { durability: Durability::TransientLocal, ..Qos::default() };
        assert_eq!(serves(&specs, &offer), Some(0));
        assert_eq!(serves(&specs, &Qos::default()), Some(1));
        assert_eq!(serves(&specs, &Qos::sensor_data()), Some(2));
    }
}
