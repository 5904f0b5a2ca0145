//! Protection with the public keys of QUIC: the integrity tag of Retry packets.

use aws_lc_rs::aead::{AES_128_GCM, Aad, LessSafeKey, NONCE_LEN, Nonce, UnboundKey};

/// Returns the tag of a Retry packet of QUIC version 1 (RFC 9001 section 5.8).
///
/// `packet` is the Retry packet without its tag.
pub(super) fn retry_tag(original_dst_cid: &[u8], packet: &[u8]) -> [u8; TAG_LEN] {
    let mut tag = [0; TAG_LEN];
    let sealed = key()
        .seal_in_place_separate_tag(
            Nonce::assume_unique_for_key(NONCE),
            Aad::from(pseudo_packet(original_dst_cid, &[packet])),
            &mut [],
        )
        .expect("an empty message and a short header are within the limits of AES-GCM");
    tag.copy_from_slice(sealed.as_ref());
    tag
}

/// Returns whether `header` and `payload`, which ends with the tag, form a valid Retry packet.
pub(super) fn is_valid_retry(original_dst_cid: &[u8], header: &[u8], payload: &[u8]) -> bool {
    let Some((token, tag)) = payload.split_last_chunk::<TAG_LEN>() else {
        return false;
    };
    let aad = Aad::from(pseudo_packet(original_dst_cid, &[header, token]));
    key().open_in_place(Nonce::assume_unique_for_key(NONCE), aad, &mut tag.to_vec()).is_ok()
}

/// Returns the Retry packet after the original connection ID, which only the client and the server
/// know.
fn pseudo_packet(original_dst_cid: &[u8], parts: &[&[u8]]) -> Vec<u8> {
    // connection IDs have at most 20 bytes
    let mut pseudo = vec![original_dst_cid.len() as u8];
    pseudo.extend_from_slice(original_dst_cid);
    for part in parts {
        pseudo.extend_from_slice(part);
    }
    pseudo
}

fn key() -> LessSafeKey {
    let key = UnboundKey::new(&AES_128_GCM, &KEY).expect("the key has the length of the algorithm");
    LessSafeKey::new(key)
}

const TAG_LEN: usize = 16;
const KEY: [u8; 16] = [
    0xbe, 0x0c, 0x69, 0x0b, 0x9f, 0x66, 0x57, 0x5a, 0x1d, 0x76, 0x6b, 0x54, 0xe3, 0x68, 0xc8, 0x4e,
];
const NONCE: [u8; NONCE_LEN] =
    [0x46, 0x15, 0x99, 0xd3, 0x5d, 0x63, 0x2b, 0xf2, 0x23, 0x98, 0x25, 0xbb];

#[cfg(test)]
mod tests {
    use super::*;

    /// RFC 9001 appendix A.4.
    #[test]
    fn retry_of_the_rfc() {
        let original_dst_cid = [0x83, 0x94, 0xc8, 0xf0, 0x3e, 0x51, 0x57, 0x08];
        let header = b"\xff\x00\x00\x00\x01\x00\x08\xf0\x67\xa5\x50\x2a\x42\x62\xb5";
        let token = b"token";
        let tag = b"\x04\xa2\x65\xba\x2e\xff\x4d\x82\x90\x58\xfb\x3f\x0f\x24\x96\xba";

        let packet = [&header[..], token].concat();
        assert_eq!(&retry_tag(&original_dst_cid, &packet), tag);

        let payload = [&token[..], tag].concat();
        assert!(is_valid_retry(&original_dst_cid, header, &payload));
        assert!(!is_valid_retry(&original_dst_cid[1..], header, &payload));
        for at in 0..payload.len() {
            let mut changed = payload.clone();
            changed[at] ^= 1;
            assert!(!is_valid_retry(&original_dst_cid, header, &changed));
            assert!(!is_valid_retry(&original_dst_cid, header, &payload[..at]));
        }
    }
}
