//! The key of a session. Each session makes a key pair; its id, with which its GIDs begin, is a hash of the public
//! key. The session gives the secret key to its daemon. With it the daemon proves to other hosts that the session
//! belongs to this daemon.

use std::fmt;

use ed25519_dalek::{Signer, SigningKey};
use rand::{TryRng, rngs::SysRng};
use secrecy::ExposeSecret;
use sha2::{Digest, Sha256};
use zeroize::{Zeroizing, zeroize_stack};

use crate::{ids::SessionId, secrets::LockedKey};

/// The type of the packet in which a session hands its key to its daemon, before HELLO.
pub const OWNER: u8 = 32;
/// The bytes before the key in the packet: the type, and a map of one entry, a string of 32 bytes.
const PACKET: [u8; 5] = [OWNER, 0xa1, 0x00, 0x58, 0x20];

/// Bytes of stack, more than Ed25519 takes: its scalar and nonce are left there. Without optimization, code in
/// Rust takes several times as much.
const STACK: usize = if cfg!(debug_assertions) { 128 << 10 } else { 32 << 10 };

/// The key of a session, in locked memory. It is erased when it is dropped.
pub struct SessionKey {
    seed: LockedKey,
    public: [u8; 32],
}

impl fmt::Debug for SessionKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("SessionKey").field(&self.id()).finish()
    }
}

impl SessionKey {
    /// A fresh one; `None` where the system gives no random bytes or no memory.
    pub fn generate() -> Option<Self> {
        let mut seed = Zeroizing::new([0; 32]);
        SysRng.try_fill_bytes(&mut seed[..]).ok()?;
        Self::new(&seed)
    }

    fn new(seed: &[u8; 32]) -> Option<Self> {
        let seed = LockedKey::copy_of(seed).ok()?;
        let public = public_of(&seed);
        zeroize_stack::<STACK>();
        Some(Self { seed, public })
    }

    /// The id of its session.
    pub fn id(&self) -> SessionId {
        session_id(&self.public)
    }

    /// The packet that hands it to the daemon.
    pub fn packet(&self) -> Zeroizing<Vec<u8>> {
        let seed = self.seed.expose_secret();
        let mut packet = Zeroizing::new(Vec::with_capacity(PACKET.len() + seed.len()));
        packet.extend_from_slice(&PACKET);
        packet.extend_from_slice(seed);
        packet
    }

    /// The key that a packet hands over; bytes after it do not count, as the buffer is larger.
    pub fn from_packet(packet: &[u8]) -> Option<Self> {
        Self::new(packet.strip_prefix(&PACKET)?.first_chunk::<32>()?)
    }

    /// Signs `message` (Ed25519). `None` in a forked process, which has no keys.
    pub fn sign(&self, message: &[u8]) -> Option<[u8; 64]> {
        if self.seed.is_forked() {
            return None;
        }
        let signature = sign(&self.seed, message);
        zeroize_stack::<STACK>();
        Some(signature)
    }

    /// The public key.
    pub fn public(&self) -> &[u8; 32] {
        &self.public
    }
}

/// Never inlined, so that all its data is on the stack below the caller, who erases that stack.
#[inline(never)]
fn public_of(seed: &LockedKey) -> [u8; 32] {
    SigningKey::from_bytes(seed.expose_secret()).verifying_key().to_bytes()
}

/// Signs a message; never inlined, like [`public_of`]. The library's key is made for each signature, since its memory
/// is not locked.
#[inline(never)]
fn sign(seed: &LockedKey, message: &[u8]) -> [u8; 64] {
    SigningKey::from_bytes(seed.expose_secret()).sign(message).to_bytes()
}

/// The id of the session that has this public key.
pub fn session_id(public: &[u8; 32]) -> SessionId {
    let hash = Sha256::new().chain_update(b"axon session id 1").chain_update(public).finalize();
    let mut id = [0; 16];
    id.copy_from_slice(&hash[..16]);
    SessionId(id)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_is_handed_over_whole_or_not_at_all() {
        let key = SessionKey::generate().unwrap();
        let packet = key.packet();
        assert_eq!(SessionKey::from_packet(&packet).unwrap().id(), key.id());
        for length in 0..packet.len() {
            assert!(SessionKey::from_packet(&packet[..length]).is_none());
        }
        let in_buffer = [&packet[..], &[0; 9]].concat();
        assert_eq!(SessionKey::from_packet(&in_buffer).unwrap().id(), key.id());
        assert!(!format!("{key:?}").contains(&format!("{:?}", &key.seed.expose_secret()[..4])));
    }
}
