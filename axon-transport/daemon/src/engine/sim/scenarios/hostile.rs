//! Peers that break the protocol, and peers that keep it in ways that no engine of this version does.

use std::time::Duration;

use axon_envelope::{Delivery, Kind, Route, TopicHash};
use axon_shm::{
    ids::{DaemonId, Gid},
    qos::Qos,
};
use axon_transport::{
    MessageInfo,
    config::Config,
    graph::{Endpoint, EndpointKind},
};
use quinn_proto::VarInt;

use crate::{
    engine::{
        rings::RingSample,
        sample::{
            frames::Frames,
            protection::{Seal, call},
            stream_header::StreamHeader,
        },
        sim::{
            network::Path,
            raw::RawLink,
            rings::{FOREIGN, payload},
            tests::{millis, secs},
            world::World,
        },
    },
    link::{
        CloseCode, Elected, GraphUpdate, LinkHello, LinkMessage, RouteSubscriber, Subscribe,
        Unsubscribe,
    },
};

pub(super) const LOWEST: DaemonId = DaemonId([0; 16]);
pub(super) const HIGHEST: DaemonId = DaemonId([0xff; 16]);

/// Creates a world of `hosts` honest hosts, all linked, and one raw peer.
pub(super) fn world(seed: u64, hosts: usize, daemon: DaemonId) -> World {
    let mut world = World::new(seed, hosts, |_| Config::default());
    world.add_raw(Config::default(), daemon);
    world.until(secs(5), World::is_whole);
    world
}

pub(super) fn link(world: &World, link: usize) -> &RawLink {
    &world.raws[0].links[link]
}

/// Dials a host and completes the TLS handshake.
pub(super) fn dial(world: &mut World, host: usize) -> usize {
    let to = world.hosts[host].address;
    let dialled = world.with_raw(0, |raw, now| raw.dial(to, now));
    world.until(secs(5), |world| link(world, dialled).connected);
    dialled
}

/// Sends HELLO, and waits for the other side's.
pub(super) fn greet(world: &mut World, of: usize, replaces: Option<[u8; 16]>) {
    world.with_raw(0, |raw, _| {
        let hello = LinkHello { replaces, ..raw.hello() };
        raw.links[of].say(&LinkMessage::Hello(hello));
    });
    world.until(secs(5), |world| link(world, of).is_greeted());
}

pub(super) fn say(world: &mut World, on: usize, message: &LinkMessage) {
    world.with_raw(0, |raw, _| raw.links[on].say(message));
}

pub(super) fn elect(election: u64) -> LinkMessage {
    LinkMessage::Elected(Elected { link: [election as u8; 16], election, standby: None })
}

pub(super) fn subscribe(route: u32, topic: &str, qos: Qos) -> LinkMessage {
    LinkMessage::Subscribe(Subscribe {
        route,
        topic: topic.into(),
        type_name: "T".into(),
        kind: 0,
        subscribers: vec![RouteSubscriber { gid: of_raw(200), qos }],
        last: Vec::new(),
        acknowledges: Some(true),
        short_headers: None,
    })
}

/// Returns the GID of an endpoint of the raw peer.
pub(super) fn of_raw(number: u8) -> Gid {
    let mut gid = [number; 16];
    gid[..12].copy_from_slice(&FOREIGN);
    Gid(gid)
}

/// Returns a graph of one publisher.
pub(super) fn publishes(topic: &str, gid: Gid, qos: Qos) -> LinkMessage {
    let endpoint = Endpoint::new(gid, EndpointKind::Publisher, topic, "T")
        .with_qos(qos)
        .with_node("node", "/");
    LinkMessage::Graph(GraphUpdate { version: 1, added: vec![endpoint], ..GraphUpdate::default() })
}

/// Waits until a host asked for a topic or service. Returns the number of its route.
pub(super) fn asked(world: &mut World, on: usize, topic: &str) -> u32 {
    let route = |world: &World| {
        link(world, on).messages.iter().find_map(|message| match message {
            LinkMessage::Subscribe(subscribe) if subscribe.topic == topic => Some(subscribe.route),
            _ => None,
        })
    };
    world.until(secs(5), |world| route(world).is_some());
    route(world).unwrap()
}

/// Returns a data stream with some samples of a publisher.
pub(super) fn samples(
    route: u32,
    topic: &str,
    gid: Gid,
    numbers: impl IntoIterator<Item = u64>,
) -> Vec<u8> {
    messages(Kind::Topic, route, topic, (gid, gid), numbers)
}

/// Returns a data stream with some samples, requests or responses of a writer, in the flow of an endpoint.
pub(super) fn messages(
    kind: Kind,
    route: u32,
    topic: &str,
    (writer, of): (Gid, Gid),
    numbers: impl IntoIterator<Item = u64>,
) -> Vec<u8> {
    let mut bytes = StreamHeader::plain(route, of).encode().to_vec();
    let number_of_kind = match kind {
        Kind::Topic => 0,
        Kind::Request => 1,
        Kind::Response => 2,
    };
    let hash = TopicHash::new(number_of_kind, topic, "T").unwrap();
    let mut frames = Frames::default();
    for number in numbers {
        let info = MessageInfo::of(writer, number);
        let mut sample = RingSample::new(info, payload(writer, number, 10).into(), Duration::ZERO);
        sample.call = (kind != Kind::Topic).then(|| call(of, number));
        let of = Route { kind, topic: hash };
        Seal::Link
            .write(&sample, of, Delivery::Reliable, None, &mut frames, Duration::ZERO)
            .unwrap();
    }
    frames.take().iter().for_each(|piece| bytes.extend_from_slice(piece));
    bytes
}

#[test]
fn a_stream_counts_only_on_an_elected_link() {
    let mut world = world(20, 1, LOWEST);
    let subscription = world.hosts[0].rings.create_subscription("/t", Qos::keep_all(), None);
    world.hosts[0].touch_graph();
    let first = dial(&mut world, 0);
    greet(&mut world, first, None);
    say(&mut world, first, &elect(5));
    say(&mut world, first, &publishes("/t", of_raw(1), Qos::keep_all()));
    let route = asked(&mut world, first, "/t");

    let second = dial(&mut world, 0);
    greet(&mut world, second, Some([5; 16]));
    let bytes = samples(route, "/t", of_raw(1), 1..=3);
    let early = world.with_raw(0, |raw, _| raw.links[second].open(bytes)).unwrap();
    world.run_for(secs(1));
    let received = |world: &World| world.hosts[0].rings.received(subscription, of_raw(1));
    assert!(received(&world).is_empty(), "the link is not elected");
    // An older election: it is superseded at once. Its streams are read, since it was elected.
    say(&mut world, second, &elect(4));
    world.run_for(secs(1));
    assert_eq!(received(&world), [1, 2, 3]);
    // The streams of a flow are read one after the other.
    let bytes = samples(route, "/t", of_raw(1), 4..=5);
    world.with_raw(0, |raw, _| raw.links[first].open(bytes));
    world.run_for(secs(1));
    assert_eq!(received(&world), [1, 2, 3]);
    world.with_raw(0, |raw, _| raw.links[second].finish(early));
    world.run_for(secs(1));
    assert_eq!(received(&world), [1, 2, 3, 4, 5], "{}", world.describe());
}

#[test]
fn streams_of_an_ended_route_are_finished_on_their_own_connection() {
    let mut world = world(21, 1, LOWEST);
    let publisher = world.hosts[0].rings.create_publisher("/t", Qos::keep_all());
    world.hosts[0].touch_graph();
    // The host dials: the streams that it opens are a client's.
    let (daemon, address) = (world.raws[0].daemon, world.raws[0].address);
    let now = world.now;
    world.hosts[0].want(daemon, address, None, now);
    world.until(secs(5), |world| {
        world.raws[0].links.first().is_some_and(|link| link.control.is_some())
    });
    greet(&mut world, 0, None);
    say(&mut world, 0, &elect(1));
    say(&mut world, 0, &subscribe(1, "/t", Qos::keep_all()));
    world.run_for(secs(3));
    world.hosts[0].rings.publish(publisher, 10);
    world.hosts[0].ring();
    world.until(secs(1), |world| !link(world, 0).opened.is_empty());

    // Over the successor, which the peer dials, the host's streams are a server's.
    let successor = dial(&mut world, 0);
    greet(&mut world, successor, Some([1; 16]));
    // One pass of the host ends the route, and then moves to the successor.
    world.run_for(millis(50));
    world.stop(0, true);
    say(&mut world, 0, &LinkMessage::Unsubscribe(Unsubscribe { route: 1 }));
    world.run_for(millis(1));
    say(&mut world, successor, &elect(2));
    world.run_for(millis(1));
    world.stop(0, false);
    world.run_for(secs(1));
    say(&mut world, successor, &subscribe(1, "/t", Qos::keep_all()));
    world.run_for(secs(3));
    world.hosts[0].rings.publish(publisher, 10);
    world.hosts[0].ring();
    world.until(secs(1), |world| !link(world, successor).opened.is_empty());
    assert!(link(&world, successor).closed.is_none(), "{}", world.describe());
}

#[test]
fn a_best_effort_flow_goes_on_after_its_samples_ran_out_of_time() {
    let settings = |_| {
        let mut config = Config::default();
        config.link.stalled = secs(600);
        config
    };
    let mut world = World::new(22, 1, settings);
    world.add_raw(Config::default(), HIGHEST);
    // The peer reads no stream: each stops after `window` bytes.
    let window = 64 << 10;
    let mut transport = quinn_proto::TransportConfig::default();
    transport.stream_receive_window(VarInt::from_u32(window));
    world.raws[0].set_transport(transport);
    let publisher = world.hosts[0].rings.create_publisher("/camera", Qos::sensor_data());
    world.hosts[0].touch_graph();
    let first = dial(&mut world, 0);
    greet(&mut world, first, None);
    world.until(secs(5), |world| link(world, first).is_elected());
    say(&mut world, first, &subscribe(1, "/camera", Qos::sensor_data()));
    world.run_for(secs(1));
    for streams in 1..=3 {
        world.hosts[0].rings.publish(publisher, 3 * window as usize);
        world.hosts[0].ring();
        world.run_for(secs(1));
        assert_eq!(link(&world, first).opened.len(), streams, "{}", world.describe());
        world.run_for(secs(10));
    }
    assert!(link(&world, first).closed.is_none(), "{}", world.describe());
}

#[test]
fn a_token_of_quic_ages_by_the_time_of_the_engine() {
    let mut world = world(24, 1, HIGHEST);
    let mut transport = quinn_proto::TransportConfig::default();
    transport.max_idle_timeout(None);
    world.raws[0].set_transport(transport);
    // A token that comes back after 15 s is none, however little the wall clock went on. One before that is, however
    // much.
    for (delay, accepted) in [(7, true), (8, false)] {
        let path = Path { delay: secs(delay), ..Path::default() };
        world.network.set_default_path(path);
        let to = world.hosts[0].address;
        let dialled = world.with_raw(0, |raw, now| raw.dial(to, now));
        world.until(secs(100), |world| {
            link(world, dialled).connected || link(world, dialled).closed.is_some()
        });
        assert_eq!(link(&world, dialled).connected, accepted, "{:?}", link(&world, dialled).closed);
    }
}

#[test]
fn a_peer_of_another_protocol_version_is_refused_in_words_and_harms_nothing() {
    let mut world = world(23, 2, HIGHEST);
    let pair = world.pair(0, 1, "/t", Qos::keep_all());
    world.until(secs(5), World::is_whole);
    world.run_for(secs(1));
    for (protocol_min, protocol_max) in [(0, 0), (2, 2), (2, 1)] {
        let refused = dial(&mut world, 0);
        world.with_raw(0, |raw, _| {
            let hello = LinkHello { protocol_min, protocol_max, ..raw.hello() };
            raw.links[refused].say(&LinkMessage::Hello(hello));
        });
        world.publish(pair, 10);
        world.until(secs(5), |world| link(world, refused).closed.is_some());
        let (code, text) = link(&world, refused).closed.clone().unwrap();
        let range = format!("{protocol_min}..={protocol_max}");
        assert_eq!(code, Some(CloseCode::Protocol), "{text}");
        assert!(text.contains("protocol version") && text.contains(&range), "{text}");
        let shown = world.hosts[0].refusals.back().map(|(_, shown)| shown.clone());
        let shown = shown.unwrap_or_default();
        assert!(shown.contains("PROTOCOL_MISMATCH") && shown.contains(&range), "{shown}");
    }
    // A peer of a later version that also supports this one is accepted.
    let accepted = dial(&mut world, 0);
    world.with_raw(0, |raw, _| {
        let hello = LinkHello { protocol_max: 2, ..raw.hello() };
        raw.links[accepted].say(&LinkMessage::Hello(hello));
    });
    world.until(secs(5), |world| link(world, accepted).is_elected());
    world.run_for(secs(1));
    assert_eq!(world.received(pair), [1, 2, 3], "{}", world.describe());
}

/// Creates a raw peer that publishes `/t`, and a subscription of a host to it.
fn publisher(world: &mut World) -> (usize, Gid, u32) {
    let subscription = world.hosts[0].rings.create_subscription("/t", Qos::keep_all(), None);
    world.hosts[0].touch_graph();
    let on = dial(world, 0);
    greet(world, on, None);
    world.until(secs(5), |world| link(world, on).is_elected());
    say(world, on, &publishes("/t", of_raw(1), Qos::keep_all()));
    let route = asked(world, on, "/t");
    (on, subscription, route)
}

/// Returns the number of samples that were refused for impossible numbers.
fn refused_numbers(world: &World) -> u64 {
    world.hosts[0].lost.get(&("/t".to_owned(), "ring")).copied().unwrap_or(0)
}

#[test]
fn a_number_that_its_publisher_cannot_have_reached_is_refused_and_later_ones_arrive() {
    let mut world = world(25, 1, HIGHEST);
    let (on, subscription, route) = publisher(&mut world);
    let far = 1 << 31;
    let bytes = samples(route, "/t", of_raw(1), [1, far, 2, u64::MAX, far / 2, 3]);
    let stream = world.with_raw(0, |raw, _| raw.links[on].open(bytes)).unwrap();
    world.run_for(secs(2));
    let received = |world: &World| world.hosts[0].rings.received(subscription, of_raw(1));
    assert_eq!(received(&world), [1, 2, 3], "{}", world.describe());
    assert_eq!(refused_numbers(&world), 3);
    // In a pause a publisher can have come so far.
    world.run_for(secs(600));
    let bytes = samples(route, "/t", of_raw(1), [far, 2 * far]).split_off(24);
    world.with_raw(0, |raw, _| raw.links[on].write_to(stream, bytes.into()));
    world.run_for(secs(2));
    assert_eq!(received(&world), [1, 2, 3, far], "{}", world.describe());
    assert_eq!(refused_numbers(&world), 4);
    assert!(link(&world, on).closed.is_none());
}

#[test]
fn a_publisher_that_is_announced_again_does_not_begin_with_any_number() {
    let mut world = world(26, 1, HIGHEST);
    let (on, subscription, route) = publisher(&mut world);
    let bytes = samples(route, "/t", of_raw(1), 1..=2);
    let stream = world.with_raw(0, |raw, _| raw.links[on].open(bytes)).unwrap();
    world.run_for(secs(1));
    // The next stream of the publisher has its turn after this one.
    world.with_raw(0, |raw, _| raw.links[on].finish(stream));
    let gone =
        GraphUpdate { version: 2, before: 1, removed: vec![of_raw(1)], ..GraphUpdate::default() };
    say(&mut world, on, &LinkMessage::Graph(gone));
    world.run_for(secs(1));
    link_messages(&mut world, on).clear();
    let LinkMessage::Graph(graph) = publishes("/t", of_raw(1), Qos::keep_all()) else {
        return;
    };
    say(&mut world, on, &LinkMessage::Graph(GraphUpdate { version: 3, before: 2, ..graph }));
    let route = asked(&mut world, on, "/t");
    let bytes = samples(route, "/t", of_raw(1), [1 << 31, 3]);
    world.with_raw(0, |raw, _| raw.links[on].open(bytes));
    world.run_for(secs(1));
    let received = world.hosts[0].rings.received(subscription, of_raw(1));
    assert_eq!(received, [1, 2, 3], "{}", world.describe());
    assert_eq!(refused_numbers(&world), 1);
}

fn link_messages(world: &mut World, link: usize) -> &mut Vec<LinkMessage> {
    &mut world.raws[0].links[link].messages
}
