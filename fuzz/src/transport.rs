//! Discovery datagrams, frames between daemons, packets between a session and its daemon.

use std::time::Duration;

use axon_daemon::internal::{
    daemon_key::DaemonProof,
    keys::KeyMessage,
    link::{self, FrameError},
    wire::{
        SecurityTerms,
        beacon::{self, Beacon, Datagram},
    },
};
use axon_envelope::{IndexMask, KeyId};
use axon_shm::internal::{Location, reencode_packet};
use axon_transport::{
    graph::{Endpoint, EndpointKind},
    ids::{DaemonId, Gid, SessionId},
    internal::{
        session::relayed::flow::{FlowChannel, IncomingFlow, ArrivalPool, WINDOW},
        wire::session::{self as session, CodecError, MAX_PACKET},
    },
    qos::Qos,
};

const TERMS: SecurityTerms = SecurityTerms { mode: 0, key_mode: 0, kex: 0, cipher: 0, auth: Some(1) };

/// Checks that a datagram that decodes encodes to a datagram within bounds that decodes to the same.
pub fn beacon(data: &[u8]) -> bool {
    let Ok(datagram) = Datagram::decode(data) else { return false };
    assert!(data.len() <= beacon::LONGEST, "a datagram over the bound was read");
    if let Datagram::Beacon(beacon) = &datagram {
        // Terms this release has no name for must still be nameable.
        let difference = TERMS.first_difference(&beacon.terms);
        assert_eq!(difference.is_none(), TERMS == beacon.terms);
    }
    let encoded = datagram.encode();
    assert!(encoded.len() <= beacon::LONGEST, "encodes to {} bytes", encoded.len());
    let again = Datagram::decode(&encoded).expect("what was encoded decodes");
    assert_eq!(again, datagram);
    true
}

/// Checks that a frame that decodes encodes to a frame that decodes to the same, and that compression changes nothing.
pub fn link_frame(data: &[u8]) -> bool {
    let decoded = link::LinkMessage::from_frame(data, link::MAX_INFLATED);
    if let Some((&kind, map)) = data.split_first().filter(|(kind, _)| **kind & 0x80 == 0) {
        let body = zstd::bulk::compress(map, 1).expect("zstd takes any bytes");
        let length = u32::try_from(map.len()).expect("inputs are short").to_be_bytes();
        let frame = [&[kind | 0x80][..], &length, &body].concat();
        let inflated = link::LinkMessage::from_frame(&frame, link::MAX_INFLATED);
        assert_eq!(inflated.as_ref().ok(), decoded.as_ref().ok(), "compression matters");
    }
    let Ok(Some(message)) = decoded else { return false };
    match message.to_frame() {
        Ok(frame) => {
            let (prefix, body) = frame.split_first_chunk::<4>().expect("a frame has a length");
            let length = link::read_length(*prefix, link::MAX_FRAME).expect("the length is right");
            assert_eq!(length, body.len());
            let again = link::LinkMessage::from_frame(body, link::MAX_INFLATED)
                .expect("what was encoded decodes");
            assert_eq!(again, Some(message));
        }
        // Only what came compressed can be as large.
        Err(FrameError::TooLarge { .. }) => assert!(data[0] & 0x80 != 0),
        Err(other) => panic!("does not encode: {other}"),
    }
    true
}

/// Checks that a message that decodes encodes to a packet that decodes to the same.
pub fn session_message(data: &[u8]) -> bool {
    let Ok(message) = session::SessionMessage::decode(data) else { return false };
    match message.encode() {
        Ok(packet) => {
            let again = session::SessionMessage::decode(&packet).expect("what was encoded decodes");
            assert_eq!(again, message);
        }
        // An array of indefinite length can be a byte shorter than its definite spelling.
        Err(CodecError::TooLarge(_)) => assert!(data.len() > MAX_PACKET - 16),
        Err(other) => panic!("does not encode: {other}"),
    }
    true
}

/// Checks that a packet that decodes encodes to a packet that decodes to the same.
pub fn connect_packet(data: &[u8]) -> bool {
    let Some(packet) = reencode_packet(data) else { return false };
    assert_eq!(reencode_packet(&packet), Some(packet));
    true
}

/// A publisher's, and those of a server's responses to two clients.
fn relay_channels() -> [FlowChannel; 3] {
    let [writer, one, other] = [1, 2, 3].map(|number| Gid([number; 16]));
    [FlowChannel::of(writer), FlowChannel::between(writer, one), FlowChannel::between(writer, other)]
}

/// Checks the packets of a relayed session, each behind its length: for any content of the pieces, the session keeps no
/// more bytes than its credit, and gives back all credit.
pub fn relay_pieces(data: &[u8]) -> bool {
    const MAX: u64 = 100_000;
    let pool = ArrivalPool::new(MAX);
    let mut incoming = IncomingFlow::new(MAX, pool.clone());
    let channels = relay_channels();
    for channel in channels {
        assert!(incoming.open(channel, 0).is_some_and(|credit| credit.bytes == WINDOW));
    }
    let mut kept = Vec::new();
    let mut packets = data;
    while let Some((length, rest)) = packets.split_first_chunk::<2>() {
        let length = usize::from(u16::from_be_bytes(*length)).min(rest.len());
        let (packet, rest) = rest.split_at(length);
        packets = rest;
        let Ok(session::SessionMessage::SampleFragment(piece)) = session::SessionMessage::decode(packet) else {
            return false;
        };
        match incoming.piece(piece) {
            Ok(Some(sample)) => kept.push(sample),
            Ok(None) => {}
            Err(_) => return false,
        }
        incoming.grants();
        let bytes: usize = kept.iter().map(|sample| sample.payload.len()).sum();
        assert!(bytes as u64 <= channels.len() as u64 * WINDOW + pool.held(), "{bytes} are kept");
        if kept.len() > 3 {
            incoming.done(&kept.remove(0));
        }
    }
    for sample in &kept {
        incoming.done(sample);
    }
    drop(incoming);
    assert_eq!(pool.held(), 0, "something is kept for ever");
    true
}

/// Every kind of datagram.
pub fn beacon_seeds() -> Vec<Vec<u8>> {
    let daemon = DaemonId([1; 16]);
    let beacon = Beacon {
        protocols: (1, 1),
        domain: 7,
        daemon,
        terms: TERMS,
        sae: None,
        port: 61_300,
        addresses: vec!["192.0.2.1".parse().unwrap(), "2001:db8::1".parse().unwrap()],
        graph: 0x0123_4567_89ab_cdef,
        answer_wanted: true,
        localhost: false,
    };
    let qkd = SecurityTerms { mode: SecurityTerms::QKD, key_mode: 2, kex: 1, cipher: 0, auth: None };
    let qkd = Beacon { terms: qkd, sae: Some("sae-a".into()), localhost: true, ..beacon.clone() };
    let foreign = beacon::Foreign { protocols: (2, 9), domain: 7, daemon };
    [
        Datagram::Beacon(beacon),
        Datagram::Beacon(qkd),
        Datagram::Foreign(foreign),
        Datagram::Goodbye { domain: 7, daemon },
        Datagram::Probe { daemon, nonce: [2; 8] },
        Datagram::Echo { daemon, nonce: [2; 8] },
    ]
    .iter()
    .map(Datagram::encode)
    .collect()
}

fn endpoint() -> Endpoint {
    Endpoint::new(Gid([7; 16]), EndpointKind::Publisher, "/scan", "sensor_msgs/msg/LaserScan")
        .with_qos(
            Qos::keep_all()
                .with_deadline(Duration::from_nanos(5))
                .with_lifespan(Duration::from_nanos(6)),
        )
        .with_type_hash(vec![1, 2, 3])
        .with_node("lidar", "/")
}

/// Every message of the control stream, one of them large enough to be compressed.
pub fn link_frame_seeds() -> Vec<Vec<u8>> {
    use link::LinkMessage;
    let hello = link::LinkHello {
        protocol_min: 1,
        protocol_max: 1,
        domain: 0,
        daemon: DaemonId([1; 16]),
        mode: 1,
        key_mode: 2,
        kex: 1,
        cipher: 0,
        sae: Some("sae-a".into()),
        host: "robot".into(),
        auth: None,
        replaces: Some([3; 16]),
        expects: Some(DaemonId([4; 16])),
        static_peer: true,
        routes: Some(1024),
        proof: Some(DaemonProof { key: [5; 32], signature: [6; 64] }),
        paths: Some(2),
        beside: Some([8; 16]),
    };
    let gid = Gid([6; 16]);
    let key_id = KeyId::new("bc490419-7d60-487f-adc1-4ddcc177c139").unwrap();
    let graph = |endpoints| link::GraphUpdate {
        version: 2,
        before: 1,
        added: vec![endpoint(); endpoints],
        removed: vec![gid],
        more: endpoints > 1,
        localhost: Some(vec![gid]),
        listing: Some(vec![gid]),
        denied: Some(vec![gid]),
    };
    let mask = |bits| IndexMask::from_bits(bits).unwrap();
    let messages = [
        LinkMessage::Hello(hello),
        LinkMessage::Elected(link::Elected { link: [9; 16], election: 3, standby: None }),
        LinkMessage::Elected(link::Elected { link: [9; 16], election: 3, standby: Some(true) }),
        LinkMessage::SwitchOver,
        LinkMessage::Graph(graph(1)),
        LinkMessage::Graph(graph(64)),
        LinkMessage::GraphResync(link::GraphResync { version: 2 }),
        LinkMessage::Asserted(link::LivelinessAsserted { publishers: vec![gid] }),
        LinkMessage::Owners(link::Owners {
            proofs: vec![axon_daemon::internal::owner::Proof { key: [1; 32], signature: [2; 64] }],
        }),
        LinkMessage::Subscribe(link::Subscribe {
            route: 1,
            topic: "/scan".into(),
            type_name: "sensor_msgs/msg/LaserScan".into(),
            kind: 0,
            subscribers: vec![link::RouteSubscriber { gid, qos: Qos::default() }],
            last: vec![link::LastSeen { publisher: gid, sequence: 42 }],
            acknowledges: Some(true),
            short_headers: None,
        }),
        LinkMessage::Received(link::ReceivedUpTo {
            flows: vec![link::ReceivedOf { route: 1, publisher: gid, sequence: 43, dropped: 1 }],
        }),
        LinkMessage::RouteRefused(link::RouteRefused {
            route: 1,
            reason: "why".into(),
            retry_s: Some(10),
        }),
        LinkMessage::RouteUnasked(link::RouteUnasked {
            topic: "/scan".into(),
            type_name: "sensor_msgs/msg/LaserScan".into(),
            kind: 0,
            reason: Some("why".into()),
        }),
        LinkMessage::Unsubscribe(link::Unsubscribe { route: 1 }),
        LinkMessage::RouteReady(link::RouteReady { route: 1, publishers: vec![gid] }),
        LinkMessage::Keepalive,
        LinkMessage::LinkClosed(link::LinkClosed { link: [3; 16] }),
        LinkMessage::ReceiveLimits(link::ReceiveLimits { unread: 33 << 20, messages: 64 << 20 }),
        LinkMessage::Denied(link::DeniedUses {
            denied: vec![link::DeniedUse {
                verb: 0,
                name: "/cmd_vel".into(),
                reason: "denied by line 4 of access.toml".into(),
            }],
            lifted: vec![link::DeniedUse { verb: 3, name: "/dock".into(), reason: String::new() }],
        }),
        LinkMessage::AccessCheck(link::LinkAccessCheck {
            number: 5,
            uses: vec![session::CheckedUse { verb: 4, name: "/scan".into() }],
        }),
        LinkMessage::AccessDecisions(link::AccessDecisions {
            number: 5,
            decisions: vec![link::UseDecision { allowed: true, reason: "line 4".into() }],
        }),
        LinkMessage::Keys(KeyMessage::Announce(vec![key_id.clone(), KeyId::new("k2").unwrap()])),
        LinkMessage::Keys(KeyMessage::Ready { key_id: key_id.clone(), proof: [8; 32] }),
        LinkMessage::Keys(KeyMessage::Failed { key_id: key_id.clone(), reason: "unknown".into() }),
        LinkMessage::Keys(KeyMessage::Retire { key_id, used: mask(0x3ff), reliable: mask(0x155) }),
    ];
    messages.iter().map(|message| message.to_frame().unwrap().split_off(4)).collect()
}

/// One sample in one piece, one on each of three channels at a time in several, and one longer than a
/// channel's window.
pub fn relay_pieces_seeds() -> Vec<Vec<u8>> {
    use session::{SessionMessage, SampleFragment, SampleHeader};
    let piece = |channel: usize, length: Option<u32>, bytes: usize| {
        let head = length.map(|length| SampleHeader {
            length,
            sequence: 1,
            source_timestamp: 2,
            lost: 3,
            published: 4,
        });
        let FlowChannel { writer: publisher, client } = relay_channels()[channel];
        let piece = SampleFragment { publisher, head, bytes: vec![0; bytes], client };
        let packet = SessionMessage::SampleFragment(piece).encode().unwrap();
        let length = u16::try_from(packet.len()).unwrap().to_be_bytes();
        [&length[..], &packet].concat()
    };
    let begun = [(0, 9, 4), (1, 8, 0), (2, 7, 7)].map(|(of, all, now)| piece(of, Some(all), now));
    let ended = [(1, 8), (0, 5)].map(|(of, rest)| piece(of, None, rest));
    let long = [piece(2, Some(40_000), 30_000), piece(2, None, 10_000)];
    vec![piece(0, Some(3), 3), [begun.concat(), ended.concat()].concat(), long.concat()]
}

/// Every packet between a publisher and a subscriber.
pub fn connect_packet_seeds() -> Vec<Vec<u8>> {
    use session::{Segment, SegmentName, SegmentOpened};
    /// Version, kind, and what a packet of that kind holds: `docs/formats.md`, section 9.
    fn packet<T: minicbor::Encode<()>>(kind: u32, content: T) -> Vec<u8> {
        minicbor::to_vec((2_u32, (kind, (content,)))).expect("it encodes")
    }
    let (reader, writer, session) = (Gid([1; 16]), Gid([2; 16]), SessionId([3; 16]));
    let place = Location { segment: 3, offset: 4096 };
    let segment = Segment { number: 3, publisher: Some(writer) };
    vec![
        packet(0, (session, reader, place, Qos::keep_all())),
        packet(1, (reader, session, writer, 1_u64 << 40, 7_u64, place)),
        packet(2, (reader, "incompatible")),
        packet(3, SegmentOpened { session, segment }),
        packet(4, SegmentName { session, number: 3 }),
    ]
}

/// Every message of the session socket.
pub fn session_message_seeds() -> Vec<Vec<u8>> {
    use session::{
        Announce, Asserted, Attach, Credit, EndpointRole, Gone, Granted, SessionGraph, GraphItem, SessionHello,
        RelayMatched, SessionMessage, PROTOCOL, Pair, SessionRefused, SampleFragment, SampleHeader, Segment,
        SegmentName, SegmentOpened, SessionRole, StatusPart, Unmatch, Unmet, Welcome,
    };
    let (reader, writer) = (Gid([1; 16]), Gid([2; 16]));
    let place = Location { segment: 3, offset: 4096 };
    let segment = Segment { number: 3, publisher: Some(writer) };
    let session = SessionId([3; 16]);
    let daemon = DaemonId([4; 16]);
    let messages = [
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
        SessionMessage::Welcome(Welcome { protocol: PROTOCOL, daemon, pid: 12, ranges: Some(true) }),
        SessionMessage::Refused(SessionRefused {
            variable: "AXON_QUIC_CIPHER".into(),
            ours: "chacha20-poly1305".into(),
            theirs: "aes-256-gcm".into(),
            text: "they differ".into(),
            endpoint: Some(writer),
        }),
        SessionMessage::Endpoint(Announce {
            endpoint: endpoint(),
            role: EndpointRole::Relay,
            stands_for: vec![reader, writer],
            ring: Some(place),
            only: Some(writer),
        }),
        SessionMessage::EndpointGone(Gone { gid: reader }),
        SessionMessage::Graph(SessionGraph {
            version: 3,
            whole: true,
            added: vec![GraphItem { endpoint: endpoint(), daemon: Some(daemon), reach: None }],
            removed: vec![writer],
            more: false,
            ended: Some(vec![writer]),
        }),
        SessionMessage::Match(Pair { reader, writer }),
        SessionMessage::Attach(Attach {
            reader,
            writer,
            lane: place,
            qos: Qos::default(),
            session,
            stands_for: Some(vec![reader]),
            segments: vec![segment],
            after: Some(2),
            carries: Some(true),
        }),
        SessionMessage::Grant(Granted {
            reader,
            writer,
            generation: 5,
            first: 6,
            session,
            ring: place,
            segments: vec![segment],
            after: Some(2),
            relayed: Some(true),
        }),
        SessionMessage::Detach(Pair { reader, writer }),
        SessionMessage::Unmatch(Unmatch { reader, writer, reason: "gone".into() }),
        SessionMessage::StatusRequest,
        SessionMessage::AccessCheck(session::AccessCheck {
            daemon: DaemonId([9; 16]),
            uses: vec![session::CheckedUse { verb: 0, name: "/scan".into() }],
        }),
        SessionMessage::Status(StatusPart { part: 0, parts: 1, text: b"{}".to_vec() }),
        SessionMessage::Resync,
        SessionMessage::Segment(SegmentOpened { session, segment }),
        SessionMessage::SegmentGone(SegmentName { session, number: 3 }),
        SessionMessage::Need(SegmentName { session, number: 3 }),
        SessionMessage::Unmet(Unmet { reader, writer, samples: 12 }),
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
        SessionMessage::Credit(Credit {
            publisher: writer,
            bytes: 128,
            opens: Some(3),
            client: Some(reader),
            done: Some(7),
        }),
        SessionMessage::Asserted(Asserted { publishers: vec![writer] }),
        SessionMessage::Unknown(200),
    ];
    messages.iter().map(|message| message.encode().unwrap()).collect()
}
