//! What a KME says of the keys it holds for a pair of SAEs.

use serde_json::Value;

/// Answer of `GET status` (clause 6.1). Numbers are as the KME gave them: some always say 0.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct Status {
    /// KME that was asked.
    pub source_kme_id: String,
    /// KME of the slave SAE.
    pub target_kme_id: String,
    /// The calling SAE.
    pub master_sae_id: String,
    /// The SAE that was asked about.
    pub slave_sae_id: String,
    /// Default size of a key, bits.
    pub key_size: u32,
    /// Keys stored now.
    pub stored_key_count: u64,
    /// Keys that can be stored.
    pub max_key_count: u64,
    /// Most keys that one request may ask for.
    pub max_key_per_request: u64,
    /// Largest size of a key, bits.
    pub max_key_size: u32,
    /// Smallest size of a key, bits.
    pub min_key_size: u32,
    /// Most additional slave SAEs in one request; 0: no multicast.
    pub max_sae_id_count: u64,
    /// Vendor's `status_extension`.
    pub extension: Option<Value>,
}
