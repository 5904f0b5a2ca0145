//! Limits in the status of a link.

use serde::{Deserialize, Serialize};

/// A limit that this host sets on the traffic with a peer, and its effect. It counts for all links of the peer's
/// identity.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct LimitStatus {
    /// The limited action of the peer: `publish`, `subscribe` or `call`. For a limit on all packets to the peer, or by
    /// the network interface that the link uses: `egress`.
    pub verb: String,
    /// The topic or service. Several topics or services that share the limit appear as `(/a, /b together)`, or as
    /// `(all topics)`. For `egress` this is `(all packets)`, or `(all packets by wlan0)`.
    pub name: String,
    /// The limit.
    pub limit: String,
    /// The place of the rule in its file.
    pub place: String,
    /// Samples, requests or packets that passed.
    pub passed: u64,
    /// Number of dropped samples, requests or responses.
    pub dropped: u64,
}
