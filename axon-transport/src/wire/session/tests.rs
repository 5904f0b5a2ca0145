//! Tests the decoding of packets from any sender.

use proptest::prelude::*;

use super::*;
use crate::graph::EndpointKind;

fn endpoint() -> Endpoint {
    Endpoint {
        gid: Gid([7; 16]),
        kind: EndpointKind::Publisher,
        topic: "/scan".into(),
        type_name: "sensor_msgs/msg/LaserScan".into(),
        type_hash: vec![1, 2, 3],
        qos: Qos::keep_all(),
        node: "lidar".into(),
        namespace: "/".into(),
        enclave: String::new(),
    }
}

fn messages() -> Vec<SessionMessage> {
    let (reader, writer) = (Gid([1; 16]), Gid([2; 16]));
    let session = SessionId([3; 16]);
    vec![
        SessionMessage::Hello(SessionHello {
            protocol: PROTOCOL,
            session,
            role: SessionRole::Application,
            name: "talker".into(),
            domain: 7,
            settings: vec![("AXON_SECURITY_MODE".into(), "classic".into())],
            relay: Some("AXON_SHM is off".into()),
            range: Some(0),
            static_peers: None,
        }),
        SessionMessage::Welcome(Welcome {
            protocol: 1,
            daemon: DaemonId([4; 16]),
            pid: 12,
            ranges: Some(true),
        }),
        SessionMessage::Refused(SessionRefused {
            variable: "AXON_QUIC_CIPHER".into(),
            ours: "a".into(),
            theirs: "b".into(),
            text: String::new(),
            endpoint: Some(writer),
        }),
        SessionMessage::Endpoint(Announce {
            endpoint: endpoint(),
            role: EndpointRole::Relay,
            stands_for: vec![reader, writer],
            ring: Some(Location { segment: 0, offset: 4096 }),
            only: Some(writer),
        }),
        SessionMessage::EndpointGone(Gone { gid: reader }),
        SessionMessage::Graph(SessionGraph {
            version: 3,
            whole: true,
            added: vec![GraphItem {
                endpoint: endpoint(),
                daemon: Some(DaemonId([9; 16])),
                reach: None,
            }],
            removed: vec![writer],
            more: false,
            ended: Some(vec![Gid([8; 16])]),
        }),
        SessionMessage::Match(Pair { reader, writer }),
        SessionMessage::Attach(Attach {
            reader,
            writer,
            lane: Location { segment: 3, offset: 1 << 33 },
            qos: Qos::default(),
            session,
            stands_for: Some(vec![]),
            segments: vec![Segment { number: 3, publisher: None }],
            after: Some(8),
            carries: Some(true),
        }),
        SessionMessage::Grant(Granted {
            reader,
            writer,
            generation: 5,
            first: 6,
            session,
            ring: Location { segment: 0, offset: 4096 },
            segments: vec![Segment { number: 7, publisher: Some(writer) }],
            after: Some(11),
            relayed: Some(true),
        }),
        SessionMessage::Detach(Pair { reader, writer }),
        SessionMessage::Unmatch(Unmatch { reader, writer, reason: "gone".into() }),
        SessionMessage::StatusRequest,
        SessionMessage::Reload,
        SessionMessage::AccessCheck(AccessCheck {
            daemon: DaemonId([9; 16]),
            uses: vec![CheckedUse { verb: 0, name: "/scan".into() }],
        }),
        SessionMessage::Status(StatusPart { part: 0, parts: 1, text: b"{}".to_vec() }),
        SessionMessage::Resync,
        SessionMessage::Segment(SegmentOpened {
            session,
            segment: Segment { number: 9, publisher: Some(writer) },
        }),
        SessionMessage::SegmentGone(SegmentName { session, number: 9 }),
        SessionMessage::Need(SegmentName { session, number: 9 }),
        SessionMessage::Leaving(WriterLeaving { gid: writer, leaving: true }),
        SessionMessage::Fence(Fence { writer, number: 12 }),
        SessionMessage::Unmet(Unmet { reader, writer, samples: 13 }),
        SessionMessage::Matched(RelayMatched { gid: reader, others: vec![writer] }),
        SessionMessage::SampleFragment(SampleFragment {
            publisher: writer,
            head: Some(SampleHeader {
                length: 3,
                sequence: 7,
                source_timestamp: -1,
                lost: 2,
                published: 9,
            }),
            bytes: vec![1, 2],
            client: None,
        }),
        SessionMessage::SampleFragment(SampleFragment {
            publisher: writer,
            head: None,
            bytes: vec![3],
            client: Some(reader),
        }),
        SessionMessage::Credit(Credit {
            publisher: writer,
            bytes: 128,
            opens: Some(3),
            client: None,
            done: Some(8),
        }),
        SessionMessage::Asserted(Asserted { publishers: vec![writer] }),
    ]
}

#[test]
fn hostile_packets_are_errors() {
    assert!(matches!(SessionMessage::decode(&[]), Err(CodecError::Empty)));
    assert!(matches!(
        SessionMessage::decode(&vec![0; MAX_PACKET + 1]),
        Err(CodecError::TooLarge(n)) if n == MAX_PACKET + 1
    ));
    assert!(matches!(SessionMessage::decode(&[7]), Err(CodecError::Malformed { kind: 7, .. })));
    // A map without a required key.
    assert!(matches!(SessionMessage::decode(&[5, 0xa0]), Err(CodecError::Malformed { .. })));
    // An array that claims 2^32 elements allocates nothing.
    assert!(SessionMessage::decode(&[6, 0xa1, 3, 0x9a, 0xff, 0xff, 0xff, 0xff]).is_err());
    for message in messages() {
        let mut packet = message.encode().unwrap();
        packet.push(0);
        assert!(SessionMessage::decode(&packet).is_err(), "{message:?} with a byte after it");
        for cut in 1..packet.len() - 1 {
            assert!(SessionMessage::decode(&packet[..cut]).is_err(), "{message:?} cut at {cut}");
        }
    }
}

#[test]
fn unknown_types_and_keys_are_skipped() {
    assert_eq!(SessionMessage::decode(&[200, 1, 2, 3]).unwrap(), SessionMessage::Unknown(200));
    // { 0: pid, 1: .., 99: [1, {2: 3}] } for WELCOME, with one unknown key.
    let mut packet = vec![2];
    let mut e = minicbor::Encoder::new(&mut packet);
    e.map(4).unwrap();
    e.u8(0).unwrap().u8(1).unwrap();
    e.u8(99).unwrap().array(2).unwrap().u8(1).unwrap();
    e.map(1).unwrap().u8(2).unwrap().u8(3).unwrap();
    e.u8(1).unwrap().bytes(&[4; 16]).unwrap();
    e.u8(2).unwrap().u8(12).unwrap();
    let welcome = Welcome { protocol: 1, daemon: DaemonId([4; 16]), pid: 12, ranges: None };
    assert_eq!(SessionMessage::decode(&packet).unwrap(), SessionMessage::Welcome(welcome));
}

#[test]
fn messages_survive_the_wire() {
    for message in messages() {
        let packet = message.encode().unwrap();
        assert_eq!(SessionMessage::decode(&packet).unwrap(), message);
    }
}

#[test]
fn a_message_larger_than_a_packet_is_refused_by_its_sender() {
    let removed = vec![Gid([1; 16]); 3000];
    let graph =
        SessionGraph { version: 1, whole: false, added: vec![], removed, more: false, ended: None };
    assert!(matches!(SessionMessage::Graph(graph).encode(), Err(CodecError::TooLarge(_))));
}

proptest! {
    #[test]
    fn no_packet_panics(packet in proptest::collection::vec(any::<u8>(), 0..512)) {
        let _ = SessionMessage::decode(&packet);
    }

    #[test]
    fn no_mutated_packet_panics(
        which in 0usize..21, at in any::<prop::sample::Index>(), byte: u8,
    ) {
        let mut packet = messages()[which].encode().unwrap();
        let at = at.index(packet.len());
        packet[at] = byte;
        let _ = SessionMessage::decode(&packet);
    }
}
