//! What peers have this host hold of messages that have not all come, and that honest ones go on all the same.

use std::time::Duration;

use axon_shm::{
    ids::{DaemonId, Gid},
    qos::Qos,
};
use axon_transport::{
    config::Config,
    graph::{Endpoint, EndpointKind},
};
use bytes::Bytes;

use crate::{
    engine::{
        inbound::stream_header,
        sim::{
            network::{Path, Rate},
            rings::FOREIGN,
            tests::{millis, secs},
            world::World,
        },
    },
    link::{Graph, Hello, Message},
};

/// Publishers of one topic of the hostile peer: as many as one route shows.
const PUBLISHERS: u32 = 1024;
/// What comes of each message, and what its length says.
const COMES: usize = 31 << 10;
const SAYS: u32 = 32 << 10;

/// A peer of this number dials under a daemon id. Returns its link once it is elected.
fn linked_as(world: &mut World, peer: usize, id: u8) -> usize {
    let to = world.hosts[0].address;
    let number = world.with_raw(peer, |raw, now| raw.dial(to, now));
    world.until(secs(5), |world| world.raws[peer].links[number].connected);
    world.with_raw(peer, |raw, _| {
        let hello = Hello { daemon: DaemonId([id; 16]), ..raw.hello() };
        raw.links[number].say(&Message::Hello(hello));
    });
    world.until(secs(5), |world| world.raws[peer].links[number].is_elected());
    number
}

/// The GID of an endpoint that a daemon id announces.
fn gid(id: u8, number: u32) -> Gid {
    let mut gid = [0; 16];
    gid[..12].copy_from_slice(&FOREIGN);
    gid[12..].copy_from_slice(&(u32::from(id) << 16 | number).to_be_bytes());
    Gid(gid)
}

fn endpoint(kind: EndpointKind, gid: Gid, topic: &str) -> Endpoint {
    Endpoint {
        gid,
        kind,
        topic: topic.into(),
        type_name: "T".into(),
        type_hash: Vec::new(),
        qos: Qos::keep_all(),
        node: "node".into(),
        namespace: "/".into(),
        enclave: String::new(),
    }
}

/// Announces so many publishers of a topic.
fn publishes(world: &mut World, link: usize, id: u8, topic: &str, count: u32) {
    let publisher = |n| endpoint(EndpointKind::Publisher, gid(id, n), topic);
    let added = (0..count).map(publisher).collect();
    let graph = Message::Graph(Graph { version: 1, added, ..Graph::default() });
    world.with_raw(0, |raw, _| raw.links[link].say(&graph));
}

/// Announces publishers of a topic under a daemon id, and has a stream of each stop before the end of its first
/// message.
fn stop_within_messages(world: &mut World, id: u8) {
    let topic = format!("/topic_{id}");
    world.hosts[0].rings.create_subscription(&topic, Qos::keep_all(), None);
    world.hosts[0].touch_graph();
    let number = linked_as(world, 0, id);
    publishes(world, number, id, &topic, PUBLISHERS);
    let route = |world: &World| {
        world.raws[0].links[number].messages.iter().find_map(|message| match message {
            Message::Subscribe(subscribe) if subscribe.topic == topic => Some(subscribe.route),
            _ => None,
        })
    };
    world.until(secs(20), |world| route(world).is_some());
    let route = route(world).unwrap();
    let body = Bytes::from(vec![0x5a; COMES]);
    for publisher in 0..PUBLISHERS {
        world.with_raw(0, |raw, _| {
            let mut bytes = stream_header(true, false, route, gid(id, publisher)).to_vec();
            bytes.extend_from_slice(&SAYS.to_be_bytes());
            bytes.extend_from_slice(&body);
            raw.links[number].open(bytes).expect("a stream");
        });
    }
    world.run_for(secs(2));
}

#[test]
fn short_messages_that_have_not_all_come_are_bounded_over_all_ids_of_an_identity() {
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
    assert!(held <= 65 << 20, "{} MiB of {} MiB", held >> 20, asked >> 20);
    assert!(held > 56 << 20, "as much as it may: {} MiB", held >> 20);
    assert!(world.raws[0].links.iter().all(|link| link.closed.is_none()), "{}", world.describe());
}

/// So many publishers publish a message of this length at once. Whether all arrive.
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
    all_arrive(81, 18, 8 << 20, 1);
    all_arrive(82, 2_400, 31 << 10, 1);
}
