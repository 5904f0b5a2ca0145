//! Two libraries, one envelope: each opens what the other seals, byte for byte the same.
#![cfg(all(feature = "aws-lc-rs", feature = "rust-crypto"))]

mod common;

use axon_envelope::aead::{Aead, AwsLc, RustCrypto};
use axon_envelope::{Delivery, Limits, Opener, RefusalCause, Sealer};
use common::{ROUTE, START, channel, key, key_id};
use proptest::prelude::*;

fn seal<A: Aead>(byte: u8, prefix: [u8; 8], parts: &[&[u8]]) -> Vec<u8> {
    let mut sealer = Sealer::<A>::with_nonce_prefix(&channel(), key_id("key"), key(byte), prefix);
    let len: usize = parts.iter().map(|part| part.len()).sum();
    let mut out = vec![0; sealer.overhead() + len];
    sealer.slot(START, Delivery::Reliable).unwrap().seal_into(ROUTE, parts, &mut out).unwrap();
    out
}

fn open<A: Aead>(byte: u8, envelope: &[u8]) -> Result<Vec<u8>, RefusalCause> {
    let mut opener = Opener::<A>::with_limits(channel(), Limits::default()).unwrap();
    opener.add_key(key_id("key"), key(byte)).unwrap();
    let mut out = vec![0; envelope.len()];
    let apart = opener.open_into(START, ROUTE, envelope, &mut out);
    let apart = apart.map(|len| out[..len].to_vec()).map_err(|error| error.cause().unwrap());

    let mut opener = Opener::<A>::with_limits(channel(), Limits::default()).unwrap();
    opener.add_key(key_id("key"), key(byte)).unwrap();
    let mut frame = envelope.to_vec();
    let in_place = opener.open_in_place(START, ROUTE, &mut frame);
    let in_place = in_place.map(|p| p.to_vec()).map_err(|error| error.cause().unwrap());
    assert_eq!(apart, in_place);
    apart
}

proptest! {
    #[test]
    fn both_write_the_same_and_open_the_same(
        byte: u8,
        prefix: [u8; 8],
        plaintext in prop::collection::vec(any::<u8>(), 0..3_000),
        cut: prop::sample::Index,
        flip: prop::sample::Index,
    ) {
        let (head, tail) = plaintext.split_at(cut.index(plaintext.len() + 1));
        let mut envelope = seal::<AwsLc>(byte, prefix, &[&plaintext]);
        for other in [
            seal::<RustCrypto>(byte, prefix, &[&plaintext]),
            seal::<AwsLc>(byte, prefix, &[head, tail]),
            seal::<RustCrypto>(byte, prefix, &[head, tail]),
        ] {
            prop_assert_eq!(&envelope, &other);
        }
        prop_assert_eq!(open::<AwsLc>(byte, &envelope), Ok(plaintext.clone()));
        prop_assert_eq!(open::<RustCrypto>(byte, &envelope), Ok(plaintext.clone()));

        let body = envelope.len() - plaintext.len() - 16;
        let at = body + flip.index(envelope.len() - body);
        envelope[at] ^= 1;
        prop_assert_eq!(open::<AwsLc>(byte, &envelope), Err(RefusalCause::Unauthentic));
        prop_assert_eq!(open::<RustCrypto>(byte, &envelope), Err(RefusalCause::Unauthentic));
    }
}

#[test]
fn neither_seals_or_opens_between_buffers_of_different_lengths() {
    fn check<A: Aead>() {
        let aead = A::new(&[1; 32]);
        assert!(aead.seal_apart(&[0; 12], b"", &[0; 4], &mut [0; 5]).is_err());
        let mut ciphertext = [0; 4];
        let tag = aead.seal_apart(&[0; 12], b"", &[0; 4], &mut ciphertext).unwrap();
        assert!(aead.open_apart(&[0; 12], b"", &ciphertext, &tag, &mut [0; 5]).is_err());
        assert!(aead.open_apart(&[0; 12], b"", &ciphertext, &tag, &mut [0; 4]).is_ok());
    }
    check::<AwsLc>();
    check::<RustCrypto>();
}

#[test]
fn both_leave_zeroes_where_a_refused_message_lay() {
    fn check<A: Aead>() {
        let mut envelope = seal::<A>(1, [0; 8], &[&[0x5a; 100]]);
        let body = envelope.len() - 116;
        let mut opener = Opener::<A>::with_limits(channel(), Limits::default()).unwrap();
        let mut out = [0xaa; 100];
        // No key is held, so all there is to decrypt with is the opener's decoy.
        opener.open_into(START, ROUTE, &envelope, &mut out).unwrap_err();
        assert_eq!(out, [0; 100], "{}", A::NAME);
        opener.open_in_place(START, ROUTE, &mut envelope).unwrap_err();
        assert_eq!(envelope[body..][..100], [0; 100], "{}", A::NAME);
    }
    check::<AwsLc>();
    check::<RustCrypto>();
}
