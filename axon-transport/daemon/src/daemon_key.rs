//! The key of a daemon. The daemon's id is a hash of its public key. Beacons contain the id in clear; in HELLO the
//! daemon proves, for the one connection, that the id is its own. A host that claims the id of another daemon cannot
//! prove it.

use axon_shm::ids::DaemonId;
use axon_transport::internal::SessionKey;
use ed25519_dalek::{Signature, VerifyingKey};
use minicbor::{Decode, Encode};
use sha2::{Digest, Sha256};

use crate::owner::ChannelBinding;

const ID: &[u8] = b"axon daemon id 1";
const SIGNED: &[u8] = b"axon daemon proof 1";

/// The key of a daemon, new at each start.
#[derive(Debug)]
pub struct DaemonKey(SessionKey);

impl DaemonKey {
    /// Generates a key; `None` where the system gives no random bytes or no memory.
    pub fn generate() -> Option<Self> {
        SessionKey::generate().map(Self)
    }

    /// Returns the id of the key's daemon.
    pub fn id(&self) -> DaemonId {
        id_of(self.0.public())
    }

    /// Proves the id on the connection that `binding` is of. `None` in a forked process, which has no keys.
    pub fn prove(&self, binding: &ChannelBinding) -> Option<DaemonProof> {
        let signature = self.0.sign(&signed(binding, self.id()))?;
        Some(DaemonProof { key: *self.0.public(), signature })
    }
}

#[cfg(test)]
impl From<SessionKey> for DaemonKey {
    fn from(key: SessionKey) -> Self {
        Self(key)
    }
}

/// Returns the id of the daemon that has this public key.
fn id_of(public: &[u8; 32]) -> DaemonId {
    let hash = Sha256::new().chain_update(ID).chain_update(public).finalize();
    let mut id = [0; 16];
    id.copy_from_slice(&hash[..16]);
    DaemonId(id)
}

fn signed(binding: &ChannelBinding, id: DaemonId) -> Vec<u8> {
    [SIGNED, binding, &id.0].concat()
}

/// A daemon's proof, for one connection, that its id is its own.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct DaemonProof {
    /// The daemon's public key (Ed25519).
    #[cbor(n(0), with = "minicbor::bytes")]
    pub key: [u8; 32],
    /// The signature over `axon daemon proof 1`, the binding and the daemon's id.
    #[cbor(n(1), with = "minicbor::bytes")]
    pub signature: [u8; 64],
}

impl DaemonProof {
    /// Returns whether the proof shows this id on the connection of `binding`.
    pub fn proves(&self, id: DaemonId, binding: &ChannelBinding) -> bool {
        let signature = Signature::from_bytes(&self.signature);
        id_of(&self.key) == id
            && VerifyingKey::from_bytes(&self.key)
                .is_ok_and(|key| key.verify_strict(&signed(binding, id), &signature).is_ok())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_proof_is_of_one_daemon_and_one_connection() {
        let [key, other] = [(); 2].map(|()| DaemonKey::generate().unwrap());
        let (id, binding) = (key.id(), [7; 32]);
        let proof = key.prove(&binding).unwrap();
        assert!(proof.proves(id, &binding));
        assert!(!proof.proves(id, &[8; 32]), "said on another connection");
        assert!(!proof.proves(other.id(), &binding), "for another daemon");
        let stolen = DaemonProof { key: *other.0.public(), ..proof.clone() };
        assert!(!stolen.proves(id, &binding) && !stolen.proves(other.id(), &binding));
        let mut torn = proof;
        torn.signature[3] ^= 1;
        assert!(!torn.proves(id, &binding));
    }

    #[test]
    fn a_proof_of_a_session_is_none_of_a_daemon() {
        let session = SessionKey::generate().unwrap();
        let daemon = id_of(session.public());
        let of_session = crate::owner::prove(&session, &[7; 32], daemon).unwrap();
        let posed = DaemonProof { key: of_session.key, signature: of_session.signature };
        assert!(!posed.proves(daemon, &[7; 32]));
    }
}
