//! Tests a pinned peer whose samples have numbers that no publisher can have reached, or state a length far beyond the
//! bytes that it sends.

use axon_envelope::inner::Header;
use axon_tests::Sizes;
use axon_transport::{
    EndpointSpec, Subscription,
    ids::{DaemonId, Gid},
    internal::SessionKey,
    qos::Qos,
};

use super::{
    greedy::Camera,
    hoard::{TOPIC, TYPE, published},
    process::{PATIENCE, until},
    stranger::Met,
};

/// Creates a subscription to the peer's topic, on this host.
fn subscription(camera: &Camera) -> Subscription {
    let spec = EndpointSpec::new(TOPIC, TYPE, Qos::keep_all());
    camera.a.session("reader").create_subscription(spec).unwrap()
}

/// The data stream of a publisher that the peer announced.
struct Lies {
    publisher: Gid,
    bytes: Vec<u8>,
}

impl Lies {
    /// Opens the peer's link, and creates the head of its stream.
    fn new(camera: &Camera) -> (Met, Self) {
        let (mut link, key) = (camera.link(0xff), SessionKey::generate().unwrap());
        camera.stranger.prove(&mut link, DaemonId([0xff; 16]), &[&key]);
        let publisher = Gid::new(key.id(), 1);
        let route = published(camera, &mut link, publisher);
        let mut bytes = vec![1, 0, 0, 0];
        bytes.extend_from_slice(&route.to_be_bytes());
        bytes.extend_from_slice(&publisher.0);
        (link, Self { publisher, bytes })
    }

    /// Adds a sample whose header states `length` bytes.
    fn add(&mut self, sequence: u64, compressed: bool, length: u32, payload: &[u8]) {
        let header = Header {
            gid: self.publisher.0,
            sequence,
            source_timestamp: 0,
            request_id: Default::default(),
            compressed,
            age_ms: 0,
            uncompressed_len: length,
        };
        let header = header.encode();
        self.bytes.extend_from_slice(&u32::to_be_bytes((header.len() + payload.len()) as u32));
        self.bytes.extend_from_slice(&header);
        self.bytes.extend_from_slice(payload);
    }
}

/// Returns `length` zeros in a zstd frame of RLE blocks, four bytes for each 128 KiB.
fn zeros(length: u32) -> Vec<u8> {
    const BLOCK: u32 = 128 << 10;
    let mut frame = vec![0x28, 0xb5, 0x2f, 0xfd, 0xa0];
    frame.extend_from_slice(&length.to_le_bytes());
    for from in (0..length).step_by(BLOCK as usize) {
        let (size, last) = ((length - from).min(BLOCK), from + BLOCK >= length);
        frame.extend_from_slice(&(size << 3 | 1 << 1 | u32::from(last)).to_le_bytes()[..3]);
        frame.push(0);
    }
    frame
}

#[test]
fn highly_compressed_samples_arrive_in_order_without_delaying_other_topics() {
    const LENGTH: u32 = 8 << 20;
    const SAMPLES: u64 = 24;
    let camera = Camera::new();
    let mut there = camera.a.subscribe(Sizes::Small);
    let mut stream = camera.b.publish(Sizes::Small, 1, None);
    there.wait_taken(1);
    let subscription = subscription(&camera);
    let (link, mut lies) = Lies::new(&camera);
    let lengths = |sequence: u64| if sequence.is_multiple_of(3) { 6 } else { LENGTH };
    for sequence in 1..=SAMPLES {
        let length = lengths(sequence);
        let (compressed, payload) = match length {
            LENGTH => (true, zeros(length)),
            _ => (false, vec![0; length as usize]),
        };
        lies.add(sequence, compressed, length, &payload);
    }
    let mut data = camera.stranger.open(&link).expect("a stream");
    let before = there.tally().taken;
    camera.stranger.write_for(&mut data, &lies.bytes, PATIENCE);
    let mut sample = Vec::new();
    for sequence in 1..=SAMPLES {
        let info = subscription.recv(&mut sample, Some(PATIENCE)).expect("a sample");
        assert_eq!((info.sequence, subscription.lost()), (sequence, 0));
        assert!(sample.len() == lengths(sequence) as usize && sample.iter().all(|byte| *byte == 0));
    }
    there.wait_taken(before + 1);
    let sent = stream.stop();
    there.wait_taken(sent);
    let tally = there.tally();
    assert_eq!((tally.lost, tally.repeated, tally.corrupt), (0, 0, 0), "{tally:?}");
    assert_eq!(link.connection.close_reason(), None);
}

/// Makes a peer publish samples of these numbers. The daemon delivers 1 and 2, and refuses and counts the others.
/// `reason` is its log text for a refused sample.
fn numbers_are_refused(numbers: &[u64], reason: &str) -> (Camera, Met) {
    let camera = Camera::new();
    let subscription = subscription(&camera);
    let (link, mut lies) = Lies::new(&camera);
    let payload = b"sample";
    for sequence in numbers {
        lies.add(*sequence, false, payload.len() as u32, payload);
    }
    let mut stream = camera.stranger.open(&link).expect("a stream");
    camera.stranger.write_for(&mut stream, &lies.bytes, PATIENCE);
    for sequence in 1..=2 {
        let info = subscription.recv(&mut Vec::new(), Some(PATIENCE)).expect("a sample");
        assert_eq!((info.sequence, subscription.lost()), (sequence, 0));
    }
    let refused = numbers.len() as u64 - 2;
    until("what was refused is counted where it was dropped", || {
        let topics = camera.a.status().topics;
        let topic = topics.iter().find(|topic| topic.topic == TOPIC);
        topic.is_some_and(|topic| topic.dropped.get("ring") == Some(&refused))
    });
    camera.a.wait_log(&["samples from a peer are lost", TOPIC, reason]);
    (camera, link)
}

#[test]
fn a_number_that_its_publisher_cannot_have_reached_counts_as_no_losses() {
    let (_camera, link) = numbers_are_refused(&[1, 1 << 31, 2], "its number is 2147483648");
    assert_eq!(link.connection.close_reason(), None);
}

#[test]
fn a_number_that_cannot_be_is_refused_counted_by_topic_and_loses_nothing_else() {
    let numbers = [u64::MAX, 1, u64::MAX - 1, 1 << 50, 2];
    let (camera, _link) = numbers_are_refused(&numbers, "its number is");
    // The log line is the same as for samples that are dropped for any cause: at most one a second.
    camera.a.wait_log(&["WARN", "samples are dropped", TOPIC, "ring"]);
    assert_eq!(camera.a.status().links.iter().filter(|link| link.host == "camera").count(), 1);
}
