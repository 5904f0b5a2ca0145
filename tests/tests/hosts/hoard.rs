//! A pinned peer that sends what this host cannot read yet.

use std::time::Duration;

use axon_daemon::internal::link::{Graph, Message};
use axon_transport::{
    EndpointSpec,
    graph::{Endpoint, EndpointKind},
    ids::{DaemonId, Gid},
    internal::SessionKey,
    qos::Qos,
};

use super::{greedy::Camera, process::until, stranger::Met};

pub(crate) const TOPIC: &str = "/hoarded";
pub(crate) const TYPE: &str = "test/Bytes";
/// Daemon ids of the peer, and data streams of each.
const IDS: u8 = 4;
const STREAMS: usize = 48;
/// What it tries to send over each stream.
const BYTES: usize = 8 << 20;
/// What of it the daemon may hold: 64 MiB of long messages that it reads and 16 MiB of short ones, and in QUIC's windows 64 MiB of all links and 1 MiB
/// of each.
const STATED: usize = (64 + 16 + 64 + IDS as usize) << 20;
/// With what a debug build's allocator and quinn add to each packet that waits: a fifth.
const BOUND: usize = STATED + STATED / 5;

/// Announces a publisher of the topic, and waits until it is subscribed to: the route.
pub(crate) fn published(camera: &Camera, met: &mut Met, of: Gid) -> u32 {
    all_published(camera, met, TOPIC, &[of])
}

/// Announces publishers of a topic, and waits until they are subscribed to: the route.
fn all_published(camera: &Camera, met: &mut Met, topic: &str, all: &[Gid]) -> u32 {
    let publisher = |gid: &Gid| {
        Endpoint::new(*gid, EndpointKind::Publisher, topic, TYPE)
            .with_qos(Qos::keep_all())
            .with_node("hoard", "/")
    };
    let added = all.iter().map(publisher).collect();
    let graph = Graph { version: 1, added, ..Graph::default() };
    camera.stranger.say(met, &Message::Graph(graph));
    let asked = |m: &Message| matches!(m, Message::Subscribe(s) if s.topic == topic);
    match camera.stranger.hear(met, asked) {
        Ok(Message::Subscribe(subscribe)) => subscribe.route,
        other => panic!("{other:?}"),
    }
}

#[test]
fn what_a_peer_has_under_way_is_bounded_over_all_of_its_ids_and_given_back() {
    let camera = Camera::new();
    let spec = EndpointSpec::new(TOPIC, TYPE, Qos::keep_all());
    let session = camera.a.session("slow");
    let _reads_nothing = session.create_subscription(spec).unwrap();
    let before = camera.memory("VmRSS");
    let mut met = Vec::new();
    let mut streams = Vec::new();
    // The host's own id is lower, as a rule: it elects.
    let keys: Vec<_> = (0..IDS).map(|_| SessionKey::generate().unwrap()).collect();
    for (id, key) in (0..IDS).map(|id| 0xff - id).zip(&keys) {
        let mut link = camera.link(id);
        camera.stranger.prove(&mut link, DaemonId([id; 16]), &[key]);
        let publisher = Gid::new(key.id(), 1);
        let route = published(&camera, &mut link, publisher);
        let mut header = vec![1, 0, 0, 0];
        header.extend_from_slice(&route.to_be_bytes());
        header.extend_from_slice(&publisher.0);
        // The first claims a message that never comes whole, and the others wait for it.
        header.extend_from_slice(&u32::to_be_bytes(BYTES as u32 * 2));
        for _ in 0..STREAMS {
            let mut stream = camera.stranger.open(&link).expect("a stream");
            let bytes = [&header[..], &vec![0x5a; BYTES]].concat();
            camera.stranger.write_for(&mut stream, &bytes, Duration::from_millis(100));
            streams.push(stream);
        }
        met.push(link);
    }
    let most = camera.memory("VmHWM").saturating_sub(before);
    eprintln!("{} MiB for what a peer has under way over {IDS} links", most >> 20);
    assert!(most < BOUND, "{most}");
    drop(streams);
    met.iter().for_each(|link| camera.stranger.leave(link));
    until("memory is given back", || camera.memory("VmRSS") < before + BOUND / 4);
}

/// Daemon ids of the peer that leave short messages unfinished, and publishers of each.
const SHORT_IDS: u8 = 6;
const PUBLISHERS: u32 = 1024;

#[test]
fn short_messages_that_do_not_come_whole_are_bounded_over_all_ids_of_a_peer_and_given_back() {
    const SAYS: u32 = 32 << 10;
    let camera = Camera::new();
    let session = camera.a.session("slow");
    let keys: Vec<_> = (0..SHORT_IDS).map(|_| SessionKey::generate().unwrap()).collect();
    let mut links = Vec::new();
    let mut subscriptions = Vec::new();
    for (id, key) in (0..SHORT_IDS).map(|id| 0xff - id).zip(&keys) {
        let topic = format!("{TOPIC}_{id}");
        let spec = EndpointSpec::new(&*topic, TYPE, Qos::keep_all());
        subscriptions.push(session.create_subscription(spec).unwrap());
        let mut link = camera.link(id);
        camera.stranger.prove(&mut link, DaemonId([id; 16]), &[key]);
        let publishers: Vec<_> = (1..=PUBLISHERS).map(|n| Gid::new(key.id(), n)).collect();
        let route = all_published(&camera, &mut link, &topic, &publishers);
        links.push((link, route, publishers));
    }
    // What the publishers take is there before.
    let before = camera.memory("VmRSS");
    let mut streams = Vec::new();
    for (link, route, publishers) in &links {
        for publisher in publishers {
            let mut bytes = vec![1, 0, 0, 0];
            bytes.extend_from_slice(&route.to_be_bytes());
            bytes.extend_from_slice(&publisher.0);
            bytes.extend_from_slice(&SAYS.to_be_bytes());
            bytes.resize(bytes.len() + SAYS as usize - 1024, 0x5a);
            let mut stream = camera.stranger.open(link).expect("a stream");
            let written =
                camera.stranger.write_for(&mut stream, &bytes, Duration::from_millis(500));
            streams.push(stream);
            if !written {
                // The daemon lets this link send no more.
                break;
            }
        }
    }
    let most = camera.memory("VmRSS").saturating_sub(before);
    let tried = SHORT_IDS as usize * PUBLISHERS as usize * (SAYS as usize - 1024);
    eprintln!("{} MiB of {} MiB in short messages", most >> 20, tried >> 20);
    // 16 MiB of short messages that are being read, what the windows of all links let in, and what the daemon has for each
    // of the streams.
    let stated = (16 + 64 + SHORT_IDS as usize) << 20;
    assert!(most < stated + stated / 5, "{most}");
    assert!(links.iter().all(|(link, ..)| link.connection.close_reason().is_none()));
    drop(streams);
    links.iter().for_each(|(link, ..)| camera.stranger.leave(link));
    until("memory is given back", || camera.memory("VmRSS") < before + (16 << 20));
}
