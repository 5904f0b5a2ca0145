//! Tests the memory that peers make this host hold for incomplete messages, and that honest peers still get through.

use std::time::Duration;

use axon_envelope::inner;
use axon_shm::{
    ids::{DaemonId, Gid},
    qos::{Durability, Qos},
};
use axon_transport::{
    config::Config,
    graph::{Endpoint, EndpointKind},
};
use bytes::Bytes;

use crate::{
    engine::{
        sample::stream_header::StreamHeader,
        sim::{
            network::{Path, Rate},
            rings::FOREIGN,
            tests::{millis, secs},
            world::World,
        },
    },
    link::{GraphUpdate, LinkHello, LinkMessage, RouteReady, RouteSubscriber, Subscribe},
};

/// Publishers of one topic of the hostile peer: the maximum that one route shows.
const PUBLISHERS: u32 = 1024;
/// Bytes of each message that arrive, and the length that the message states.
const COMES: usize = 31 << 10;
const SAYS: u32 = 32 << 10;

/// Makes a raw peer dial under a daemon id. Returns its link once it is elected.
pub(super) fn linked_as(world: &mut World, peer: usize, id: u8) -> usize {
    let to = world.hosts[0].address;
    let number = world.with_raw(peer, |raw, now| raw.dial(to, now));
    world.until(secs(5), |world| world.raws[peer].links[number].connected);
    world.with_raw(peer, |raw, _| {
        let hello = LinkHello { daemon: DaemonId([id; 16]), ..raw.hello() };
        raw.links[number].say(&LinkMessage::Hello(hello));
    });
    world.until(secs(5), |world| world.raws[peer].links[number].is_elected());
    number
}

/// Returns the GID of an endpoint that a daemon id announces.
pub(super) fn gid(id: u8, number: u32) -> Gid {
    let mut gid = [0; 16];
    gid[..12].copy_from_slice(&FOREIGN);
    gid[12..].copy_from_slice(&(u32::from(id) << 16 | number).to_be_bytes());
    Gid(gid)
}

fn endpoint(kind: EndpointKind, gid: Gid, topic: &str) -> Endpoint {
    Endpoint::new(gid, kind, topic, "T").with_qos(Qos::keep_all()).with_node("node", "/")
}

/// Announces `count` publishers of a topic.
fn publishes(world: &mut World, link: usize, id: u8, topic: &str, count: u32) {
    let publisher = |n| endpoint(EndpointKind::Publisher, gid(id, n), topic);
    let added = (0..count).map(publisher).collect();
    let graph = LinkMessage::Graph(GraphUpdate { version: 1, added, ..GraphUpdate::default() });
    world.with_raw(0, |raw, _| raw.links[link].say(&graph));
}

/// Waits until the host asked for a topic. Returns the number of its route.
fn asked(world: &mut World, link: usize, topic: &str) -> u32 {
    let route = |world: &World| {
        world.raws[0].links[link].messages.iter().find_map(|message| match message {
            LinkMessage::Subscribe(subscribe) if subscribe.topic == topic => Some(subscribe.route),
            _ => None,
        })
    };
    world.until(secs(20), |world| route(world).is_some());
    route(world).unwrap()
}

/// Announces publishers of a topic under a daemon id, and has a stream of each stop before the end of its first
/// message.
fn stop_within_messages(world: &mut World, id: u8) {
    let topic = format!("/topic_{id}");
    world.hosts[0].rings.create_subscription(&topic, Qos::keep_all(), None);
    world.hosts[0].touch_graph();
    let number = linked_as(world, 0, id);
    publishes(world, number, id, &topic, PUBLISHERS);
    let route = asked(world, number, &topic);
    let body = Bytes::from(vec![0x5a; COMES]);
    for publisher in 0..PUBLISHERS {
        world.with_raw(0, |raw, _| {
            let mut bytes = StreamHeader::plain(route, gid(id, publisher)).encode().to_vec();
            bytes.extend_from_slice(&SAYS.to_be_bytes());
            bytes.extend_from_slice(&body);
            raw.links[number].open(bytes).expect("a stream");
        });
    }
    world.run_for(secs(2));
}

#[test]
fn incomplete_short_messages_are_bounded_for_an_identity() {
    let mut world = World::new(80, 1, |_| Config::default());
    world.add_raw(Config::default(), DaemonId([0xff; 16]));
    let rate = Rate::new(1_000_000_000, millis(20));
    let path = Path { delay: millis(1), rate: Some(rate), ..Path::default() };
    world.network.set_default_path(path);
    for id in 0xf0..0xf4 {
        stop_within_messages(&mut world, id);
    }
    let held = world.hosts[0].held_of_messages();
    let asked = 4 * PUBLISHERS as usize * COMES;
    assert!(held <= 18 << 20, "{} MiB of {} MiB", held >> 20, asked >> 20);
    assert!(held > 14 << 20, "as much as it may: {} MiB", held >> 20);
    assert!(world.raws[0].links.iter().all(|link| link.closed.is_none()), "{}", world.describe());
}

/// Creates a host with a reader that takes nothing, and a raw peer that publishes for it. Returns the world, the peer's
/// link, and the route.
pub(super) fn raw_publishers(seed: u64, publishers: u32) -> (World, usize, u32) {
    let mut world = World::new(seed, 1, |_| Config::default());
    world.add_raw(Config::default(), DaemonId([0xff; 16]));
    world.hosts[0].rings.create_subscription("/t", Qos::keep_all(), Some(0));
    world.hosts[0].touch_graph();
    let number = linked_as(&mut world, 0, 0xf0);
    publishes(&mut world, number, 0xf0, "/t", publishers);
    let route = asked(&mut world, number, "/t");
    (world, number, route)
}

#[test]
fn messages_that_become_long_and_wait_for_a_reader_are_bounded() {
    const LENGTH: usize = 8 << 20;
    const MANY: u32 = 40;
    let (mut world, number, route) = raw_publishers(86, MANY);
    let packed = zstd::bulk::compress(&vec![0; LENGTH], 1).unwrap();
    for publisher in 0..MANY {
        let of = gid(0xf0, publisher);
        let header = inner::Header {
            gid: of.0,
            sequence: 1,
            source_timestamp: 0,
            request_id: inner::RequestId::default(),
            compressed: true,
            age_ms: 0,
            uncompressed_len: LENGTH as u32,
        };
        let header = header.encode();
        let mut bytes = StreamHeader::plain(route, of).encode().to_vec();
        bytes.extend_from_slice(&((header.len() + packed.len()) as u32).to_be_bytes());
        bytes.extend_from_slice(&header);
        bytes.extend_from_slice(&packed);
        world.with_raw(0, |raw, _| raw.links[number].open(bytes).expect("a stream"));
    }
    world.run_for(secs(2));
    let held = world.hosts[0].held_of_messages();
    assert!((32 << 20..=65 << 20).contains(&held), "{} MiB", held >> 20);
    assert!(world.raws[0].links[number].closed.is_none(), "{}", world.describe());
}

/// Checks that all messages arrive if `publishers` publishers publish a message of `length` bytes at once, `rounds`
/// times.
fn all_arrive(seed: u64, publishers: usize, length: usize, rounds: u64) {
    let mut world = World::new(seed, 2, |_| Config::default());
    let rate = Rate::new(1_000_000_000, millis(20));
    let path = Path { delay: millis(5), rate: Some(rate), loss: 0.01, ..Path::default() };
    world.network.set_default_path(path);
    let pairs: Vec<_> = (0..publishers)
        .map(|number| world.pair(0, 1, &format!("/topic_{number}"), Qos::keep_all()))
        .collect();
    world.until(secs(20), World::is_whole);
    world.run_for(secs(3));
    for _ in 0..rounds {
        for pair in &pairs {
            assert!(world.publish(*pair, length));
        }
    }
    let all = |world: &World| pairs.iter().all(|pair| world.received(*pair).len() as u64 == rounds);
    world.until(Duration::from_secs(60), all);
}

#[test]
fn messages_of_many_publishers_at_once_arrive_however_long_they_are() {
    all_arrive(81, 12, 8 << 20, 1);
    all_arrive(83, 12, 16 << 20, 1);
    all_arrive(82, 2_200, 31 << 10, 1);
}

fn subscribe(route: u32, topic: &str, subscriber: Gid) -> LinkMessage {
    LinkMessage::Subscribe(Subscribe {
        route,
        topic: topic.into(),
        type_name: "T".into(),
        kind: 0,
        subscribers: vec![RouteSubscriber { gid: subscriber, qos: Qos::keep_all() }],
        last: Vec::new(),
        acknowledges: Some(true),
        short_headers: None,
    })
}

#[test]
fn bytes_of_refused_routes_are_bounded_for_an_identity() {
    let mut world = World::new(83, 1, |_| {
        let mut config = Config::default();
        config.link.graph = 1 << 20;
        config
    });
    world.add_raw(Config::default(), DaemonId([0xff; 16]));
    for id in 0xf0..0xf3 {
        let number = linked_as(&mut world, 0, id);
        for route in 0..5_000 {
            let topic = format!("/{route:0>500}");
            let message = subscribe(route, &topic, gid(id, route));
            world.with_raw(0, |raw, _| raw.links[number].say(&message));
        }
        world.run_for(secs(5));
        let refused = |m: &&LinkMessage| matches!(m, LinkMessage::RouteRefused(_));
        assert!(world.raws[0].links[number].messages.iter().filter(refused).count() > 3_000);
    }
    let held = world.hosts[0].held_of_refusals();
    assert!((1 << 19..=2 << 20).contains(&held), "{} KiB", held >> 10);
    assert!(world.raws[0].links.iter().all(|link| link.closed.is_none()), "{}", world.describe());
}

#[test]
fn publishers_of_a_topic_are_bounded_over_all_ids_of_an_identity() {
    let mut world = World::new(84, 1, |_| Config::default());
    world.add_raw(Config::default(), DaemonId([0xff; 16]));
    world.hosts[0].rings.create_subscription("/t", Qos::keep_all(), None);
    world.hosts[0].touch_graph();
    for id in 0xf0..0xf3 {
        let number = linked_as(&mut world, 0, id);
        publishes(&mut world, number, id, "/t", 600);
        world.run_for(secs(2));
    }
    assert_eq!(world.hosts[0].shown(), 1024, "{}", world.describe());
    // Publishers of an id that leaves make room for others.
    world.with_raw(0, |raw, now| raw.close(0, now));
    world.run_for(secs(2));
    world.hosts[0].touch_graph();
    world.hosts[0].rings.create_subscription("/t", Qos::keep_all(), None);
    world.run_for(secs(2));
    assert_eq!(world.hosts[0].shown(), 1024, "{}", world.describe());
}

/// Kills a raw peer with KEEP_ALL relays for `topics` topics; its next daemon announces the same subscription.
fn restarts(world: &mut World, peer: usize, id: u8, topics: u32) {
    let subscription = endpoint(EndpointKind::Subscription, gid(id, 0), "/moved");
    let graph = GraphUpdate { version: 1, added: vec![subscription], ..GraphUpdate::default() };
    let number = linked_as(world, peer, id);
    world.with_raw(peer, |raw, _| raw.links[number].say(&LinkMessage::Graph(graph.clone())));
    for route in 0..topics {
        let message = subscribe(route, &format!("/topic_{route}"), gid(id, 1 + route));
        world.with_raw(peer, |raw, _| raw.links[number].say(&message));
    }
    world.run_for(secs(3));
    let next = linked_as(world, peer, id + 1);
    world.with_raw(peer, |raw, _| raw.links[next].say(&LinkMessage::Graph(graph)));
    world.run_for(secs(1));
}

#[test]
fn relays_that_are_kept_for_one_identity_leave_room_for_those_of_another() {
    let mut world = World::new(85, 1, |_| Config::default());
    world.add_raw(Config::default(), DaemonId([0xff; 16]));
    world.add_raw(Config::default(), DaemonId([0xfe; 16]));
    restarts(&mut world, 0, 0xf4, 3_000);
    assert_eq!(world.hosts[0].kept(), 1_024, "{}", world.describe());
    restarts(&mut world, 1, 0xf8, 10);
    assert_eq!(world.hosts[0].kept(), 1_034, "{}", world.describe());
}

/// Asks for a topic for subscriptions of which each needs a relay of its own.
fn subscribe_in_many_ways(world: &mut World, peer: usize, link: usize, id: u8, route: u32) {
    let kinds = [Qos::default(), Qos::sensor_data()].into_iter().flat_map(|qos| {
        [Durability::Volatile, Durability::TransientLocal]
            .map(|durability| qos.with_durability(durability))
    });
    let kinds = kinds.flat_map(|qos| {
        let keeps_all = qos.with_history(Qos::keep_all().history);
        [1, 100, 1000].map(|depth| qos.with_depth(depth)).into_iter().chain([keeps_all])
    });
    let subscribers =
        (0..).zip(kinds).map(|(n, qos)| RouteSubscriber { gid: gid(id, route << 4 | n), qos });
    let message = LinkMessage::Subscribe(Subscribe {
        route,
        topic: format!("/topic_{route}"),
        type_name: "T".into(),
        kind: 0,
        subscribers: subscribers.collect(),
        last: Vec::new(),
        acknowledges: Some(true),
        short_headers: None,
    });
    world.with_raw(peer, |raw, _| raw.links[link].say(&message));
}

/// Returns the routes of which the host told a peer that some of its subscriptions get nothing because there are no
/// lanes left.
fn without_lanes(world: &World, peer: usize, link: usize) -> Vec<u32> {
    let refused =
        world.raws[peer].links[link].messages.iter().filter_map(|message| match message {
            LinkMessage::RouteRefused(refused) if refused.reason.contains("connections") => {
                Some(refused.route)
            }
            _ => None,
        });
    refused.collect()
}

#[test]
fn no_identity_takes_all_lanes_and_each_is_told_its_refused_routes() {
    const PUBLISHERS: usize = 200;
    let mut world = World::new(87, 1, |_| Config::default());
    world.add_raw(Config::default(), DaemonId([0xff; 16]));
    world.add_raw(Config::default(), DaemonId([0xfe; 16]));
    for topic in 0..21 {
        for _ in 0..PUBLISHERS {
            world.hosts[0].rings.create_publisher(&format!("/topic_{topic}"), Qos::keep_all());
        }
    }
    world.hosts[0].touch_graph();
    let greedy = linked_as(&mut world, 0, 0xf0);
    (0..21).for_each(|topic| subscribe_in_many_ways(&mut world, 0, greedy, 0xf0, topic));
    world.run_for(secs(3));
    // 65,536 of 67,200.
    let most = 327 * PUBLISHERS;
    assert_eq!(world.hosts[0].rings.lanes(), most, "{}", world.describe());
    assert_eq!(without_lanes(&world, 0, greedy), [20]);

    let other = linked_as(&mut world, 1, 0xf8);
    (0..5).for_each(|topic| subscribe_in_many_ways(&mut world, 1, other, 0xf8, topic));
    world.run_for(secs(3));
    let of_other = 5 * 16 * PUBLISHERS;
    assert_eq!(world.hosts[0].rings.lanes(), most + of_other, "{}", world.describe());
    assert_eq!(without_lanes(&world, 1, other), Vec::<u32>::new());

    // More publishers of a topic that both read: the one that has more than its share loses relays.
    for _ in 0..20 {
        world.hosts[0].rings.create_publisher("/topic_0", Qos::keep_all());
    }
    world.hosts[0].touch_graph();
    world.run_for(secs(3));
    let (greedy_has, other_has) =
        (most - 16 * PUBLISHERS + 14 * (PUBLISHERS + 20), of_other + 16 * 20);
    assert_eq!(world.hosts[0].rings.lanes(), greedy_has + other_has, "{}", world.describe());
    assert_eq!(without_lanes(&world, 0, greedy), [20, 0]);
    assert_eq!(without_lanes(&world, 1, other), Vec::<u32>::new());

    // The lanes that the peer leaves are free again.
    world.with_raw(0, |raw, now| raw.close(greedy, now));
    world.run_for(secs(2));
    assert_eq!(world.hosts[0].rings.lanes(), other_has, "{}", world.describe());
    (5..12).for_each(|topic| subscribe_in_many_ways(&mut world, 1, other, 0xf8, topic));
    world.run_for(secs(3));
    assert_eq!(world.hosts[0].rings.lanes(), other_has + 7 * 16 * PUBLISHERS);
}

#[test]
fn kept_relay_stays_charged_until_its_end() {
    const PUBLISHERS: usize = 200;
    let mut world = World::new(89, 1, |_| Config::default());
    world.add_raw(Config::default(), DaemonId([0xff; 16]));
    let publish = |world: &mut World, topic: u32, publishers: usize| {
        for _ in 0..publishers {
            world.hosts[0].rings.create_publisher(&format!("/topic_{topic}"), Qos::keep_all());
        }
        world.hosts[0].touch_graph();
    };
    (0..22).for_each(|topic| publish(&mut world, topic, PUBLISHERS));
    let says = |world: &mut World, link: usize, message: &LinkMessage| {
        world.with_raw(0, |raw, _| raw.links[link].say(message));
    };
    let moved = endpoint(EndpointKind::Subscription, gid(0xf0, 0), "/moved");
    let graph = LinkMessage::Graph(GraphUpdate {
        version: 1,
        added: vec![moved],
        ..GraphUpdate::default()
    });
    let asks = subscribe(21, "/topic_21", gid(0xf0, 1));
    let first = linked_as(&mut world, 0, 0xf0);
    says(&mut world, first, &graph);
    says(&mut world, first, &asks);
    world.run_for(secs(1));
    // Another daemon of the host has nearly all others of the 65,536.
    let other = linked_as(&mut world, 0, 0xf4);
    (0..21).for_each(|topic| subscribe_in_many_ways(&mut world, 0, other, 0xf4, topic));
    world.run_for(secs(3));
    let most = 327 * PUBLISHERS;
    assert_eq!(world.hosts[0].rings.lanes(), most, "{}", world.describe());
    // The first one is killed, and there are more publishers when the next one asks for its topic.
    let next = linked_as(&mut world, 0, 0xf1);
    says(&mut world, next, &graph);
    world.run_for(secs(1));
    assert_eq!(world.hosts[0].kept(), 1, "{}", world.describe());
    publish(&mut world, 21, PUBLISHERS);
    world.run_for(secs(1));
    says(&mut world, next, &asks);
    world.run_for(secs(3));
    assert_eq!(without_lanes(&world, 0, next), [21]);
    assert_eq!(world.hosts[0].kept(), 1, "{}", world.describe());
    // Another daemon cannot use the lanes of the kept relay.
    let relays = world.hosts[0].rings.relays();
    subscribe_in_many_ways(&mut world, 0, other, 0xf4, 20);
    world.run_for(secs(1));
    assert_eq!(world.hosts[0].rings.relays(), relays, "{}", world.describe());
}

#[test]
fn control_messages_that_are_not_handled_are_bounded_over_all_links_of_an_identity() {
    const LINKS: u8 = 16;
    let mut world = World::new(88, 1, |_| Config::default());
    world.add_raw(Config::default(), DaemonId([0xff; 16]));
    world.hosts[0].rings.create_publisher("/t", Qos::keep_all());
    world.hosts[0].touch_graph();
    let links: Vec<_> = (0..LINKS).map(|n| linked_as(&mut world, 0, 0xe0 + n)).collect();
    world.run_for(secs(1));
    // 1.1 MB after decompression, and nearly nothing before. All come while the host stands still.
    let long =
        LinkMessage::RouteReady(RouteReady { route: 9, publishers: vec![Gid::default(); 65_536] });
    world.stop(0, true);
    for (n, link) in (0..).zip(&links) {
        world.with_raw(0, |raw, _| {
            raw.links[*link].say(&long);
            raw.links[*link].say(&subscribe(1, "/t", gid(0xe0 + n, 1)));
        });
    }
    world.run_for(millis(100));
    world.stop(0, false);
    let served = |world: &World| {
        let ready =
            |m: &LinkMessage| matches!(m, LinkMessage::RouteReady(ready) if ready.route == 1);
        links.iter().filter(|link| world.raws[0].links[**link].messages.iter().any(ready)).count()
    };
    // All are handled, one after the other.
    world.until(secs(60), |world| served(world) == usize::from(LINKS));
    let most = world.hosts[0].most_decoded();
    assert!((20 << 20..=28 << 20).contains(&most), "{} MiB", most >> 20);
    assert!(world.raws[0].links.iter().all(|link| link.closed.is_none()), "{}", world.describe());
}
