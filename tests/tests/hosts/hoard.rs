//! Tests a pinned peer that sends data that this host cannot read yet.

use std::time::Duration;

use axon_daemon::internal::link::{GraphUpdate, LinkMessage};
use axon_transport::{
    EndpointSpec, Session,
    graph::{Endpoint, EndpointKind},
    ids::Gid,
    internal::SessionKey,
    qos::{Durability, Qos},
};

use super::{
    greedy::Camera,
    mode::classic,
    pair::{Host, Plan},
    process::{PATIENCE, until},
    stranger::{Met, high_id},
};

pub(crate) const TOPIC: &str = "/hoarded";
pub(crate) const TYPE: &str = "test/Bytes";
/// Daemon ids of the peer, and data streams of each.
const IDS: u8 = 4;
const STREAMS: usize = 48;
/// Number of bytes that the peer tries to send over each stream.
const BYTES: usize = 8 << 20;
/// Number of these bytes that the daemon may hold: 64 MiB of long messages in progress and 16 MiB of short ones, and in
/// QUIC's windows 64 MiB of all links and 1 MiB of each.
const STATED: usize = (64 + 16 + 64 + IDS as usize) << 20;
/// The bound includes the overhead of a debug build's allocator and of quinn for each waiting packet: a fifth.
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
    let graph = GraphUpdate { version: 1, added, ..GraphUpdate::default() };
    camera.stranger.say(met, &LinkMessage::Graph(graph));
    let asked = |m: &LinkMessage| matches!(m, LinkMessage::Subscribe(s) if s.topic == topic);
    match camera.stranger.hear(met, asked) {
        Ok(LinkMessage::Subscribe(subscribe)) => subscribe.route,
        other => panic!("{other:?}"),
    }
}

#[test]
fn in_flight_memory_of_a_peer_is_bounded_across_ids_and_released() {
    let camera = Camera::new();
    let spec = EndpointSpec::new(TOPIC, TYPE, Qos::keep_all());
    let session = camera.a.session("slow");
    let _reads_nothing = session.create_subscription(spec).unwrap();
    let before = camera.memory("VmRSS");
    let mut met = Vec::new();
    let mut streams = Vec::new();
    let keys: Vec<_> = (0..IDS).map(|_| SessionKey::generate().unwrap()).collect();
    for (id, key) in (0..IDS).map(|id| 0xff - id).zip(&keys) {
        let mut link = camera.link(id);
        camera.stranger.prove(&mut link, high_id(id), &[key]);
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
fn incomplete_short_messages_are_bounded_for_a_peer_and_freed() {
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
        camera.stranger.prove(&mut link, high_id(id), &[key]);
        let publishers: Vec<_> = (1..=PUBLISHERS).map(|n| Gid::new(key.id(), n)).collect();
        let route = all_published(&camera, &mut link, &topic, &publishers);
        links.push((link, route, publishers));
    }
    // The memory of the publishers is allocated before.
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
    // The bound is 16 MiB of short messages in progress, the windows of all links, and the daemon's memory for each
    // stream.
    let stated = (16 + 64 + SHORT_IDS as usize) << 20;
    assert!(most < stated + stated / 5, "{most}");
    assert!(links.iter().all(|(link, ..)| link.connection.close_reason().is_none()));
    drop(streams);
    links.iter().for_each(|(link, ..)| camera.stranger.leave(link));
    until("memory is given back", || camera.memory("VmRSS") < before + (16 << 20));
}

/// MiB that the samples and calls of a peer may take that are kept here for readers and servers.
const HELD_MB: usize = 64;
/// Other memory that may come with the messages: those in flight, and the rings themselves.
const BESIDE_MB: usize = 32;
/// Publishers and clients of the peer, and messages of 1 MiB of each: three times as much as it may have here.
const WRITERS: usize = 8;
const MESSAGES: u64 = 24;

/// Starts two hosts, the first of which limits the memory that it keeps for the second. Also returns the initial shared
/// memory of its daemon.
fn bounded() -> ([Host; 2], usize) {
    let held = HELD_MB.to_string();
    let hosts = Plan::new([classic(&[("AXON_LINK_HELD_MB", &held)]), classic(&[])]).start();
    hosts[0].link();
    let before = hosts[0].memory("RssShmem");
    (hosts, before)
}

/// Checks that the memory that the first host keeps for the second is within the bound, and near it.
fn is_bounded(host: &Host, before: usize) {
    let of_link = || {
        let link = host.link();
        (link.held_bytes as usize >> 20, link.held_limit as usize >> 20)
    };
    // A link's status is renewed each second.
    until("most of what it may is held", || of_link().0 > HELD_MB / 2);
    let (held, limit) = of_link();
    let memory = host.memory("RssShmem").saturating_sub(before) >> 20;
    eprintln!("{held} MiB held of {limit}, and {memory} MiB of shared memory");
    assert!(limit == HELD_MB && held <= limit, "{held} of {limit}");
    assert!(memory <= HELD_MB + BESIDE_MB, "{memory} MiB");
}

fn latched(topic: usize) -> EndpointSpec {
    let qos = Qos::keep_all().with_durability(Durability::TransientLocal);
    EndpointSpec::new(format!("/kept_{topic}"), TYPE, qos)
}

#[test]
fn history_that_is_delivered_is_bounded_for_a_peer_and_its_newest_is_kept() {
    let ([a, b], before) = bounded();
    let (here, there) = (a.session("reader"), b.session("writer"));
    let readers: Vec<_> =
        (0..WRITERS).map(|n| here.create_subscription(latched(n)).unwrap()).collect();
    let writers: Vec<_> =
        (0..WRITERS).map(|n| there.create_publisher(latched(n)).unwrap()).collect();
    until("all are matched", || {
        readers.iter().zip(&writers).all(|(r, w)| r.matched().contains(&w.gid()))
            && writers.iter().all(|w| !w.matched().is_empty())
    });
    let mut bytes = Vec::new();
    for number in 1..=MESSAGES {
        for (reader, writer) in readers.iter().zip(&writers) {
            writer.publish(&vec![number as u8; 1 << 20]).unwrap();
            // A reader that takes all gets all.
            let info = reader.recv(&mut bytes, Some(PATIENCE)).expect("a sample");
            assert_eq!((info.sequence, bytes[0]), (number, number as u8));
        }
    }
    is_bounded(&a, before);
    // A late reader gets the newest samples, as many as there are.
    let mut late = 0;
    for n in 0..WRITERS {
        let reader = here.create_subscription(latched(n)).unwrap();
        let mut last = 0;
        while last < MESSAGES {
            last = reader.recv(&mut bytes, Some(PATIENCE)).expect("history").sequence;
            late += 1;
        }
    }
    eprintln!("{late} samples of history");
    // The publishers end, and their memory comes back.
    drop((writers, readers, there));
    until("memory is given back", || a.link().held_bytes < 1 << 20);
}

#[test]
fn untaken_requests_are_bounded_for_a_peer_without_loss() {
    let ([a, b], before) = bounded();
    let here = a.session("servers");
    let service = |name: &str| EndpointSpec::new(name.to_owned(), "test/Set", Qos::keep_all());
    let [slow, quick] = ["/slow", "/quick"].map(|s| here.create_server(service(s)).unwrap());
    let sessions: Vec<Session> = (0..WRITERS).map(|_| b.session("client")).collect();
    let clients: Vec<_> =
        sessions.iter().map(|s| s.create_client(service("/slow")).unwrap()).collect();
    let other = sessions[0].create_client(service("/quick")).unwrap();
    assert!(other.wait_available(PATIENCE) && clients.iter().all(|c| c.wait_available(PATIENCE)));
    let mut sent = 0;
    for number in 1..=MESSAGES {
        for client in &clients {
            // One that finds no room on its own host is not under way.
            sent += u64::from(client.send_request(&vec![number as u8; 1 << 20]).is_ok());
        }
    }
    until("as much as may be is there", || a.link().held_bytes > (HELD_MB as u64) << 19);
    let mut bytes = Vec::new();
    // The peer's requests to another server are answered meanwhile.
    let number = other.send_request(b"now").unwrap();
    let asked = quick.recv_request(&mut bytes, Some(PATIENCE)).expect("a request");
    quick.send_response(asked.publisher, asked.sequence, b"done").unwrap();
    assert_eq!(other.recv_response(&mut bytes, Some(PATIENCE)).unwrap().sequence, number);
    is_bounded(&a, before);
    for taken in 0..sent {
        slow.recv_request(&mut bytes, Some(PATIENCE))
            .unwrap_or_else(|error| panic!("{taken} of {sent}: {error}"));
    }
}
