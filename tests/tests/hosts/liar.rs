//! A pinned peer whose samples have numbers that no publisher can have reached.

use axon_envelope::inner::Header;
use axon_transport::{
    ids::{DaemonId, Gid},
    owner::SessionKey,
    qos::Qos,
    session::EndpointSpec,
};

use super::{
    greedy::Camera,
    hoard::{TOPIC, TYPE, published},
    process::{PATIENCE, until},
};

#[test]
fn a_number_that_cannot_be_is_refused_counted_by_topic_and_loses_nothing_else() {
    let camera = Camera::new();
    let session = camera.a.session("reader");
    let spec = EndpointSpec::new(TOPIC, TYPE, Qos::keep_all());
    let subscription = session.create_subscription(spec).unwrap();
    let (mut link, key) = (camera.link(0xff), SessionKey::generate().unwrap());
    camera.stranger.prove(&mut link, DaemonId([0xff; 16]), &[&key]);
    let publisher = Gid::new(key.id(), 1);
    let route = published(&camera, &mut link, publisher);
    let mut bytes = vec![1, 0, 0, 0];
    bytes.extend_from_slice(&route.to_be_bytes());
    bytes.extend_from_slice(&publisher.0);
    let payload = b"sample";
    for sequence in [u64::MAX, 1, u64::MAX - 1, 1 << 50, 2] {
        let header = Header {
            gid: publisher.0,
            sequence,
            source_timestamp: 0,
            request_id: Default::default(),
            compressed: false,
            age_ms: 0,
            uncompressed_len: payload.len() as u32,
        };
        let header = header.encode();
        bytes.extend_from_slice(&u32::to_be_bytes((header.len() + payload.len()) as u32));
        bytes.extend_from_slice(&header);
        bytes.extend_from_slice(payload);
    }
    let mut stream = camera.stranger.open(&link).expect("a stream");
    camera.stranger.write_for(&mut stream, &bytes, PATIENCE);
    for sequence in 1..=2 {
        let info = subscription.recv(&mut Vec::new(), Some(PATIENCE)).expect("a sample");
        assert_eq!((info.sequence, subscription.lost()), (sequence, 0));
    }
    until("what was refused is counted where it was dropped", || {
        let topics = camera.a.status().topics;
        let topic = topics.iter().find(|topic| topic.topic == TOPIC);
        topic.is_some_and(|topic| topic.dropped.get("ring") == Some(&3))
    });
    camera.a.wait_log(&["samples from a peer are lost", TOPIC]);
    assert_eq!(camera.a.status().links.iter().filter(|link| link.host == "camera").count(), 1);
}
