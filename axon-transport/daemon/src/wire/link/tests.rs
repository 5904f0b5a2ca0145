//! Tests frames with hostile and with ordinary input.

use axon_shm::ids::Gid;
use proptest::prelude::*;

use super::{samples::messages, *};

fn decode(frame: &[u8]) -> Result<Option<LinkMessage>, FrameError> {
    LinkMessage::from_frame(frame, MAX_INFLATED)
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
    let removed = (0..4096u32).map(|n| Gid::new(axon_shm::ids::SessionId([1; 16]), n)).collect();
    let message = LinkMessage::Graph(GraphUpdate { version: 1, removed, ..GraphUpdate::default() });
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
    let expected = LinkMessage::Unsubscribe(Unsubscribe { route: 1 });
    assert_eq!(decode(&map).unwrap(), Some(expected));
}

#[test]
fn an_unknown_type_is_skipped_without_decompression() {
    // This frame is not a zstd frame, and its length exceeds every map's.
    for length in [16, u32::MAX] {
        let frame = [&[0xff][..], &length.to_be_bytes(), b"no zstd frame"].concat();
        assert_eq!(decode(&frame).unwrap(), None);
    }
    for kind in 0..0x80 {
        let skipped = matches!(LinkMessage::decode(kind, &[0xa0]), Ok(None));
        assert_eq!(skipped, !LinkMessage::is_known(kind), "type {kind}");
    }
}

#[test]
fn a_list_of_more_publishers_than_there_can_be_is_refused() {
    let gids = |count| vec![Gid::default(); count];
    let ready = |count| LinkMessage::RouteReady(RouteReady { route: 1, publishers: gids(count) });
    let asserted = |count| LinkMessage::Asserted(LivelinessAsserted { publishers: gids(count) });
    let taken = |message: LinkMessage| decode(body(&message.to_frame().unwrap())).is_ok();
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
        which in 0..messages().len(), at in any::<prop::sample::Index>(), byte in any::<u8>()
    ) {
        let mut frame = messages()[which].to_frame().unwrap();
        let at = at.index(frame.len() - 4) + 4;
        frame[at] = byte;
        let _ = decode(&frame[4..]);
    }
}
