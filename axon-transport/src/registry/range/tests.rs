//! Tests the pairs and the graph of sessions with different ranges.

use std::collections::BTreeSet;

use axon_shm::internal::Location;

use super::*;
use crate::{
    graph::{Endpoint, EndpointKind, EndpointRange, RemoteEndpoint},
    qos::Qos,
    registry::Registry,
    wire::session::{Announce, Attach, Granted, SessionMessage},
};

use DiscoveryRange::{Localhost, Off, Subnet};
use EndpointKind::{Publisher, Subscription};

type Label = &'static str;

const PEER: DaemonId = DaemonId([200; 16]);
const OTHER: DaemonId = DaemonId([201; 16]);
/// The static peer whose address is that of host `PEER`.
const LISTED: &str = "10.0.0.2";
const GATEWAY: u8 = 100;

fn id(number: u8) -> SessionId {
    SessionId([number; 16])
}

fn scope(range: DiscoveryRange, peers: &[&str]) -> Option<Scope> {
    Some(Scope::of(Some(range.number()), peers.iter().map(|peer| (*peer).to_owned()).collect()))
}

/// A daemon with its gateway and one session for each scope, numbered from 1.
struct World {
    registry: Registry<Label>,
}

impl World {
    fn new(scopes: &[Option<Scope>]) -> Self {
        let mut world = Self { registry: Registry::default() };
        world.connect(GATEWAY, SessionRole::Gateway, None);
        for (number, scope) in (1..).zip(scopes) {
            world.connect(number, SessionRole::Application, scope.clone());
        }
        world
    }

    fn connect(&mut self, number: u8, role: SessionRole, scope: Option<Scope>) {
        let handed = Some(["segment", "doorbell", "pidfd"]);
        self.registry.handle_connect(id(number), role, String::new(), 1, handed, scope).unwrap();
        self.drain(number);
    }

    fn drain(&mut self, number: u8) -> Vec<SessionMessage> {
        std::iter::from_fn(|| self.registry.poll_output(&id(number)))
            .map(|output| SessionMessage::decode(&output.packet).unwrap())
            .collect()
    }

    fn announce(&mut self, session: u8, announce: Announce) {
        self.registry
            .handle_message(&id(session), SessionMessage::Endpoint(announce), vec![])
            .unwrap();
    }

    fn own(&mut self, session: u8, number: u32, kind: EndpointKind) -> Gid {
        let gid = Gid::new(id(session), number);
        self.announce(session, of(Endpoint::example(gid, kind), EndpointRole::Application, vec![]));
        gid
    }

    /// Announces the gateway's stand-in for a publisher on another host.
    fn stand_in(&mut self, remote: Gid) {
        let endpoint = Endpoint::example(remote, Publisher);
        self.announce(GATEWAY, of(endpoint, EndpointRole::StandIn, vec![]));
    }

    /// Announces the gateway's relay for subscriptions on other hosts.
    fn relay(&mut self, number: u32, stands_for: Vec<Gid>) -> Gid {
        let gid = Gid::new(id(GATEWAY), number);
        let endpoint = Endpoint::example(gid, Subscription);
        self.announce(GATEWAY, of(endpoint, EndpointRole::Relay, stands_for));
        gid
    }

    fn remote(&mut self, daemon: DaemonId, gid: Gid, kind: EndpointKind, toward: RangeToHost) {
        let remote = RemoteEndpoint { endpoint: Endpoint::example(gid, kind).into(), toward };
        self.registry.remote_graph(daemon, false, vec![remote], vec![]);
    }

    /// Links `PEER` from the address `LISTED`.
    fn link(&mut self) {
        self.registry.relist(|peers| {
            peers.iter().any(|peer| peer == LISTED).then_some(PEER).into_iter().collect()
        });
    }

    fn unlink(&mut self) {
        self.registry.relist(|_| BTreeSet::new());
    }

    fn pairs(&self) -> Vec<Pair> {
        self.registry.pairs.keys().copied().collect()
    }

    /// Adds to and removes from `known` what a session is sent of the graph now.
    fn graph(&mut self, session: u8, known: &mut BTreeSet<Gid>) {
        self.registry.flush();
        for message in self.drain(session) {
            let SessionMessage::Graph(graph) = message else { continue };
            if graph.whole {
                known.clear();
            }
            known.retain(|gid| !graph.removed.contains(gid));
            known.extend(graph.added.iter().map(|item| item.endpoint.gid));
        }
    }

    fn sees(&mut self, session: u8) -> BTreeSet<Gid> {
        let mut known = BTreeSet::new();
        self.registry.handle_message(&id(session), SessionMessage::Resync, vec![]).unwrap();
        self.graph(session, &mut known);
        known
    }
}

fn of(endpoint: Endpoint, role: EndpointRole, stands_for: Vec<Gid>) -> Announce {
    let ring = (endpoint.kind == Publisher).then_some(Location { segment: 0, offset: 4096 });
    Announce { endpoint, role, stands_for, ring, only: None }
}

const REMOTE: Gid = Gid([150; 16]);
const SUBNET: RangeToHost = RangeToHost { range: Subnet, lists: false };
const LOCALHOST: RangeToHost = RangeToHost { range: Localhost, lists: false };

#[test]
fn a_session_with_range_off_matches_only_itself_and_is_hidden() {
    for other in [Subnet, Localhost, Off] {
        let mut world = World::new(&[scope(Off, &[LISTED]), scope(other, &[])]);
        let writer = world.own(1, 1, Publisher);
        let own = world.own(1, 2, Subscription);
        world.own(2, 1, Subscription);
        let seen: Vec<Gid> = world.sees(2).into_iter().filter(|gid| gid.is_of(&id(1))).collect();
        assert_eq!(world.pairs(), [Pair { reader: own, writer }], "{other:?}");
        assert!(seen.is_empty(), "{other:?}");
        assert_eq!(world.sees(1), BTreeSet::from([writer, own]), "{other:?}");
        assert!(!world.sees(GATEWAY).contains(&writer), "it goes to no other host");
        let kept = world.registry.kept_apart(10, 100);
        assert_eq!(kept.len(), 1);
        assert_eq!(kept[0].why, OutOfRange::Off);
    }
}

#[test]
fn a_localhost_session_meets_another_host_only_where_one_lists_the_other() {
    for (own, peers, remote, expected) in [
        (Subnet, &[][..], SUBNET, true),
        (Localhost, &[], SUBNET, false),
        (Localhost, &[LISTED], SUBNET, true),
        (Localhost, &["10.0.0.3"], SUBNET, false),
        (Subnet, &[], LOCALHOST, false),
        (Subnet, &[LISTED], LOCALHOST, true),
        (Localhost, &[], RangeToHost { lists: true, ..SUBNET }, true),
        (Localhost, &[], RangeToHost { lists: true, ..LOCALHOST }, true),
        (Off, &[LISTED], RangeToHost { lists: true, ..SUBNET }, false),
    ] {
        let case = format!("{own:?} {peers:?} {remote:?}");
        let mut world = World::new(&[scope(own, peers)]);
        world.link();
        let reader = world.own(1, 1, Subscription);
        // In either order, because the two come in different ways.
        world.stand_in(REMOTE);
        assert!(world.pairs().is_empty(), "nothing is known of it yet");
        world.remote(PEER, REMOTE, Publisher, remote);
        assert_eq!(world.pairs().len(), usize::from(expected), "{case}");
        assert_eq!(world.sees(1).contains(&REMOTE), expected, "{case}");
        assert_eq!(world.registry.kept_apart(10, 100).is_empty(), expected, "{case}");

        let writer = world.own(1, 2, Publisher);
        let subscription = Gid([151; 16]);
        let relay = world.relay(1, vec![subscription]);
        let pair = Pair { reader: relay, writer };
        assert!(!world.pairs().contains(&pair), "{case}");
        world.remote(PEER, subscription, Subscription, remote);
        assert_eq!(world.pairs().contains(&pair), expected, "{case}");
        assert!(world.pairs().contains(&Pair { reader, writer }), "{case}");
    }
}

#[test]
fn a_session_without_a_range_is_localhost() {
    let mut world = World::new(&[Some(Scope::of(None, vec![LISTED.into()]))]);
    world.link();
    world.own(1, 1, Subscription);
    world.stand_in(REMOTE);
    world.remote(PEER, REMOTE, Publisher, SUBNET);
    assert!(world.pairs().is_empty());
}

#[test]
fn pairs_outlast_the_silence_of_a_host_whose_endpoints_left_the_graph() {
    let mut world = World::new(&[scope(Subnet, &[LISTED])]);
    let (writer, reader) = (world.own(1, 1, Publisher), world.own(1, 2, Subscription));
    let [one, two] = [151, 152].map(|number| Gid([number; 16]));
    let relay = world.relay(1, vec![one]);
    world.stand_in(REMOTE);
    world.remote(PEER, one, Subscription, SUBNET);
    world.remote(PEER, REMOTE, Publisher, SUBNET);
    let far = [Pair { reader: relay, writer }, Pair { reader, writer: REMOTE }];
    let is_whole = |world: &World| far.iter().all(|pair| world.pairs().contains(pair));
    assert!(is_whole(&world));

    world.registry.remote_gone(&PEER);
    // The lists change, and another subscription joins there, before anything is known of it.
    world.link();
    world.unlink();
    let endpoint = Endpoint::example(relay, Subscription);
    world.announce(GATEWAY, of(endpoint, EndpointRole::Relay, vec![one, two]));
    assert!(is_whole(&world), "{:?}", world.pairs());

    // It is back, and out of range now.
    world.remote(PEER, one, Subscription, LOCALHOST);
    world.remote(PEER, two, Subscription, LOCALHOST);
    world.remote(PEER, REMOTE, Publisher, LOCALHOST);
    assert!(!far.iter().any(|pair| world.pairs().contains(pair)), "{:?}", world.pairs());
}

#[test]
fn pairs_and_graph_follow_a_link_that_comes_and_goes() {
    let mut world = World::new(&[scope(Localhost, &[LISTED]), scope(Localhost, &[])]);
    let writer = world.own(1, 1, Publisher);
    let unlisted = world.own(2, 1, Publisher);
    let subscription = Gid([151; 16]);
    let relay = world.relay(1, vec![subscription]);
    let pair = Pair { reader: relay, writer };
    world.remote(PEER, subscription, Subscription, SUBNET);
    let mut seen = [BTreeSet::new(), BTreeSet::new()];
    for _ in 0..2 {
        assert!(world.pairs().is_empty());
        world.link();
        assert_eq!(world.pairs(), [pair]);
        for (session, seen) in (1..).zip(&mut seen) {
            world.graph(session, seen);
        }
        assert!(seen[0].contains(&subscription) && !seen[1].contains(&subscription));
        // The information by which the gateway decides.
        world.registry.flush();
        let told = world.drain(GATEWAY);
        let reach = told.iter().rev().find_map(|message| match message {
            SessionMessage::Graph(graph) => {
                graph.added.iter().find(|item| item.endpoint.gid == writer)?.reach.clone()
            }
            _ => None,
        });
        assert_eq!(reach, Some(EndpointRange { range: Localhost, lists: vec![PEER] }));
        world.unlink();
        assert!(world.pairs().is_empty(), "another address is another host");
        let told = world.drain(1);
        let parted =
            |m: &SessionMessage| matches!(m, SessionMessage::Unmatch(u) if u.writer == writer);
        assert!(told.iter().any(parted), "{told:?}");
        world.registry.handle_message(&id(1), SessionMessage::Resync, vec![]).unwrap();
        world.graph(1, &mut seen[0]);
        assert!(!seen[0].contains(&subscription));
        assert!(seen[0].contains(&unlisted));
    }
}

#[test]
fn a_hosts_range_for_its_own_session_is_followed() {
    let mut world = World::new(&[scope(Localhost, &[])]);
    world.own(1, 1, Subscription);
    world.stand_in(REMOTE);
    for lists in [false, true, false, true] {
        world.remote(PEER, REMOTE, Publisher, RangeToHost { range: Subnet, lists });
        assert_eq!(world.pairs().len(), usize::from(lists));
        assert_eq!(world.sees(1).contains(&REMOTE), lists);
    }
    // Another host's claim about it is ignored.
    world.remote(OTHER, REMOTE, Publisher, SUBNET);
    assert_eq!(world.pairs().len(), 1);
}

#[test]
fn a_publisher_counts_those_of_a_relay_that_it_meets() {
    let mut world = World::new(&[scope(Localhost, &[LISTED])]);
    world.link();
    let writer = world.own(1, 1, Publisher);
    let [met, not_met] = [151, 152].map(|n| Gid([n; 16]));
    world.remote(PEER, met, Subscription, SUBNET);
    world.remote(OTHER, not_met, Subscription, SUBNET);
    let reader = world.relay(1, vec![met, not_met]);
    world.drain(1);
    let place = Location { segment: 0, offset: 4096 };
    let attach = Attach {
        reader,
        writer,
        lane: place,
        qos: Qos::default(),
        session: id(GATEWAY),
        stands_for: Some(vec![met, not_met]),
        segments: vec![],
        after: None,
        carries: None,
    };
    world.registry.handle_message(&id(GATEWAY), SessionMessage::Attach(attach), vec![]).unwrap();
    let stands_for = |told: &[SessionMessage]| {
        told.iter().rev().find_map(|message| match message {
            SessionMessage::Attach(attach) => attach.stands_for.clone(),
            _ => None,
        })
    };
    assert_eq!(stands_for(&world.drain(1)), Some(vec![met]));
    let granted = Granted {
        reader,
        writer,
        generation: 1,
        first: 0,
        session: id(1),
        ring: place,
        segments: vec![],
        after: None,
        relayed: None,
    };
    world.registry.handle_message(&id(1), SessionMessage::Grant(granted), vec![]).unwrap();
    // From now on the other host's session lists this host.
    world.remote(OTHER, not_met, Subscription, RangeToHost { lists: true, ..SUBNET });
    assert_eq!(stands_for(&world.drain(1)), Some(vec![met, not_met]));
    assert_eq!(world.pairs(), [Pair { reader, writer }]);
}

#[test]
fn the_list_of_pairs_out_of_range_is_bounded() {
    let mut world = World::new(&[scope(Off, &[]), scope(Subnet, &[])]);
    for number in 1..=20 {
        world.own(1, number, Publisher);
        world.own(2, number, Subscription);
    }
    assert_eq!(world.registry.kept_apart(64, 1 << 16).len(), 64);
    assert!(world.registry.kept_apart(64, 100).len() <= 64);
    assert_eq!(world.registry.kept_apart(0, 100).len(), 0);
}
