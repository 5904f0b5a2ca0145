//! Tests peers whose daemon ignores all rules: calls, traffic after a change of the rules, elections, restarts, and
//! several daemons of one identity.

use axon_envelope::Kind;
use axon_shm::{
    ids::{DaemonId, Gid},
    qos::Qos,
};
use axon_transport::{
    access::AccessRules,
    config::Config,
    graph::{Endpoint, EndpointKind},
};

use super::{
    super::{
        hostile::{
            HIGHEST, LOWEST, asked, dial, elect, greet, messages, of_raw, publishes, samples, say,
            subscribe,
        },
        memory::{gid, linked_as},
    },
    access::{OPEN, denied, hosts, link},
};
use crate::{
    engine::sim::{
        tests::{millis, secs},
        world::World,
    },
    link::{GraphUpdate, LinkMessage, RouteSubscriber, Subscribe},
};

/// Creates a host with rules, and a raw peer.
fn world(rules: &str, daemon: DaemonId) -> World {
    let mut world = World::new(37, 1, |_| {
        let mut config = Config::default();
        config.access = AccessRules::parse(rules, "access.toml").unwrap();
        config
    });
    world.add_raw(Config::default(), daemon);
    world
}

/// Makes the peer open a stream with these bytes.
fn open(world: &mut World, on: usize, bytes: Vec<u8>) -> Option<quinn_proto::StreamId> {
    world.with_raw(0, |raw, _| raw.links[on].open(bytes))
}

/// Returns whether the host asked for this topic on a link.
fn asks(world: &World, on: usize, topic: &str) -> bool {
    let asks = |m: &LinkMessage| matches!(m, LinkMessage::Subscribe(s) if s.topic == topic);
    world.raws[0].links[on].messages.iter().any(asks)
}

fn received(world: &World, reader: Gid, writer: Gid) -> Vec<u64> {
    world.hosts[0].rings.received(reader, writer)
}

#[test]
fn denied_requests_and_responses_of_a_hostile_peer_reach_no_endpoint() {
    const RULES: &str = "[[deny]]\npeer = \"*\"\ncall = \"/closed\"\nserve = \"/closed\"";
    let mut world = world(RULES, LOWEST);
    let rings = world.hosts[0].rings.clone();
    let names = ["/open", "/closed"];
    let servers = names.map(|name| rings.create_of_service(EndpointKind::Server, name));
    let clients = names.map(|name| rings.create_of_service(EndpointKind::Client, name));
    world.hosts[0].touch_graph();
    let on = dial(&mut world, 0);
    greet(&mut world, on, None);
    say(&mut world, on, &elect(1));
    world.run_for(millis(200));
    let [caller, answerer] = [of_raw(1), of_raw(2)];
    let endpoints = names.iter().flat_map(|name| {
        [(caller, EndpointKind::Client), (answerer, EndpointKind::Server)].map(|(mut gid, kind)| {
            gid.0[14] = name.len() as u8;
            Endpoint::new(gid, kind, *name, "T").with_qos(Qos::keep_all()).with_node("node", "/")
        })
    });
    let added: Vec<_> = endpoints.collect();
    let gids: Vec<_> = added.iter().map(|endpoint| endpoint.gid).collect();
    say(
        &mut world,
        on,
        &LinkMessage::Graph(GraphUpdate { version: 1, added, ..GraphUpdate::default() }),
    );
    // The peer also asks for data that it may not have: requests of the client, and responses of the server. A host
    // accepts the responses of servers that take its requests.
    let asks_for =
        [("/open", 100, 1, gids[1]), ("/closed", 101, 1, gids[3]), ("/closed", 102, 2, gids[2])];
    for (name, route, kind, reader) in asks_for {
        let message = LinkMessage::Subscribe(Subscribe {
            route,
            topic: name.into(),
            type_name: "T".into(),
            kind,
            subscribers: vec![RouteSubscriber { gid: reader, qos: Qos::keep_all() }],
            last: Vec::new(),
            acknowledges: Some(true),
            short_headers: None,
        });
        say(&mut world, on, &message);
    }
    asked(&mut world, on, "/open");
    world.run_for(secs(1));
    // It guesses the numbers of all routes, in each of which it sends all that it could.
    for route in 0..6 {
        for (at, name) in names.iter().enumerate() {
            let [caller, answerer] = [gids[2 * at], gids[2 * at + 1]];
            let request = messages(Kind::Request, route, name, (caller, caller), 1..=3);
            let answer = messages(Kind::Response, route, name, (answerer, clients[at]), 1..=3);
            open(&mut world, on, request);
            open(&mut world, on, answer);
        }
    }
    world.run_for(secs(3));
    assert_eq!(received(&world, servers[0], gids[0]), [1, 2, 3], "{}", world.describe());
    assert_eq!(received(&world, clients[0], gids[1]), [1, 2, 3], "{}", world.describe());
    let reached = [(servers[1], gids[2]), (clients[1], gids[3])]
        .map(|(reader, writer)| received(&world, reader, writer));
    assert!(reached.iter().all(Vec::is_empty), "{reached:?}");
    assert!(!asks(&world, on, "/closed"));
    let messages = &world.raws[0].links[on].messages;
    let refused = messages.iter().filter_map(|message| match message {
        LinkMessage::RouteRefused(refused) => Some((refused.route, &*refused.reason)),
        _ => None,
    });
    let refused: Vec<_> = refused.collect();
    let [call, serve] = [3, 4].map(|line| format!("denied by line {line} of access.toml"));
    assert_eq!(refused, [(101, &*serve), (102, &*call)]);
    assert!(world.raws[0].links[on].opened.is_empty(), "nothing was sent");
}

#[test]
fn samples_and_subscribes_after_a_denial_are_neither_delivered_nor_served() {
    let mut world = world(OPEN, LOWEST);
    let qos = Qos::keep_all();
    let subscription = world.hosts[0].rings.create_subscription("/t", qos, None);
    let publisher = world.hosts[0].rings.create_publisher("/t", qos);
    world.hosts[0].touch_graph();
    let on = dial(&mut world, 0);
    greet(&mut world, on, None);
    say(&mut world, on, &elect(1));
    say(&mut world, on, &publishes("/t", of_raw(1), qos));
    let route = asked(&mut world, on, "/t");
    let stream = open(&mut world, on, samples(route, "/t", of_raw(1), 1..=3)).unwrap();
    say(&mut world, on, &subscribe(7, "/t", qos));
    world.run_for(secs(1));
    world.hosts[0].rings.publish(publisher, 10);
    world.hosts[0].ring();
    world.run_for(secs(1));
    assert_eq!(received(&world, subscription, of_raw(1)), [1, 2, 3]);
    assert_eq!(world.raws[0].links[on].opened.len(), 1, "the peer is served");

    for round in 0..3u64 {
        world.hosts[0].set_access("[[deny]]\npeer = \"*\"\npublish = \"/t\"\nsubscribe = \"/t\"");
        world.run_for(millis(50));
        let before = world.raws[0].links[on].opened.len();
        let came = received(&world, subscription, of_raw(1)).len();
        world.raws[0].links[on].messages.clear();
        // The peer sends more on the same stream, opens further streams of the same route, and repeats the request.
        for number in 0..20 {
            let next = 10 + 100 * round + number;
            let more = samples(route, "/t", of_raw(1), [next]).split_off(24);
            world.with_raw(0, |raw, _| raw.links[on].write_to(stream, more.into()));
            open(&mut world, on, samples(route, "/t", of_raw(1), [next]));
            say(&mut world, on, &subscribe(7 + number as u32, "/t", qos));
            world.hosts[0].rings.publish(publisher, 10);
            world.hosts[0].ring();
            world.run_for(millis(20));
        }
        world.run_for(secs(2));
        assert_eq!(received(&world, subscription, of_raw(1)).len(), came, "{}", world.describe());
        assert_eq!(world.raws[0].links[on].opened.len(), before, "no sample was sent");
        assert!(!asks(&world, on, "/t"));
        let messages = &world.raws[0].links[on].messages;
        assert!(messages.iter().any(|message| matches!(message, LinkMessage::RouteRefused(_))));
        assert!(denied(&world, 0).contains("publish /t"), "{}", denied(&world, 0));

        world.hosts[0].set_access(OPEN);
        world.run_for(secs(2));
        // The host asks again, and samples on that route arrive.
        let route = asked(&mut world, on, "/t");
        let number = 60 + 100 * round;
        open(&mut world, on, samples(route, "/t", of_raw(1), [number]));
        world.run_for(secs(1));
        assert_eq!(received(&world, subscription, of_raw(1)).last(), Some(&number));
    }
}

#[test]
fn requests_held_by_a_limit_are_dropped_once_rules_deny_them() {
    const HELD: &str = "default = \"allow\"\n\
        [[limit]]\npeer = \"*\"\ncall = \"/set\"\nrate = 0.1\nburst = 1\nover = \"hold\"\n";
    for denies in [true, false] {
        let mut world = world(HELD, LOWEST);
        let server = world.hosts[0].rings.create_of_service(EndpointKind::Server, "/set");
        world.hosts[0].touch_graph();
        let on = dial(&mut world, 0);
        greet(&mut world, on, None);
        say(&mut world, on, &elect(1));
        let client = Endpoint::new(of_raw(1), EndpointKind::Client, "/set", "T")
            .with_qos(Qos::keep_all())
            .with_node("node", "/");
        let graph = GraphUpdate { version: 1, added: vec![client], ..GraphUpdate::default() };
        say(&mut world, on, &LinkMessage::Graph(graph));
        let route = asked(&mut world, on, "/set");
        let requests = messages(Kind::Request, route, "/set", (of_raw(1), of_raw(1)), 1..=4);
        open(&mut world, on, requests);
        world.run_for(secs(2));
        assert_eq!(received(&world, server, of_raw(1)), [1], "the others are held");
        let rules = if denies { "[[deny]]\npeer = \"*\"\ncall = \"/set\"" } else { OPEN };
        world.hosts[0].set_access(rules);
        world.run_for(secs(60));
        let all = if denies { 1..=1 } else { 1..=4 };
        assert_eq!(received(&world, server, of_raw(1)), all.collect::<Vec<u64>>());
        assert!(world.raws[0].links[on].closed.is_none(), "{}", world.describe());
    }
}

#[test]
fn changed_rules_apply_during_handshake_election_and_succession() {
    const CLOSED: &str = "[[deny]]\npeer = \"*\"\npublish = \"/t\"";
    let mut world = world(OPEN, LOWEST);
    let subscription = world.hosts[0].rings.create_subscription("/t", Qos::keep_all(), None);
    world.hosts[0].rings.create_subscription("/other", Qos::keep_all(), None);
    world.hosts[0].touch_graph();
    let first = dial(&mut world, 0);
    greet(&mut world, first, None);
    world.hosts[0].set_access(CLOSED);
    world.run_for(millis(1));
    say(&mut world, first, &elect(1));
    let publish = |world: &mut World, on: usize, version: u64| {
        let LinkMessage::Graph(mut graph) = publishes("/t", of_raw(1), Qos::keep_all()) else {
            return;
        };
        let other = publishes("/other", of_raw(2), Qos::keep_all());
        let LinkMessage::Graph(other) = other else { return };
        graph.added.extend(other.added);
        say(world, on, &LinkMessage::Graph(GraphUpdate { version, ..graph }));
    };
    publish(&mut world, first, 1);
    asked(&mut world, first, "/other");
    world.run_for(secs(1));
    assert!(!asks(&world, first, "/t"), "closed before the election");

    world.hosts[0].set_access(OPEN);
    let route = asked(&mut world, first, "/t");
    open(&mut world, first, samples(route, "/t", of_raw(1), 1..=2));
    world.run_for(secs(1));
    assert_eq!(received(&world, subscription, of_raw(1)), [1, 2]);
    // A successor that sent HELLO while the rules were open is elected after they were closed.
    let second = dial(&mut world, 0);
    greet(&mut world, second, Some([1; 16]));
    world.hosts[0].set_access(CLOSED);
    world.run_for(millis(1));
    say(&mut world, second, &elect(2));
    world.run_for(millis(1));
    for on in [first, second] {
        open(&mut world, on, samples(route, "/t", of_raw(1), 3..=9));
    }
    world.run_for(secs(3));
    assert_eq!(received(&world, subscription, of_raw(1)), [1, 2], "{}", world.describe());
    assert!(!asks(&world, second, "/t"));
    assert!(denied(&world, 0).contains("publish /t"), "{}", denied(&world, 0));
}

#[test]
fn rules_hold_for_daemons_that_are_started_again_on_either_side() {
    const CLOSED: &str = "[[deny]]\npeer = \"*\"\npublish = \"/closed\"\nsubscribe = \"/closed\"";
    for with_rules in [0, 1] {
        let mut world = hosts(with_rules, CLOSED);
        let [closed, open] =
            ["/closed", "/open"].map(|topic| world.pair(0, 1, topic, Qos::keep_all()));
        for restarted in [0, 1, 0] {
            world.until(secs(20), World::is_linked);
            world.run_for(secs(2));
            let before = world.received(open).len();
            assert!(world.publish(open, 10) && world.publish(closed, 10));
            world.run_for(secs(2));
            assert!(world.received(open).len() > before, "{}", world.describe());
            assert!(world.received(closed).is_empty(), "{restarted}");
            assert!(!link(&world, with_rules).denied.is_empty());
            world.kill(restarted, false);
            world.run_for(millis(100));
            world.restart(restarted);
        }
    }
}

#[test]
fn daemons_of_one_identity_have_its_rules_and_share_its_bucket() {
    const RULES: &str = "[[deny]]\npeer = \"address:*\"\npublish = \"/closed\"\n\
        [[limit]]\npeer = \"*\"\npublish = \"/t\"\nrate = 1\nburst = 10\ntogether = true\n";
    let mut world = world(RULES, HIGHEST);
    let rings = world.hosts[0].rings.clone();
    let [closed, limited] =
        ["/closed", "/t"].map(|topic| rings.create_subscription(topic, Qos::keep_all(), None));
    world.hosts[0].touch_graph();
    let mut came = 0;
    for id in 0xf0..0xf4 {
        let on = linked_as(&mut world, 0, id);
        let publisher = gid(id, 1);
        let graph = |topic, number| {
            let LinkMessage::Graph(graph) = publishes(topic, gid(id, number), Qos::keep_all())
            else {
                unreachable!()
            };
            graph.added
        };
        let added = [graph("/t", 1), graph("/closed", 2)].concat();
        say(
            &mut world,
            on,
            &LinkMessage::Graph(GraphUpdate { version: 1, added, ..GraphUpdate::default() }),
        );
        let route = asked(&mut world, on, "/t");
        open(&mut world, on, samples(route, "/t", publisher, 1..=50));
        for route in route..route + 3 {
            open(&mut world, on, samples(route, "/closed", gid(id, 2), 1..=3));
        }
        world.run_for(secs(1));
        came += received(&world, limited, publisher).len();
        assert!(received(&world, closed, gid(id, 2)).is_empty());
        assert!(!asks(&world, on, "/closed"));
    }
    assert!((10..=20).contains(&came), "{came} of 200, {}", world.describe());
}

#[test]
fn denied_peer_cannot_announce_or_block_an_endpoint_of_a_permitted_peer() {
    for claims_first in [true, false] {
        let mut world = World::apart(41, 2, |_| Config::default());
        world.add_raw(Config::default(), LOWEST);
        let pair = world.pair(1, 0, "/cmd_vel", Qos::keep_all());
        let publisher = pair.publisher.1;
        let subscription = pair.subscription.1;
        world.hosts[0].rings.create_subscription("/open", Qos::keep_all(), None);
        let denied_here = format!(
            "[[deny]]\npeer = \"address:{}\"\npublish = \"/cmd_vel\"",
            world.raws[0].address
        );
        world.hosts[0].set_access(&denied_here);
        let link_owner = |world: &mut World| {
            world.tell(1, 0);
            world.until(secs(5), |world| world.hosts[0].linked().contains(&world.hosts[1].daemon));
            world.run_for(secs(1));
        };
        if !claims_first {
            link_owner(&mut world);
        }
        let on = dial(&mut world, 0);
        greet(&mut world, on, None);
        say(&mut world, on, &elect(1));
        let LinkMessage::Graph(mut graph) = publishes("/cmd_vel", publisher, Qos::keep_all())
        else {
            unreachable!()
        };
        let LinkMessage::Graph(other) = publishes("/open", of_raw(2), Qos::keep_all()) else {
            unreachable!()
        };
        graph.added.extend(other.added);
        say(&mut world, on, &LinkMessage::Graph(graph));
        let route = asked(&mut world, on, "/open");
        let pretend = |world: &mut World, numbers: std::ops::RangeInclusive<u64>| {
            for route in [route, route + 1, route + 2] {
                open(world, on, samples(route, "/cmd_vel", publisher, numbers.clone()));
            }
            world.run_for(secs(1));
        };
        pretend(&mut world, 1..=3);
        assert!(received(&world, subscription, publisher).is_empty(), "{claims_first}");
        if claims_first {
            link_owner(&mut world);
        }
        (0..5).for_each(|_| assert!(world.publish(pair, 10)));
        world.run_for(secs(2));
        assert_eq!(world.received(pair), [1, 2, 3, 4, 5], "{claims_first}: {}", world.describe());
        pretend(&mut world, 6..=9);
        // Also where the rules permit it by now: the endpoint has its host.
        world.hosts[0].set_access(OPEN);
        world.run_for(secs(2));
        pretend(&mut world, 6..=9);
        assert_eq!(world.received(pair), [1, 2, 3, 4, 5], "{claims_first}: {}", world.describe());
        assert!(!asks(&world, on, "/cmd_vel"));
        assert!(world.publish(pair, 10));
        world.run_for(secs(2));
        assert_eq!(
            world.received(pair),
            [1, 2, 3, 4, 5, 6],
            "{claims_first}: {}",
            world.describe()
        );
    }
}
