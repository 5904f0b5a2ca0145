//! Proofs that a session belongs to a daemon. The id of a session, with which its GIDs begin, is a hash of its public
//! key. The daemon that has the secret key proves it to each peer, for the one connection between them. A host that saw
//! a GID of another host cannot announce that GID as its own.

use std::{
    collections::HashMap,
    sync::{Arc, Mutex, PoisonError},
};

use axon_shm::ids::{DaemonId, Gid, SessionId};
use axon_transport::internal::{SessionKey, session_id};
use ed25519_dalek::{Signature, VerifyingKey};
use minicbor::{Decode, Encode};

const SIGNED: &[u8] = b"axon session owner 1";
/// The label of the TLS exporter of [`ChannelBinding`].
pub const EXPORTER: &[u8] = b"EXPORTER-axon-session-owner";

/// 32 bytes that both ends of one connection know and no other connection has.
pub type ChannelBinding = [u8; 32];
/// The first bytes of the GIDs of one session.
pub type SessionPrefix = [u8; 12];

/// Proves, on the connection that `binding` is of, that the daemon `from` has the session of `key`. `None` in a
/// forked process, which has no keys.
pub fn prove(key: &SessionKey, binding: &ChannelBinding, from: DaemonId) -> Option<Proof> {
    let signature = key.sign(&signed(binding, from, &key.id()))?;
    Some(Proof { key: *key.public(), signature })
}

fn signed(binding: &ChannelBinding, from: DaemonId, id: &SessionId) -> Vec<u8> {
    [SIGNED, binding, &from.0, &id.0].concat()
}

/// Returns the first bytes of a session's GIDs.
pub fn prefix(id: &SessionId) -> SessionPrefix {
    prefix_of(&Gid(id.0))
}

/// Returns the first bytes of a GID, which its session determines.
pub fn prefix_of(gid: &Gid) -> SessionPrefix {
    let mut prefix = [0; 12];
    prefix.copy_from_slice(&gid.0[..12]);
    prefix
}

/// A daemon's proof, for one connection, that a session is its own.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct Proof {
    /// The session's public key (Ed25519).
    #[cbor(n(0), with = "minicbor::bytes")]
    pub key: [u8; 32],
    /// The signature over `axon session owner 1`, the binding, the daemon's id and the session's id.
    #[cbor(n(1), with = "minicbor::bytes")]
    pub signature: [u8; 64],
}

impl Proof {
    /// Returns the session of the proof, without a check.
    pub fn claims(&self) -> SessionId {
        session_id(&self.key)
    }

    /// Returns the session that the daemon `from` proves to have on the connection of `binding`; `None` if the
    /// signature is wrong.
    pub fn session(&self, binding: &ChannelBinding, from: DaemonId) -> Option<SessionId> {
        let id = self.claims();
        let key = VerifyingKey::from_bytes(&self.key).ok()?;
        let signature = Signature::from_bytes(&self.signature);
        key.verify_strict(&signed(binding, from, &id), &signature).ok().map(|()| id)
    }
}

/// The keys of the sessions of a daemon: the control plane puts them there, the gateway proves with
/// them.
#[derive(Debug, Default)]
pub struct SessionKeys(Mutex<HashMap<SessionPrefix, Arc<SessionKey>>>);

impl SessionKeys {
    pub(crate) fn insert(&self, key: Arc<SessionKey>) {
        self.lock().insert(prefix(&key.id()), key);
    }

    pub(crate) fn remove(&self, id: &SessionId) {
        self.lock().remove(&prefix(id));
    }

    pub(crate) fn get(&self, prefix: &SessionPrefix) -> Option<Arc<SessionKey>> {
        self.lock().get(prefix).cloned()
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, HashMap<SessionPrefix, Arc<SessionKey>>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use std::hint::black_box;

    use sha2::{Digest, Sha512};

    use super::*;
    use crate::residue::left_on_the_stack;

    /// The order of the group (RFC 8032, 5.1), least significant word first.
    const ORDER: [u64; 4] =
        [0x5812_631a_5cf5_d3ed, 0x14de_f9de_a2f7_9cd6, 0, 0x1000_0000_0000_0000];

    /// Returns a number modulo the group's order, least significant byte first.
    fn reduced(number: &[u8]) -> Vec<u8> {
        let mut rest = [0_u64; 4];
        for bit in (0..number.len() * 8).rev() {
            let mut carry = u64::from(number[bit / 8] >> (bit % 8) & 1);
            for word in &mut rest {
                (*word, carry) = (*word << 1 | carry, *word >> 63);
            }
            if rest.iter().rev().ge(ORDER.iter().rev()) {
                let mut borrow = false;
                for (word, order) in rest.iter_mut().zip(ORDER) {
                    let (less, under) = word.overflowing_sub(order);
                    let (less, again) = less.overflowing_sub(u64::from(borrow));
                    (*word, borrow) = (less, under || again);
                }
            }
        }
        rest.iter().flat_map(|word| word.to_le_bytes()).collect()
    }

    /// Returns the secrets of a signature (RFC 8032, 5.1.6): the seed, its hash, the scalar, and the nonce for
    /// `message`.
    fn secrets(seed: &[u8; 32], message: &[u8]) -> Vec<Vec<u8>> {
        let hash = Sha512::digest(seed);
        let mut scalar = hash[..32].to_vec();
        scalar[0] &= 248;
        scalar[31] = scalar[31] & 63 | 64;
        let nonce = Sha512::new().chain_update(&hash[32..]).chain_update(message).finalize();
        let reduced = [reduced(&scalar), reduced(&nonce)];
        [seed.to_vec(), hash.to_vec(), scalar, nonce.to_vec()].into_iter().chain(reduced).collect()
    }

    #[test]
    fn neither_a_new_key_nor_a_signature_leaves_a_secret_on_the_stack() {
        let binding = [7; 32];
        let from = DaemonId([1; 16]);
        let secrets_of = |key: &SessionKey| {
            // The seed is the end of the packet.
            let packet = key.packet();
            secrets(packet.last_chunk().unwrap(), &signed(&binding, from, &key.id()))
        };
        let generate = || SessionKey::generate().unwrap();
        assert_eq!(left_on_the_stack(generate, secrets_of), [0_usize; 0], "a new key");
        let key = SessionKey::generate().unwrap();
        let packet = key.packet();
        let take_over = || SessionKey::from_packet(black_box(&packet)).unwrap();
        assert_eq!(left_on_the_stack(take_over, secrets_of), [0_usize; 0], "a key taken over");
        let prove = || prove(&key, &binding, from).unwrap();
        assert_eq!(left_on_the_stack(prove, |_| secrets_of(&key)), [0_usize; 0], "a proof");
    }

    #[test]
    fn a_proof_is_of_one_session_one_daemon_and_one_connection() {
        let (key, other) = (SessionKey::generate().unwrap(), SessionKey::generate().unwrap());
        let [one, two] = [1, 2].map(|byte| DaemonId([byte; 16]));
        let proof = prove(&key, &[7; 32], one).unwrap();
        assert_eq!(proof.session(&[7; 32], one), Some(key.id()));
        assert_eq!(proof.session(&[8; 32], one), None, "said on another connection");
        assert_eq!(proof.session(&[7; 32], two), None, "said by another daemon");
        let stolen = Proof { key: *other.public(), ..proof.clone() };
        assert_eq!(stolen.session(&[7; 32], one), None, "for another session");
        let mut torn = proof;
        torn.signature[3] ^= 1;
        assert_eq!(torn.session(&[7; 32], one), None);
        assert_ne!(prefix(&key.id()), prefix(&other.id()));
    }

    #[test]
    fn a_daemon_has_the_keys_of_its_sessions_until_they_end() {
        let key = SessionKey::generate().unwrap();
        let id = key.id();
        let keys = SessionKeys::default();
        keys.insert(Arc::new(key));
        assert!(keys.get(&prefix(&id)).is_some());
        keys.remove(&id);
        assert!(keys.get(&prefix(&id)).is_none());
    }
}
