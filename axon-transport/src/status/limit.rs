//! Limits in the status of a link.

use serde::{Deserialize, Serialize};

/// A limit that this host sets on what crosses between it and a peer, and what it did. It counts for all links of the
/// peer's identity.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct LimitStatus {
    /// What the peer does that is limited: `publish`, `subscribe` or `call`; or `egress`, all packets to it, or by the
    /// network interface that the link uses.
    pub verb: String,
    /// The topic or service, or those that have the limit together, as `(/a, /b together)` or `(all topics)`; or
    /// `(all packets)`, or `(all packets by wlan0)`.
    pub name: String,
    /// The limit.
    pub limit: String,
    /// Where it is written.
    pub place: String,
    /// Samples, requests or packets that passed.
    pub passed: u64,
    /// Those that were dropped.
    pub dropped: u64,
}
