//! Proves which SAE the client of a connection is. The binder proves only that the client holds the PSK: a KME may
//! answer `dec_keys` without checking the identity of the master. So the server fetches a key for the SAE that the
//! client claims to be, and the client proves that it received that key (docs/formats.md, section 2).

mod client_proof;
mod proof_responder;
#[cfg(test)]
mod tests;

pub use client_proof::{ClientProof, ProofFailure, ProofState};
pub use proof_responder::ProofResponder;
