//! A link to the daemon of another host, in the status.

use std::{
    collections::BTreeMap,
    time::{Duration, SystemTime},
};

use serde::{Deserialize, Serialize};

use super::{LimitStatus, times};

fn is_zero(count: &u64) -> bool {
    *count == 0
}

/// A link that stands by over another path, and takes over when the path of the link in use does not answer.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct StandbyStatus {
    /// The peer's address and port there.
    pub address: String,
    /// Round-trip time; microseconds in JSON.
    #[serde(rename = "rtt_us", with = "times::micros")]
    pub rtt: Duration,
    /// Copies of small samples that left over the link.
    #[serde(default)]
    pub copies_out: u64,
}

/// A link to another host's daemon.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[non_exhaustive]
pub struct LinkStatus {
    /// The peer's daemon id, in hexadecimal.
    pub peer: String,
    /// The peer's host name, as it calls itself.
    pub host: String,
    /// The peer's SAE ID in qkd.
    pub sae: Option<String>,
    /// The peer's address and port.
    pub address: String,
    /// `connected`, or the event for which the link waits.
    pub state: String,
    /// The key exchange as negotiated, read from the handshake.
    pub key_exchange: String,
    /// The cipher suite as negotiated.
    pub cipher: String,
    /// The method and the name with which the peer authenticated itself.
    pub authenticated_as: String,
    /// The peer as access rules name it; empty from a daemon of an earlier version.
    #[serde(default)]
    pub party: String,
    /// When it was established; milliseconds since the Unix epoch in JSON, or 0.
    #[serde(rename = "since_unix_ms", with = "times::optional_unix_millis")]
    pub since: Option<SystemTime>,
    /// Round-trip time; microseconds in JSON.
    #[serde(rename = "rtt_us", with = "times::micros")]
    pub rtt: Duration,
    /// Shortest round-trip time so far; microseconds in JSON.
    #[serde(default, rename = "rtt_min_us", with = "times::micros")]
    pub rtt_min: Duration,
    /// Congestion window in bytes.
    #[serde(default)]
    pub congestion_window: u64,
    /// Packets sent.
    #[serde(default)]
    pub packets_sent: u64,
    /// Packets that were lost.
    #[serde(default)]
    pub packets_lost: u64,
    /// Bytes of these packets. QUIC retransmits the parts that are still needed, and has no counter of them.
    #[serde(default)]
    pub bytes_lost: u64,
    /// Datagrams that arrived with an ECN mark: a router on the way here is congested.
    #[serde(default)]
    pub ecn_marks_in: u64,
    /// Times that the peer reported new ECN marks on packets of this host, since the peer's address changed last.
    #[serde(default)]
    pub ecn_marks_out: u64,
    /// Times that the congestion controller took packets for lost, or marked.
    #[serde(default)]
    pub congestion_events: u64,
    /// Largest UDP payload, in bytes.
    #[serde(default)]
    pub mtu: u64,
    /// Times that the path let packets of this size no longer pass, and the link went back to shorter ones.
    #[serde(default)]
    pub mtu_black_holes: u64,
    /// Bytes of samples that wait for the link.
    #[serde(default)]
    pub waiting_bytes: u64,
    /// The waiting bytes by class, and those of control messages.
    #[serde(default)]
    pub waiting: WaitingStatus,
    /// Waiting time of the oldest waiting sample; milliseconds in JSON.
    #[serde(default, rename = "waiting_ms", with = "times::millis")]
    pub oldest_waits: Duration,
    /// The second link to the peer, which stands by over another path.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub standby: Option<StandbyStatus>,
    /// Samples received.
    pub samples_in: u64,
    /// Number of received samples whose copy over the second path came first.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub copies_in: u64,
    /// Samples sent.
    pub samples_out: u64,
    /// Bytes received.
    pub bytes_in: u64,
    /// Bytes sent.
    pub bytes_out: u64,
    /// Samples that were compressed for the link.
    #[serde(default)]
    pub compressed: CompressedStatus,
    /// Samples dropped, by cause.
    pub dropped: BTreeMap<String, u64>,
    /// Topics and services that do not cross though they match, and why: the first 64.
    #[serde(default)]
    pub routes_refused: BTreeMap<String, String>,
    /// Number of further routes that are not listed.
    #[serde(default)]
    pub more_routes_refused: usize,
    /// Uses that access rules deny, here to the peer and there to this host: the first 64.
    #[serde(default)]
    pub denied: BTreeMap<String, String>,
    /// Number of further denials that are not listed.
    #[serde(default)]
    pub more_denied: usize,
    /// The limits in force between this host and the peer's identity: the first 64, in the order of their dropped
    /// samples, most first.
    #[serde(default)]
    pub limits: Vec<LimitStatus>,
    /// Number of further limits that are not listed.
    #[serde(default)]
    pub more_limits: usize,
    /// Endpoints and nodes of the peer that are known here.
    #[serde(default)]
    pub endpoints: u64,
    /// Number of endpoints that the peer announces and this host leaves out; a refusal names the first.
    #[serde(default)]
    pub endpoints_left_out: u64,
    /// Bytes that count for the graph of the peer's identity, over all of its daemon ids.
    #[serde(default)]
    pub graph_bytes: u64,
    /// Memory that the samples and calls of the peer's identity take that are kept here for readers and servers, over all of
    /// its daemon ids.
    #[serde(default)]
    pub held_bytes: u64,
    /// The most that they may take (`[link] held_mb` here).
    #[serde(default)]
    pub held_limit: u64,
}

/// Samples that were compressed for a link, and that the link then carried or is to carry.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct CompressedStatus {
    /// Number of samples.
    pub samples: u64,
    /// Their bytes, which [`bytes_out`](LinkStatus::bytes_out) counts.
    pub bytes: u64,
    /// Bytes of the frames that the link carries in their place.
    pub bytes_sent: u64,
}

/// Bytes that wait in the daemon until QUIC takes them, by class. A class goes before the classes below it. Each lower
/// class that waits still gets about an eighth of the rate. A flow counts as a whole for the class of its next sample.
/// BEST_EFFORT and KEEP_ALL samples wait in their publisher's ring: samples that the daemon has not taken from there do
/// not count.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct WaitingStatus {
    /// Control messages.
    pub control: u64,
    /// Requests and responses of services and actions.
    pub services: u64,
    /// RELIABLE samples of at most 4 KiB.
    pub small_reliable: u64,
    /// BEST_EFFORT samples of at most 4 KiB.
    pub small_best_effort: u64,
    /// Longer samples.
    pub bulk: u64,
}
