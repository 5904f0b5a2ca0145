//! Frames and HELLO under hostile and ordinary input.

use axon_envelope::{IndexMask, KeyId};
use proptest::prelude::*;

use super::*;
use crate::{
    ids::{DaemonId, Gid},
    keys::KeyMessage,
    owner::Proof,
    qos::Qos,
};

fn decode(frame: &[u8]) -> Result<Option<Message>, FrameError> {
    Message::from_frame(frame, MAX_INFLATED)
}

fn key_id(id: &str) -> KeyId {
    KeyId::new(id).unwrap()
}

fn hello() -> Hello {
    Hello {
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
        replaces: None,
        expects: None,
        static_peer: false,
    }
}

fn peer() -> Hello {
    Hello { daemon: DaemonId([2; 16]), sae: Some("sae-b".into()), ..hello() }
}

fn elected() -> Message {
    Message::Elected(Elected { link: [9; 16], election: 3 })
}

fn messages() -> Vec<Message> {
    let qos = Qos { lifespan: Some(7), ..Qos::keep_all() };
    vec![
        Message::Hello(Hello {
            replaces: Some([3; 16]),
            expects: Some(DaemonId([4; 16])),
            ..hello()
        }),
        elected(),
        Message::Graph(Graph {
            version: 2,
            before: 1,
            added: vec![],
            removed: vec![Gid([5; 16])],
            more: true,
            localhost: None,
            listing: None,
        }),
        Message::GraphResync(GraphResync { version: 2 }),
        Message::Subscribe(Subscribe {
            route: 1,
            topic: "/scan".into(),
            type_name: "sensor_msgs/msg/LaserScan".into(),
            kind: 0,
            subscribers: vec![Subscriber { gid: Gid([6; 16]), qos }],
            last: vec![LastSeen { publisher: Gid([7; 16]), sequence: 42 }],
            acknowledges: Some(true),
        }),
        Message::Received(Received {
            flows: vec![ReceivedOf { route: 1, publisher: Gid([7; 16]), sequence: 43, dropped: 1 }],
        }),
        Message::RouteRefused(RouteRefused { route: 1, reason: "why".into(), retry_s: Some(10) }),
        Message::Unsubscribe(Unsubscribe { route: 1 }),
        Message::RouteReady(RouteReady { route: 1, publishers: vec![Gid([7; 16])] }),
        Message::Keepalive,
        Message::Asserted(Asserted { publishers: vec![Gid([7; 16]), Gid([8; 16])] }),
        Message::Owners(Owners { proofs: vec![Proof { key: [1; 32], signature: [2; 64] }; 2] }),
        Message::LinkClosed(LinkClosed { link: [3; 16] }),
        Message::Keys(KeyMessage::Announce(vec![key_id("k1"), key_id("k2")])),
        Message::Keys(KeyMessage::Ready { key_id: key_id("k1"), proof: [8; 32] }),
        Message::Keys(KeyMessage::Failed { key_id: key_id("k2"), reason: "unknown".into() }),
        Message::Keys(KeyMessage::Retire {
            key_id: key_id("k1"),
            used: IndexMask::from_bits(0x3ff).unwrap(),
            reliable: IndexMask::from_bits(0x155).unwrap(),
        }),
    ]
}

fn body(frame: &[u8]) -> &[u8] {
    let prefix: [u8; 4] = frame[..4].try_into().unwrap();
    assert_eq!(read_length(prefix, MAX_FRAME).unwrap(), frame.len() - 4);
    &frame[4..]
}

#[test]
fn every_message_survives_its_frame() {
    for message in messages() {
        let frame = message.to_frame().unwrap();
        assert_eq!(decode(body(&frame)).unwrap(), Some(message));
    }
}

#[test]
fn a_large_graph_is_compressed_and_comes_back() {
    let removed = (0..4096u32).map(|n| Gid::new(crate::ids::SessionId([1; 16]), n)).collect();
    let message = Message::Graph(Graph { version: 1, removed, ..Graph::default() });
    let frame = message.to_frame().unwrap();
    assert!(frame.len() < 4096 * 16 / 2, "{} bytes", frame.len());
    assert_eq!(frame[4] & 0x80, 0x80);
    assert_eq!(decode(body(&frame)).unwrap(), Some(message));
}

#[test]
fn unknown_types_and_keys_are_skipped() {
    assert_eq!(decode(&[0x7f, 0xa0]).unwrap(), None);
    // UNSUBSCRIBE {0: 1, 99: "new"}
    let map = [6, 0xa2, 0x00, 0x01, 0x18, 99, 0x63, b'n', b'e', b'w'];
    let expected = Message::Unsubscribe(Unsubscribe { route: 1 });
    assert_eq!(decode(&map).unwrap(), Some(expected));
}

#[test]
fn an_unknown_type_is_skipped_without_decompression() {
    // No zstd frame, and of a length that no map may have.
    for length in [16, u32::MAX] {
        let frame = [&[0xff][..], &length.to_be_bytes(), b"no zstd frame"].concat();
        assert_eq!(decode(&frame).unwrap(), None);
    }
    for kind in 0..0x80 {
        let skipped = matches!(Message::decode(kind, &[0xa0]), Ok(None));
        assert_eq!(skipped, !Message::is_known(kind), "type {kind}");
    }
}

#[test]
fn a_list_of_more_publishers_than_there_can_be_is_refused() {
    let gids = |count| vec![Gid::default(); count];
    let ready = |count| Message::RouteReady(RouteReady { route: 1, publishers: gids(count) });
    let asserted = |count| Message::Asserted(Asserted { publishers: gids(count) });
    let taken = |message: Message| decode(body(&message.to_frame().unwrap())).is_ok();
    assert!(taken(ready(65_536)) && taken(asserted(65_536)));
    assert!(!taken(ready(65_537)) && !taken(asserted(65_537)));
}

#[test]
fn bounds_are_enforced_before_anything_is_allocated() {
    assert!(matches!(
        read_length([0xff; 4], MAX_FRAME),
        Err(FrameError::TooLarge { limit: MAX_FRAME, .. })
    ));
    assert!(matches!(read_length([0; 4], MAX_FRAME), Err(FrameError::Empty)));
    // A compressed frame that claims 4 GiB, and one that claims less than it holds.
    assert!(decode(&[0x83, 0xff, 0xff, 0xff, 0xff, 0]).is_err());
    let bomb = zstd::bulk::compress(&vec![0; 1 << 20], 1).unwrap();
    let mut frame = vec![0x83, 0, 0, 0, 16];
    frame.extend_from_slice(&bomb);
    assert!(decode(&frame).is_err());
    // An array that claims 2^32 elements.
    assert!(decode(&[16, 0xa1, 0x00, 0x9a, 0xff, 0xff, 0xff, 0xff]).is_err());
}

#[test]
fn a_hello_that_differs_is_refused_by_name() {
    let ours = hello();
    assert_eq!(check(&ours, &peer(), Some("sae-b")), Ok(()));
    let claimed = check(&ours, &peer(), None).unwrap_err();
    assert_eq!(claimed.code, CloseCode::Sae, "an SAE that no PSK names");
    let cases: [(Hello, CloseCode); 9] = [
        (Hello { protocol_min: 2, protocol_max: 3, ..peer() }, CloseCode::Protocol),
        (Hello { daemon: ours.daemon, ..peer() }, CloseCode::Self_),
        (Hello { domain: 5, ..peer() }, CloseCode::Domain),
        (Hello { mode: 0, ..peer() }, CloseCode::Mode),
        (Hello { key_mode: 1, ..peer() }, CloseCode::KeyMode),
        (Hello { kex: 2, ..peer() }, CloseCode::Kex),
        (Hello { cipher: 200, ..peer() }, CloseCode::Cipher),
        (Hello { auth: Some(0), ..peer() }, CloseCode::Auth),
        (Hello { sae: Some("sae-c".into()), ..peer() }, CloseCode::Sae),
    ];
    for (theirs, code) in cases {
        assert_eq!(check(&ours, &theirs, Some("sae-b")).unwrap_err().code, code);
    }
}

#[test]
fn nothing_precedes_hello_proof_and_election() {
    let others: Vec<_> = messages().into_iter().skip(1).collect();
    for side in [Side::Client, Side::Server] {
        let mut order = Order::new(side, true);
        for m in &others {
            assert!(order.accept(m).is_err(), "{} before HELLO", m.name());
        }
        order.accept(&messages()[0]).unwrap();
        assert!(order.accept(&messages()[0]).is_err(), "a second HELLO");
        order.hello_checked(true);
        for m in &others {
            let proof = match side {
                Side::Client => matches!(m, Message::Keys(KeyMessage::Announce(_))),
                Side::Server => {
                    matches!(m, Message::Keys(KeyMessage::Ready { .. } | KeyMessage::Failed { .. }))
                }
            };
            let allowed = proof || matches!(m, Message::Keepalive);
            assert_eq!(order.accept(m).is_ok(), allowed, "{} before the proof", m.name());
        }
        order.proven();
        assert!(order.accept(&Message::Graph(Graph::default())).is_err());
        order.accept(&elected()).unwrap();
        order.elected();
        order.accept(&Message::Graph(Graph::default())).unwrap();
        assert!(order.accept(&elected()).is_err(), "a second ELECTED");
    }
}

#[test]
fn the_higher_id_cannot_elect_and_classic_knows_no_keys() {
    let mut order = Order::new(Side::Server, false);
    order.accept(&messages()[0]).unwrap();
    order.hello_checked(false);
    assert!(order.accept(&elected()).is_err());
    order.elected();
    assert!(order.accept(&Message::Keys(KeyMessage::Announce(vec![key_id("k")]))).is_err());
}

#[test]
fn close_codes_survive_the_wire() {
    for code in 0..=0x60u64 {
        if let Some(close) = CloseCode::from_code(code) {
            assert_eq!(u64::from(close.code()), code);
        }
    }
    assert_eq!(CloseCode::from_code(0x22), Some(CloseCode::Envelope));
}

proptest! {
    #[test]
    fn no_bytes_make_the_decoder_panic(bytes in proptest::collection::vec(any::<u8>(), 0..512)) {
        let _ = decode(&bytes);
    }

    #[test]
    fn no_damaged_frame_makes_the_decoder_panic(
        which in 0usize..15, at in any::<prop::sample::Index>(), byte in any::<u8>()
    ) {
        let mut frame = messages()[which].to_frame().unwrap();
        let at = at.index(frame.len() - 4) + 4;
        frame[at] = byte;
        let _ = decode(&frame[4..]);
    }
}
