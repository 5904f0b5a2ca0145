//! Selects the topics that a peer must send, and the QoS of each request. The functions take plain data and return
//! plain data. The submodules hold the routes that were asked for, served and refused.

pub(in crate::engine::peer) mod asked;
pub(in crate::engine::peer) mod lanes;
pub(in crate::engine::peer) mod limits;
pub(in crate::engine::peer) mod refused;
pub(in crate::engine::peer) mod served;
pub(in crate::engine::peer) mod unanswered;

use std::{
    cmp::Reverse,
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use axon_envelope::Kind;
use axon_shm::{
    ids::Gid,
    qos::{Durability, History, Qos, Reliability},
};
use axon_transport::{
    graph::Endpoint,
    internal::graph::{Pairing, RangeToHost, RemoteEndpoint, out_of_range, pairing, reads, writes},
};

use crate::{
    engine::route::{RelaySpec, RouteKey},
    link::RouteSubscriber,
};

/// The shortest time between two checks of pairs that are being attached.
const CHECK: Duration = Duration::from_millis(5);
/// The shortest time for each of these pairs, so that thousands of waiting pairs leave time for samples.
const CHECK_EACH: Duration = Duration::from_micros(4);
/// Returns the kind of a route from the number in a message.
pub(in crate::engine::peer) fn kind_of(kind: u8) -> Option<Kind> {
    [Kind::Topic, Kind::Request, Kind::Response].into_iter().find(|k| *k as u8 == kind)
}

/// Returns the time until the next check of this number of pairs.
pub(in crate::engine::peer) fn check_after(pairs: usize) -> Duration {
    CHECK.max(CHECK_EACH * u32::try_from(pairs).unwrap_or(u32::MAX))
}

/// The readers and writers of one route from one peer.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct WantedRoute {
    /// Readers here that at least one writer of the peer serves.
    pub(crate) subscribers: Vec<RouteSubscriber>,
    /// Writers of the peer, each with the number of readers here that it serves.
    pub(crate) writers: Vec<(Endpoint, usize)>,
}

impl WantedRoute {
    /// Returns whether this reader is among its readers.
    pub(in crate::engine::peer) fn has_reader(&self, gid: &Gid) -> bool {
        self.subscribers.binary_search_by_key(gid, |reader| reader.gid).is_ok()
    }

    /// Returns whether this writer is among its writers.
    pub(in crate::engine::peer) fn has_writer(&self, gid: &Gid) -> bool {
        self.writers.binary_search_by_key(gid, |(writer, _)| writer.gid).is_ok()
    }
}

/// Matches a peer's writers with this host's readers, as far as the ranges of their sessions permit.
pub(crate) fn wanted<'a>(
    local: impl IntoIterator<Item = (&'a Endpoint, RangeToHost)>,
    remote: impl IntoIterator<Item = &'a RemoteEndpoint>,
) -> BTreeMap<RouteKey, WantedRoute> {
    let mut readers: BTreeMap<&str, Vec<(&Endpoint, RangeToHost)>> = BTreeMap::new();
    for (endpoint, toward) in local.into_iter().filter(|(e, _)| reads(e.kind)) {
        readers.entry(&endpoint.topic).or_default().push((endpoint, toward));
    }
    let mut routes: BTreeMap<RouteKey, WantedRoute> = BTreeMap::new();
    let mut counted = BTreeSet::new();
    for remote in remote.into_iter().filter(|remote| writes(remote.endpoint.kind)) {
        let writer: &Endpoint = &remote.endpoint;
        let candidates = readers.get(&*writer.topic).into_iter().flatten();
        let in_range = candidates.filter(|(_, own)| out_of_range(*own, remote.toward).is_none());
        let served: Vec<&Endpoint> = in_range
            .map(|(reader, _)| *reader)
            .filter(|reader| pairing(writer, reader) == Pairing::Match)
            .collect();
        let Some(key) = RouteKey::of(writer).filter(|_| !served.is_empty()) else { continue };
        let route = routes.entry(key).or_default();
        for reader in &served {
            if counted.insert(reader.gid) {
                route.subscribers.push(RouteSubscriber { gid: reader.gid, qos: reader.qos });
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

/// Most relays of one route.
pub(in crate::engine::peer) const MAX_RELAYS_OF_ROUTE: usize = 16;

/// Returns the relays of a topic's route, the most demanding first. `hash` returns the hash of a subscription's type.
///
/// Subscriptions are grouped by reliability, durability and type hash for two reasons: a relay must match exactly the
/// publishers that its subscriptions match, and only a reliable relay may hold a publisher back. They are also grouped
/// by history and depth: the relay that stands for a subscription must not change when others come or go, because it
/// would miss the samples that are published meanwhile. So several relays may read one publisher;
/// [`axon_transport::internal::session::merge`] sends each sample once.
pub(crate) fn relays(
    subscribers: &[RouteSubscriber],
    hash: impl Fn(&Gid) -> Vec<u8>,
) -> Vec<RelaySpec> {
    let mut groups: BTreeMap<_, RelaySpec> = BTreeMap::new();
    for subscriber in subscribers {
        let (offered, type_hash) = (subscriber.qos, hash(&subscriber.gid));
        let keeps_all = offered.history == History::KeepAll;
        // Deadline, lifespan and liveliness are checked on the subscription's host.
        let qos = Qos::default()
            .with_reliability(offered.reliability)
            .with_durability(offered.durability)
            .with_history(offered.history)
            .with_depth(if keeps_all { Qos::keep_all().depth } else { class(offered.depth) });
        let key = (
            qos.reliability == Reliability::BestEffort,
            !keeps_all,
            Reverse(qos.depth),
            qos.durability == Durability::Volatile,
            type_hash.clone(),
        );
        let new = RelaySpec { qos, depth: 0, type_hash, stands_for: Vec::new() };
        let group = groups.entry(key).or_insert(new);
        group.depth = group.depth.max(offered.depth);
        group.stands_for.push(subscriber.gid);
    }
    groups.into_values().collect()
}

/// Removes from `specs` the new relays beyond the limit of one route; existing relays stay. Returns the number of
/// removed relays.
pub(crate) fn admit(specs: &mut Vec<RelaySpec>, is_there: impl Fn(&RelaySpec) -> bool) -> usize {
    let (asked, there) = (specs.len(), specs.iter().filter(|spec| is_there(spec)).count());
    let mut more = MAX_RELAYS_OF_ROUTE.saturating_sub(there);
    specs.retain(|spec| {
        let new = !is_there(spec);
        let admitted = !new || more > 0;
        more -= usize::from(new && admitted);
        admitted
    });
    asked - specs.len()
}

/// Returns the depth of the relay for a subscription of this depth. There are few depths, so that not each subscription
/// needs its own relay.
fn class(depth: u32) -> u32 {
    let classes = (0..u32::BITS).step_by(4).map(|bits| 1 << bits);
    classes.skip(1).find(|class| *class >= depth).unwrap_or(u32::MAX)
}

#[cfg(test)]
mod tests {
    use axon_transport::{config::DiscoveryRange, graph::EndpointKind};

    use super::*;

    fn endpoint(number: u8, kind: EndpointKind, topic: &str, qos: Qos) -> Endpoint {
        Endpoint::new(Gid([number; 16]), kind, topic, "t").with_qos(qos)
    }

    fn wanted(local: &[Endpoint], remote: &[Endpoint]) -> BTreeMap<RouteKey, WantedRoute> {
        let remote: Vec<RemoteEndpoint> = remote.iter().cloned().map(Into::into).collect();
        super::wanted(local.iter().map(|e| (e, SUBNET)), &remote)
    }

    const SUBNET: RangeToHost = RangeToHost { range: DiscoveryRange::Subnet, lists: false };

    #[test]
    fn a_reader_whose_range_a_writer_is_out_of_asks_for_nothing() {
        use EndpointKind::{Publisher, Subscription};
        let localhost = RangeToHost { range: DiscoveryRange::Localhost, lists: false };
        let readers = [1, 2].map(|n| endpoint(n, Subscription, "/t", Qos::default()));
        let mut writer = RemoteEndpoint::from(endpoint(11, Publisher, "/t", Qos::default()));
        let asked = |own: [RangeToHost; 2], writer: &RemoteEndpoint| {
            let routes = super::wanted(readers.iter().zip(own), [writer]);
            routes.values().map(|wanted| wanted.subscribers.len()).sum::<usize>()
        };
        assert_eq!(asked([SUBNET, localhost], &writer), 1);
        assert_eq!(asked([localhost; 2], &writer), 0);
        assert_eq!(asked([RangeToHost { lists: true, ..localhost }, localhost], &writer), 1);
        writer.toward = localhost;
        assert_eq!(asked([SUBNET; 2], &writer), 0);
        writer.toward.lists = true;
        assert_eq!(asked([SUBNET, localhost], &writer), 2);
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
            {
                let mut endpoint = endpoint(5, Subscription, "/e", q);
                endpoint.type_hash = vec![1];
                endpoint
            },
        ];
        let remote = [
            endpoint(11, Publisher, "/a", q),
            endpoint(12, Publisher, "/b", Qos::sensor_data()),
            endpoint(13, Publisher, "/c", Qos::sensor_data()),
            endpoint(14, Subscription, "/d", q),
            {
                let mut endpoint = endpoint(15, Publisher, "/a", q);
                endpoint.type_name = "other".into();
                endpoint
            },
            {
                let mut endpoint = endpoint(16, Publisher, "/e", q);
                endpoint.type_hash = vec![2];
                endpoint
            },
        ];
        let routes = wanted(&local, &remote);
        let topics: Vec<_> = routes.keys().map(|k| k.topic.as_str()).collect();
        assert_eq!(topics, ["/a", "/c"]);
        assert_eq!(routes.values().next().unwrap().writers.len(), 1);
    }

    #[test]
    fn local_servers_want_requests_and_local_clients_want_responses() {
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

    fn subscriber(number: u8, qos: Qos) -> RouteSubscriber {
        RouteSubscriber { gid: Gid([number; 16]), qos }
    }

    #[test]
    fn a_mixed_route_has_a_relay_per_group_that_asks_for_most_first() {
        let latched = Qos::default().with_durability(Durability::TransientLocal);
        let deep = Qos::default().with_depth(17);
        let qos = [Qos::sensor_data(), Qos::default(), latched, deep, Qos::keep_all()];
        let subscribers: Vec<_> = (0..).zip(qos).map(|(n, qos)| subscriber(n, qos)).collect();
        let specs = relays(&subscribers, |_| Vec::new());
        let order: Vec<u8> = specs.iter().map(|spec| spec.stands_for[0].0[0]).collect();
        assert_eq!(order, [4, 3, 2, 1, 0]);
        assert_eq!(specs[0].qos.history, History::KeepAll);
    }

    #[test]
    fn the_relay_of_a_subscription_is_independent_of_other_subscriptions() {
        let of = |depths: &[u32]| {
            let qos = |depth| Qos::default().with_depth(depth);
            let all = (0..).zip(depths).map(|(n, depth)| subscriber(n, qos(*depth)));
            relays(&all.collect::<Vec<_>>(), |_| Vec::new())
        };
        let stands_for = |specs: &[RelaySpec]| {
            let its = specs.iter().find(|spec| spec.stands_for.contains(&Gid([0; 16])));
            its.cloned().unwrap()
        };
        let alone = stands_for(&of(&[10]));
        assert_eq!((alone.qos.depth, alone.queued().depth), (16, 10));
        for others in [&[10, 1][..], &[10, 16], &[10, 17], &[10, u32::MAX, 300]] {
            assert!(stands_for(&of(others)).is(&alone), "{others:?}");
        }
        let together = of(&[10, 16, 1]);
        assert_eq!((together.len(), together[0].queued().depth), (1, 16));
        let depths = [0, 16, 17, 257, 1 << 28, (1 << 28) + 1, u32::MAX];
        let classes = [16, 16, 256, 4096, 1 << 28, u32::MAX, u32::MAX];
        assert_eq!(depths.map(class), classes);
    }
    #[test]
    fn a_route_has_so_many_relays_and_keeps_those_that_it_has() {
        let of = |hashes: std::ops::Range<u8>| {
            let all: Vec<_> = hashes.map(|n| subscriber(n, Qos::default())).collect();
            relays(&all, |gid| vec![gid.0[0]])
        };
        let mut specs = of(0..20);
        assert_eq!((admit(&mut specs, |_| false), specs.len()), (4, 16));
        let mut specs = of(0..20);
        let later = |spec: &RelaySpec| spec.type_hash[0] >= 10;
        assert_eq!((admit(&mut specs, later), specs.len()), (4, 16));
        assert_eq!(specs.iter().filter(|spec| later(spec)).count(), 10);
        let mut specs = of(0..20);
        assert_eq!((admit(&mut specs, |_| true), specs.len()), (0, 20));
    }
}
