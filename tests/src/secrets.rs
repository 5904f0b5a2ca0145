//! Secrets that are derived from a KME key, and the places where they were found.

use std::collections::{BTreeMap, BTreeSet};

use aes::{
    Aes256,
    cipher::{BlockCipherEncrypt, KeyInit},
};
use base64::{Engine, engine::general_purpose::STANDARD};
use hkdf::Hkdf;
use sha2::{Digest, Sha256};

use crate::memory::{Find, Needles, Secret};

impl Needles {
    /// Adds a KME key, raw and as the KME writes it.
    pub fn add_key(&mut self, number: usize, key: &[u8]) {
        self.add("KME key", number, key);
        let secret = Secret { kind: "KME key, base64", number };
        self.add_text(secret, STANDARD.encode(key).as_bytes());
    }

    /// Adds `HKDF-SHA256` of a key: the secrets of [`add_extracted`](Self::add_extracted), and as `kind` the expanded
    /// secret, which it returns.
    pub fn add_derived(
        &mut self,
        kind: &'static str,
        number: usize,
        salt: Option<&[u8]>,
        key: &[u8],
        info: &[&[u8]],
    ) -> [u8; 32] {
        self.add_extracted(number, salt, key);
        let mut derived = [0; 32];
        let expand = Hkdf::<Sha256>::new(salt, key);
        expand.expand_multi_info(info, &mut derived).expect("32 bytes are few");
        self.add(kind, number, &derived);
        derived
    }

    /// Adds the secrets of TLS that a PSK alone decides (RFC 8446, 7.1), with SHA-256: in psk_ke they open
    /// a recording of the connection.
    pub fn add_tls_secrets(&mut self, number: usize, psk: &[u8; 32]) {
        let nothing_heard = Sha256::digest([]);
        let mut salt = [0; 32];
        let zeros = [0; 32];
        let steps =
            [(psk, "early secret"), (&zeros, "handshake secret"), (&zeros, "master secret")];
        for (input, kind) in steps {
            let (secret, hkdf) = Hkdf::<Sha256>::extract(Some(&salt), input);
            self.add(kind, number, &secret);
            let info: [&[u8]; 4] = [&[0, 32, 13], b"tls13 derived", &[32], &nothing_heard];
            hkdf.expand_multi_info(&info, &mut salt).expect("32 bytes are few");
            self.add("derived secret", number, &salt);
        }
    }

    /// Adds the key of GHASH, which AES-256-GCM computes once from its key (NIST SP 800-38D, 7.1). It decrypts nothing,
    /// but an attacker can forge messages with it.
    pub fn add_ghash_key(&mut self, kind: &'static str, number: usize, aead_key: &[u8; 32]) {
        let mut block = [0; 16].into();
        Aes256::new(aead_key.into()).encrypt_block(&mut block);
        let key = u128::from_be_bytes(block.into());
        // Libraries that multiply with the processor's instruction keep it times x, in the field.
        let reduction = if key >> 127 == 1 { 0xc2 << 120 | 1 } else { 0 };
        for key in [key, key << 1 ^ reduction] {
            self.add_text(Secret { kind, number }, &key.to_be_bytes());
            self.add_text(Secret { kind, number }, &key.to_le_bytes());
        }
    }

    /// Adds the blocks that mask the tags of AES-256-GCM for each message of an envelopes' key ([`tag_masks`]).
    pub fn add_tag_masks(
        &mut self,
        kind: &'static str,
        number: usize,
        aead_key: &[u8; 32],
        nonce_prefix: [u8; 8],
    ) {
        for mask in tag_masks(aead_key, nonce_prefix) {
            self.add_text(Secret { kind, number }, &mask);
        }
    }

    /// Adds the key that `HKDF-SHA256` extracts from a key, and the two states of HMAC that are equivalent to it.
    pub fn add_extracted(&mut self, number: usize, salt: Option<&[u8]>, key: &[u8]) {
        let (prk, _) = Hkdf::<Sha256>::extract(salt, key);
        self.add("PRK", number, &prk);
        for mask in [0x36, 0x5c] {
            let mut block = [mask; 64];
            block.iter_mut().zip(&prk).for_each(|(block, prk)| *block ^= prk);
            let mut state = INITIAL;
            sha2::block_api::compress256(&mut state, &[block]);
            let state: Vec<u8> = state.iter().flat_map(|word| word.to_ne_bytes()).collect();
            self.add_text(Secret { kind: "PRK", number }, &state);
        }
    }
}

/// Returns, for each message of an envelope key, the block that masks its tag (NIST SP 800-38D, 7.1). The block
/// decrypts nothing, but with it and the key of GHASH an attacker can forge messages.
pub fn tag_masks(aead_key: &[u8; 32], nonce_prefix: [u8; 8]) -> [[u8; 16]; 10] {
    let cipher = Aes256::new(aead_key.into());
    std::array::from_fn(|index| {
        let mut block = [0; 16];
        block[..8].copy_from_slice(&nonce_prefix);
        block[8..12].copy_from_slice(&(index as u32).to_be_bytes());
        block[15] = 1;
        let mut block = block.into();
        cipher.encrypt_block(&mut block);
        block.into()
    })
}

/// The initial state of SHA-256 (FIPS 180-4, 5.3.3).
const INITIAL: [u32; 8] = [
    0x6a09_e667,
    0xbb67_ae85,
    0x3c6e_f372,
    0xa54f_f53a,
    0x510e_527f,
    0x9b05_688c,
    0x1f83_d9ab,
    0x5be0_cd19,
];

/// Prints the findings that are not `allowed`; returns their number.
pub fn unexpected(name: &str, found: &[Find], allowed: impl Fn(&Find) -> bool) -> usize {
    let wrong: Vec<&Find> = found.iter().filter(|find| !allowed(find)).collect();
    let mut kinds: BTreeMap<&str, BTreeSet<usize>> = BTreeMap::new();
    for Find { secret, .. } in &wrong {
        kinds.entry(secret.kind).or_default().insert(secret.number);
    }
    for (kind, numbers) in kinds {
        eprintln!("{name}: parts of {} of kind {kind}", numbers.len());
    }
    for find in wrong.iter().take(20) {
        let Find { secret, address, length, mapping, on_stack, .. } = find;
        let place = if *on_stack { "a thread's stack" } else { mapping };
        eprintln!("{name}: {secret:?}: {length} bytes at {address:#x} {place}");
    }
    wrong.len()
}
