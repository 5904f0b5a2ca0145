//! Which topics a peer must send here, and under which QoS the gateway asks for them on the
//! other side: plain data in, data out.

use std::collections::{BTreeMap, BTreeSet};

use axon_envelope::Kind;

use crate::{
    graph::{Endpoint, EndpointKind, Pairing, pairing, reads, writes},
    ids::Gid,
    link::Subscriber,
    qos::{Durability, History, Qos, Reliability, compatible},
};

/// What a route carries: samples, requests or responses, of one name and type.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(super) struct RouteKey {
    /// Which of the three.
    pub(super) kind: Kind,
    /// Topic or service name.
    pub(super) topic: String,
    /// Type name.
    pub(super) type_name: String,
}

impl RouteKey {
    /// The key of what `writer` writes; `None` where it writes nothing.
    fn of(writer: &Endpoint) -> Option<Self> {
        let kind = match writer.kind {
            EndpointKind::Publisher => Kind::Topic,
            EndpointKind::Client => Kind::Request,
            EndpointKind::Server => Kind::Response,
            EndpointKind::Subscription | EndpointKind::Node => return None,
        };
        let (topic, type_name) = (writer.topic.clone(), writer.type_name.clone());
        Some(Self { kind, topic, type_name })
    }

    /// The key of the same service in the other direction; of a topic its own.
    pub(super) fn other_way(&self) -> Self {
        let kind = match self.kind {
            Kind::Topic => Kind::Topic,
            Kind::Request => Kind::Response,
            Kind::Response => Kind::Request,
        };
        Self { kind, ..self.clone() }
    }
}

/// What one route needs from one peer.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Wanted {
    /// Readers here that some writer there serves.
    pub(super) subscribers: Vec<Subscriber>,
    /// Writers there, and how many readers here each serves.
    pub(super) writers: Vec<(Endpoint, usize)>,
}

/// Matches a peer's writers with this host's readers.
pub(super) fn wanted<'a>(
    local: impl IntoIterator<Item = &'a Endpoint>,
    remote: impl IntoIterator<Item = &'a Endpoint>,
) -> BTreeMap<RouteKey, Wanted> {
    let mut readers: BTreeMap<&str, Vec<&Endpoint>> = BTreeMap::new();
    for endpoint in local.into_iter().filter(|e| reads(e.kind)) {
        readers.entry(&endpoint.topic).or_default().push(endpoint);
    }
    let mut routes: BTreeMap<RouteKey, Wanted> = BTreeMap::new();
    let mut counted = BTreeSet::new();
    for writer in remote.into_iter().filter(|e| writes(e.kind)) {
        let candidates = readers.get(&*writer.topic).into_iter().flatten();
        let served: Vec<_> = candidates.filter(|r| pairing(writer, r) == Pairing::Match).collect();
        let Some(key) = RouteKey::of(writer).filter(|_| !served.is_empty()) else { continue };
        let route = routes.entry(key).or_default();
        for reader in &served {
            if counted.insert(reader.gid) {
                route.subscribers.push(Subscriber { gid: reader.gid, qos: reader.qos });
            }
        }
        route.writers.push((writer.clone(), served.len()));
    }
    for route in routes.values_mut() {
        route.subscribers.sort_by_key(|s| s.gid);
        route.writers.sort_by_key(|(w, _)| w.gid);
    }
    routes
}

/// One relay subscription that the sending side opens for a topic's route.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct RelaySpec {
    /// What it requests locally.
    pub(super) qos: Qos,
    /// The hash of its type, where the peer's subscriptions know it.
    pub(super) type_hash: Vec<u8>,
    /// The peer's subscriptions that it stands for.
    pub(super) stands_for: Vec<Gid>,
}

/// The relays of a topic's route. `hash` gives the hash of a subscription's type.
///
/// Subscriptions are grouped by reliability, durability and type hash, because a relay must match
/// exactly the publishers that its subscriptions match, and because only a reliable one may hold a
/// publisher back. A publisher that two relays match is sent once, by the first that asks for more;
/// see [`serves`].
pub(super) fn relays(subscribers: &[Subscriber], hash: impl Fn(&Gid) -> Vec<u8>) -> Vec<RelaySpec> {
    let mut groups: BTreeMap<(bool, bool, Vec<u8>), RelaySpec> = BTreeMap::new();
    for subscriber in subscribers {
        let (qos, type_hash) = (subscriber.qos, hash(&subscriber.gid));
        let best_effort = qos.reliability == Reliability::BestEffort;
        let key = (best_effort, qos.durability == Durability::Volatile, type_hash.clone());
        let group = groups.entry(key).or_insert_with(|| RelaySpec {
            // Deadline, lifespan and liveliness are judged where the subscription lives.
            qos: Qos {
                deadline: None,
                lifespan: None,
                lease: None,
                liveliness: crate::qos::Liveliness::Automatic,
                ..qos
            },
            type_hash,
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
pub(super) fn serves<'a>(
    relays: impl IntoIterator<Item = &'a RelaySpec>,
    offered: &Offered,
) -> Option<usize> {
    let hashes = |other: &[u8]| {
        let own = &*offered.type_hash;
        own.is_empty() || other.is_empty() || own == other
    };
    let goes = |r: &RelaySpec| compatible(&offered.qos, &r.qos).is_ok() && hashes(&r.type_hash);
    relays.into_iter().position(goes)
}

/// What a local publisher offers.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Offered {
    /// Its QoS.
    pub(super) qos: Qos,
    /// The hash of its type.
    pub(super) type_hash: Vec<u8>,
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
            Endpoint { type_hash: vec![1], ..endpoint(5, Subscription, "/e", q) },
        ];
        let remote = [
            endpoint(11, Publisher, "/a", q),
            endpoint(12, Publisher, "/b", Qos::sensor_data()),
            endpoint(13, Publisher, "/c", Qos::sensor_data()),
            endpoint(14, Subscription, "/d", q),
            Endpoint { type_name: "other".into(), ..endpoint(15, Publisher, "/a", q) },
            Endpoint { type_hash: vec![2], ..endpoint(16, Publisher, "/e", q) },
        ];
        let routes = wanted(&local, &remote);
        let topics: Vec<_> = routes.keys().map(|k| k.topic.as_str()).collect();
        assert_eq!(topics, ["/a", "/c"]);
        assert_eq!(routes.values().next().unwrap().writers.len(), 1);
    }

    #[test]
    fn a_service_is_wanted_by_whom_it_has_on_either_side_and_in_one_direction_each() {
        use EndpointKind::{Client, Server};
        let q = Qos::default();
        let local = [endpoint(1, Server, "/s", q), endpoint(2, Server, "/s", q)];
        let remote = [
            endpoint(11, Client, "/s", q),
            endpoint(12, Client, "/s", Qos::sensor_data()),
            endpoint(13, Server, "/s", q),
        ];
        let routes: Vec<_> = wanted(&local, &remote).into_iter().collect();
        let [(key, requests)] = &routes[..] else { panic!("{routes:?}") };
        assert_eq!(key.kind, Kind::Request);
        assert_eq!(requests.writers, [(remote[0].clone(), 2)]);
        assert_eq!(requests.subscribers.len(), 2);
        let routes: Vec<_> = wanted(&remote, &local).into_iter().collect();
        let [(key, responses)] = &routes[..] else { panic!("{routes:?}") };
        assert_eq!(key.kind, Kind::Response);
        assert_eq!(responses.subscribers.len(), 1, "the client that goes with neither");
        assert_eq!(key.other_way().kind, Kind::Request);
    }

    #[test]
    fn a_mixed_route_has_a_relay_per_group_and_sends_each_publisher_once() {
        let reliable = Subscriber { gid: Gid([1; 16]), qos: Qos::keep_all() };
        let best_effort = Subscriber { gid: Gid([2; 16]), qos: Qos::sensor_data() };
        let latched = Subscriber {
            gid: Gid([3; 16]),
            qos: Qos { durability: Durability::TransientLocal, ..Qos::default() },
        };
        let specs = relays(&[best_effort, reliable.clone(), latched], |_| Vec::new());
        assert_eq!(specs.len(), 3);
        assert_eq!(specs[1].stands_for, vec![reliable.gid]);
        assert_eq!(specs[1].qos.history, History::KeepAll);
        let serves = |qos| serves(&specs, &Offered { qos, type_hash: vec![] });
        let offer = Qos { durability: Durability::TransientLocal, ..Qos::default() };
        assert_eq!(serves(offer), Some(0));
        assert_eq!(serves(Qos::default()), Some(1));
        assert_eq!(serves(Qos::sensor_data()), Some(2));
    }

    #[test]
    fn a_publisher_of_another_type_hash_is_nobodys() {
        let subscriber = |number| Subscriber { gid: Gid([number; 16]), qos: Qos::default() };
        let specs = relays(&[subscriber(1), subscriber(2)], |gid| vec![gid.0[0]]);
        assert_eq!(specs.len(), 2);
        let serves = |type_hash| serves(&specs, &Offered { qos: Qos::default(), type_hash });
        assert_eq!((serves(vec![2]), serves(vec![3]), serves(vec![])), (Some(1), None, Some(0)));
    }
}
