//! Who the client is. The binder proves that it holds the PSK, but a KME may answer `dec_keys` to
//! the slave without proof of who the master was; so the server fetches a key for the SAE the
//! client claims to be, and has it prove that it got that one (docs/formats.md, section 2).

mod client_proof;
mod proof_responder;
#[cfg(test)]
mod tests;

pub use client_proof::{ClientProof, ProofFailure, ProofState};
pub use proof_responder::ProofResponder;
