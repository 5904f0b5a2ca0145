//! The status that a KME reports for the keys of a pair of SAEs.

use serde_json::Value;

/// The answer to `GET status` (clause 6.1). The numbers are as the KME gave them; some KMEs always
/// report 0.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct Status {
    /// The ID of the KME that answered.
    pub source_kme_id: String,
    /// The ID of the slave SAE's KME.
    pub target_kme_id: String,
    /// The ID of the calling SAE.
    pub master_sae_id: String,
    /// The ID of the SAE that was asked about.
    pub slave_sae_id: String,
    /// Default size of a key in bits.
    pub key_size: u32,
    /// Number of keys stored now.
    pub stored_key_count: u64,
    /// Most keys that can be stored.
    pub max_key_count: u64,
    /// Most keys that one request may ask for.
    pub max_key_per_request: u64,
    /// Largest size of a key in bits.
    pub max_key_size: u32,
    /// Smallest size of a key in bits.
    pub min_key_size: u32,
    /// Most additional slave SAEs in one request; 0 means no multicast.
    pub max_sae_id_count: u64,
    /// The vendor's `status_extension`.
    pub extension: Option<Value>,
}
