//! Tests the daemon's reaction to single messages.

use super::*;

fn connected(sessions: u8) -> World {
    let mut world = World::default();
    (0..sessions).for_each(|s| world.take(Step::Connect(s)));
    world
}

fn first(world: &World) -> SessionId {
    world.clients[&0].id
}

#[test]
fn forged_session_messages_are_violations() {
    let mut world = connected(2);
    let (own, other) = (first(&world), world.clients[&1].id);
    let registry = &mut world.registry;
    let foreign = endpoint(Gid::new(other, 1), EndpointKind::Subscription, 0, Qos::default());
    let stolen = registry.handle_message(&own, announce(foreign.clone()), vec![]);
    assert_eq!(stolen, Err(Violation::NotItsOwn(foreign.gid)));
    registry.handle_message(&other, announce(foreign.clone()), vec![]).unwrap();
    let gone = registry.handle_message(
        &own,
        SessionMessage::EndpointGone(Gone { gid: foreign.gid }),
        vec![],
    );
    assert_eq!(gone, Err(Violation::NotItsOwn(foreign.gid)));

    let writer = endpoint(Gid::new(own, 1), EndpointKind::Publisher, 0, Qos::default());
    let role = EndpointRole::Application;
    let endpoint = writer.clone();
    let placeless = Announce { endpoint, role, stands_for: vec![], ring: None, only: None };
    let placeless = registry.handle_message(&own, SessionMessage::Endpoint(placeless), vec![]);
    assert_eq!(placeless, Err(Violation::Unexpected));
    let segment = Segment { number: 3, publisher: None };
    let opened = SessionMessage::Segment(SegmentOpened { session: own, segment });
    for fds in [vec![], vec![(own, "map"); 2]] {
        let opened = registry.handle_message(&own, opened.clone(), fds);
        assert!(matches!(opened, Err(Violation::Descriptors(_))));
    }
    registry.handle_message(&own, opened.clone(), vec![(own, "map")]).unwrap();
    let twice = registry.handle_message(&own, opened, vec![(own, "map")]);
    assert_eq!(twice, Err(Violation::Segments(3)));
    for role in [EndpointRole::StandIn, EndpointRole::Relay] {
        let taken = registry.handle_message(&own, announce_as(writer.clone(), role), vec![]);
        assert_eq!(taken, Err(Violation::NotItsOwn(writer.gid)), "{role:?}");
    }
    let littered = registry.handle_message(&own, SessionMessage::Resync, vec![(own, "ring")]);
    assert_eq!(littered, Err(Violation::Descriptors(1)));
    assert_eq!(
        registry.handle_message(&own, SessionMessage::StatusRequest, vec![]),
        Err(Violation::Unexpected)
    );
    let pair = Pair { reader: foreign.gid, writer: writer.gid };
    assert_eq!(
        registry.handle_message(&own, SessionMessage::Match(pair), vec![]),
        Err(Violation::Unexpected)
    );
    assert_eq!(
        registry.handle_message(&own, SessionMessage::Detach(pair), vec![]),
        Err(Violation::NotItsOwn(foreign.gid))
    );
}

#[test]
fn an_endpoint_out_of_bounds_is_refused_and_the_session_goes_on() {
    let mut world = connected(1);
    let own = first(&world);
    while world.registry.poll_output(&own).is_some() {}
    let mut huge = endpoint(Gid::new(own, 1), EndpointKind::Subscription, 0, Qos::default());
    huge.topic = "x".repeat(1000);
    world.registry.handle_message(&own, announce(huge), vec![]).unwrap();
    let answer = world.registry.poll_output(&own).unwrap();
    assert!(matches!(SessionMessage::decode(&answer.packet).unwrap(), SessionMessage::Refused(_)));
    assert_eq!(world.registry.endpoints().count(), 0);
}

fn connect_gateway(world: &mut World) -> SessionId {
    let (gateway, name) = (session_id(200), String::new());
    let registry = &mut world.registry;
    registry
        .handle_connect(gateway, SessionRole::Gateway, name, 1, Some(handed(gateway)), None)
        .unwrap();
    gateway
}

#[test]
fn a_sample_never_goes_back_to_where_it_came_from() {
    let mut world = connected(1);
    let gateway = connect_gateway(&mut world);
    let own = first(&world);
    let remote = endpoint(Gid([9; 16]), EndpointKind::Publisher, 0, Qos::default());
    let relay = endpoint(Gid::new(gateway, 1), EndpointKind::Subscription, 0, Qos::default());
    let local = endpoint(Gid::new(own, 1), EndpointKind::Subscription, 0, Qos::default());
    let talker = endpoint(Gid::new(own, 2), EndpointKind::Publisher, 0, Qos::default());
    let say = |registry: &mut Registry<Label>, who, endpoint: &Endpoint, role| {
        registry.handle_message(&who, announce_as(endpoint.clone(), role), vec![]).unwrap();
    };
    say(&mut world.registry, gateway, &remote, EndpointRole::StandIn);
    say(&mut world.registry, gateway, &relay, EndpointRole::Relay);
    say(&mut world.registry, own, &local, EndpointRole::Application);
    say(&mut world.registry, own, &talker, EndpointRole::Application);
    let pairs: Vec<Pair> = world.registry.pairs.keys().copied().collect();
    let expected = [
        Pair { reader: local.gid, writer: remote.gid },
        Pair { reader: local.gid, writer: talker.gid },
        Pair { reader: relay.gid, writer: talker.gid },
    ];
    assert_eq!(pairs.iter().collect::<BTreeSet<_>>(), expected.iter().collect());
    // Sessions see neither of them as an endpoint of this host.
    world.registry.flush();
    let shown: BTreeSet<Gid> = world
        .registry
        .whole_graph(&own)
        .iter()
        .flat_map(|packet| match SessionMessage::decode(packet).unwrap() {
            SessionMessage::Graph(graph) => graph.added,
            other => panic!("{other:?}"),
        })
        .map(|item| item.endpoint.gid)
        .collect();
    assert_eq!(shown, [local.gid, talker.gid].into());
}

#[test]
fn ends_of_a_service_elsewhere_meet_those_here_and_never_each_other() {
    let mut world = connected(1);
    let gateway = connect_gateway(&mut world);
    let own = first(&world);
    let of = |gid, kind| endpoint(gid, kind, 0, Qos::default());
    let (client, server) =
        (of(Gid::new(own, 1), EndpointKind::Client), of(Gid::new(own, 2), EndpointKind::Server));
    let there = [(7, EndpointKind::Client), (8, EndpointKind::Server)];
    let there = there.map(|(number, kind)| of(Gid([number; 16]), kind));
    let registry = &mut world.registry;
    for stand_in in &there {
        let message = announce_as(stand_in.clone(), EndpointRole::StandIn);
        let claimed = registry.handle_message(&own, message.clone(), vec![]);
        assert_eq!(claimed, Err(Violation::NotItsOwn(stand_in.gid)));
        registry.handle_message(&gateway, message, vec![]).unwrap();
    }
    for endpoint in [&client, &server] {
        registry.handle_message(&own, announce(endpoint.clone()), vec![]).unwrap();
    }
    let both = |one: &Endpoint, other: &Endpoint| {
        [(one.gid, other.gid), (other.gid, one.gid)].map(|(reader, writer)| Pair { reader, writer })
    };
    let expected = [both(&client, &server), both(&there[0], &server), both(&client, &there[1])];
    let pairs: BTreeSet<Pair> = registry.pairs.keys().copied().collect();
    assert_eq!(pairs, expected.into_iter().flatten().collect());
}

#[test]
fn a_gid_in_use_cannot_be_claimed_by_another_host() {
    let mut world = connected(1);
    let own = first(&world);
    let local = endpoint(Gid::new(own, 1), EndpointKind::Subscription, 0, Qos::default());
    let (a, b) = (DaemonId([1; 16]), DaemonId([2; 16]));
    let remote = endpoint(Gid([9; 16]), EndpointKind::Publisher, 0, Qos::default());
    // Another host claims the GID before its session announces it.
    world.registry.remote_graph(a, true, vec![local.clone(), remote.clone()], vec![]);
    world.registry.handle_message(&own, announce(local.clone()), vec![]).unwrap();
    world.registry.remote_graph(b, true, vec![local.clone(), remote.clone()], vec![]);
    let of: Vec<_> = world.registry.remote_endpoints().map(|(d, e)| (*d, e.gid)).collect();
    assert_eq!(of, [(a, remote.gid)]);
    // Nor can one host remove an endpoint of the other.
    world.registry.remote_graph(b, false, Vec::<Endpoint>::new(), vec![remote.gid]);
    assert_eq!(world.registry.remote_endpoints().count(), 1);
}

#[test]
fn a_tombstone_reaches_sessions_that_connect_later() {
    let mut world = connected(1);
    let own = first(&world);
    let gid = Gid::new(own, 7);
    world
        .registry
        .handle_message(&own, SessionMessage::EndpointGone(Gone { gid }), vec![])
        .unwrap();
    world.take(Step::Connect(1));
    let late = world.clients[&1].id;
    let mut removed = Vec::new();
    while let Some(output) = world.registry.poll_output(&late) {
        if let SessionMessage::Graph(graph) = SessionMessage::decode(&output.packet).unwrap() {
            removed.extend(graph.ended.unwrap_or_default());
        }
    }
    assert!(removed.contains(&gid));
}

#[test]
fn a_detached_pair_is_over_at_both_ends() {
    let mut world = connected(2);
    world.take(Step::Add { session: 0, topic: 0, writes: true, reliable: true });
    world.take(Step::Add { session: 1, topic: 0, writes: false, reliable: true });
    world.settle();
    let pair = *world.clients[&1].attached.first().unwrap();
    let reader = world.clients.get_mut(&1).unwrap();
    reader.outgoing.push((SessionMessage::Detach(pair), vec![]));
    world.settle();
    for client in world.clients.values() {
        assert!(client.attached.is_empty() && client.held.is_empty());
        assert!(world.registry.session(&client.id).unwrap().held.pairs().is_empty());
    }
}

#[test]
fn sessions_with_more_pairs_than_their_queues_hold_come_to_rest() {
    let mut world = connected(2);
    world.settle();
    for number in 0..32 {
        let (session, writes) = (number % 2, number % 4 < 2);
        world.take(Step::Add { session, topic: 0, writes, reliable: true });
    }
    world.settle();
    world.check_settled();
}

#[test]
fn a_large_graph_is_told_in_packets_that_fit() {
    let mut world = connected(1);
    let added = (0..3000u32).map(|n| {
        let gid = Gid::new(session_id(77), n);
        Endpoint {
            topic: "t".repeat(400),
            ..endpoint(gid, EndpointKind::Publisher, 0, Qos::default())
        }
    });
    world.registry.remote_graph(DaemonId([1; 16]), true, added, vec![]);
    world.settle();
    assert_eq!(world.clients[&0].graph.len(), 3000);
}

#[test]
fn a_remote_endpoint_that_comes_and_goes_ends_nothing_here() {
    let mut world = connected(1);
    let own = first(&world);
    while world.registry.poll_output(&own).is_some() {}
    let gid = Gid([9; 16]);
    let endpoint = Endpoint::example(gid, EndpointKind::Publisher);
    // A successor link repeats the whole graph within one flush.
    for _ in 0..2 {
        world.registry.remote_graph(DaemonId([1; 16]), true, vec![endpoint.clone()], vec![]);
    }
    world.registry.flush();
    let mut seen = false;
    while let Some(output) = world.registry.poll_output(&own) {
        if let SessionMessage::Graph(graph) = SessionMessage::decode(&output.packet).unwrap() {
            assert_eq!(graph.ended.unwrap_or_default(), vec![]);
            seen |= graph.added.iter().any(|item| item.endpoint.gid == gid);
        }
    }
    assert!(seen);
}
