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
/// What of it the daemon may hold: 64 MiB of all its links and 1 MiB of each, in a debug build with what
/// quinn adds to each packet.
const BOUND: usize = 160 << 20;

/// Announces a publisher of the topic, and waits until it is subscribed to: the route.
pub(crate) fn published(camera: &Camera, met: &mut Met, of: Gid) -> u32 {
    let publisher = Endpoint {
        gid: of,
        kind: EndpointKind::Publisher,
        topic: TOPIC.into(),
        type_name: TYPE.into(),
        type_hash: Vec::new(),
        qos: Qos::keep_all(),
        node: "hoard".into(),
        namespace: "/".into(),
        enclave: String::new(),
    };
    let graph = Graph { version: 1, added: vec![publisher], ..Graph::default() };
    camera.stranger.say(met, &Message::Graph(graph));
    let asked = |m: &Message| matches!(m, Message::Subscribe(s) if s.topic == TOPIC);
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
