//! The daemon's status: the JSON for `axon status`.
//!
//! The daemon alone fills these structures. A test that needs one starts from its default.

mod limit;
mod link;
mod times;

use std::{
    collections::BTreeMap,
    time::{Duration, SystemTime},
};

use serde::{Deserialize, Serialize};

pub use self::{
    limit::LimitStatus,
    link::{CompressedStatus, LinkStatus, WaitingStatus},
};

/// The whole status.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[non_exhaustive]
pub struct Status {
    /// The daemon's id, in hexadecimal; new at each start.
    pub daemon: String,
    /// The id of the daemon's process.
    pub pid: u32,
    /// The time since its start; whole seconds in JSON.
    #[serde(rename = "uptime_s", with = "times::seconds")]
    pub uptime: Duration,
    /// The session protocol's version.
    pub protocol: u32,
    /// This crate's version.
    pub version: String,
    /// `ROS_DOMAIN_ID`.
    pub domain: u32,
    /// True if the rest is left out, except the state of the gateway: the daemon has access rules, and the requesting
    /// process belongs to another user of its host. False from a daemon of an earlier version.
    #[serde(default)]
    pub withheld: bool,
    /// The effective security settings with which sessions are compared: `AXON_` name and value or digest.
    pub settings: BTreeMap<String, String>,
    /// The [digest](crate::access::AccessRules::digest) of the access rules in force. Absent if there are none, and
    /// from a daemon of an earlier version.
    #[serde(default)]
    pub access_digest: Option<String>,
    /// `classic` or `qkd`.
    pub mode: String,
    /// `session` or `messages10` in qkd.
    pub key_mode: Option<String>,
    /// `psk_ke` or `psk_dhe_ke` in qkd.
    pub kex: Option<String>,
    /// The one cipher.
    pub cipher: String,
    /// This host's SAE ID in qkd.
    pub sae: Option<String>,
    /// The address at which sessions find the daemon.
    pub socket: String,
    /// The directory of its files; if absent, nothing is kept.
    pub runtime_dir: Option<String>,
    /// The gateway's UDP port; absent while the gateway is not running.
    pub port: Option<u16>,
    /// `running`, `starting`, or the reason why the gateway does not run.
    pub gateway: String,
    /// The present state of discovery, which follows the needs of the sessions.
    #[serde(default)]
    pub discovery: DiscoveryStatus,
    /// Packets exchanged with sessions since the daemon's start.
    #[serde(default)]
    pub traffic: TrafficStatus,
    /// The daemon's file descriptors; absent from a daemon of an earlier version.
    #[serde(default)]
    pub descriptors: Option<DescriptorStatus>,
    /// Sessions on this host.
    pub sessions: Vec<SessionStatus>,
    /// Topics with an endpoint on any host.
    pub topics: Vec<TopicStatus>,
    /// Links to other hosts' daemons.
    pub links: Vec<LinkStatus>,
    /// The key supply, as the gateway describes it.
    pub keys: serde_json::Value,
    /// The last refusals, oldest first.
    pub refusals: Vec<RefusalStatus>,
}

/// The present state of discovery.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct DiscoveryStatus {
    /// The widest range of any session; `SUBNET` alone uses multicast.
    pub range: String,
    /// Hosts that discovery looks for by address or name.
    pub hosts: Vec<String>,
}

/// Control packets, which carry no samples.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct TrafficStatus {
    /// Number of packets from sessions.
    pub packets_in: u64,
    /// Number of packets to sessions.
    pub packets_out: u64,
    /// Number of bytes to sessions.
    pub bytes_out: u64,
}

/// The daemon's file descriptors, of which each session takes some.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct DescriptorStatus {
    /// Number of open descriptors.
    pub open: u64,
    /// Maximum number of descriptors (RLIMIT_NOFILE); absent if there is no limit.
    pub limit: Option<u64>,
    /// Number of sessions refused for want of descriptors since the daemon's start; each attempt counts.
    pub sessions_refused: u64,
}

/// A session.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[non_exhaustive]
pub struct SessionStatus {
    /// The id of the session's process.
    pub pid: u32,
    /// Its name.
    pub name: String,
    /// `application` or `gateway`.
    pub role: String,
    /// Its user, if that is not the daemon's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub user: Option<u32>,
    /// The common beginning of its endpoints' GIDs, in hexadecimal.
    #[serde(default)]
    pub gids: String,
    /// Number of its endpoints.
    pub endpoints: usize,
    /// Number of control packets that wait for it.
    pub queued: usize,
    /// Its discovery range: `SUBNET`, `LOCALHOST` or `OFF`; absent for the gateway.
    #[serde(default)]
    pub range: Option<String>,
    /// True if it stated that range; a session that did not is limited to `LOCALHOST`.
    #[serde(default)]
    pub range_stated: bool,
    /// Its static peers.
    #[serde(default)]
    pub static_peers: Vec<String>,
    /// The daemon ids of the linked peers among its static peers.
    #[serde(default)]
    pub lists: Vec<String>,
    /// Present if it shares no memory: its samples pass through the daemon.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub relay: Option<RelayStatus>,
}

/// The traffic through the daemon of a session that shares no memory.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct RelayStatus {
    /// The reason why memory is not shared.
    pub reason: String,
    /// Number of samples from the session.
    pub samples_in: u64,
    /// Their bytes.
    pub bytes_in: u64,
    /// Number of samples to the session.
    pub samples_out: u64,
    /// Their bytes.
    pub bytes_out: u64,
    /// Number of samples of its publishers that were overwritten before they had crossed, or for which there was no
    /// memory, and of samples that writers outside the session left when they ended and that it did not take.
    pub lost: u64,
}

/// A topic.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[non_exhaustive]
pub struct TopicStatus {
    /// Its name.
    pub topic: String,
    /// Its type.
    pub type_name: String,
    /// Publishers on this host.
    pub publishers: usize,
    /// Subscriptions on this host.
    pub subscriptions: usize,
    /// Publishers on other hosts.
    pub remote_publishers: usize,
    /// Subscriptions on other hosts.
    pub remote_subscriptions: usize,
    /// Samples that publishers of this host wrote.
    pub published: u64,
    /// Samples that came from other hosts.
    pub arrived: u64,
    /// Bytes of memory that its publishers on this host, stand-ins for remote ones among them, have
    /// committed.
    pub bytes_committed: u64,
    /// Samples that were not delivered on this host, by why: `overwritten` before a reader took
    /// them within its depth; `blocked`, `no_memory`, `pinned` as for [`WriterStatus`]. And samples of
    /// publishers here that another host did not acknowledge: `link_ended` when its link did (so are
    /// requests and responses that were not sent), `publisher_ended` ten seconds without progress after
    /// their publisher did, `stalled` when its readers took nothing. `publisher_ended` also counts what a
    /// process that shares no memory left when it ended and no reader took for a second, and `ring` what
    /// the daemon could not write for such a process. On the way to other hosts: `queue`
    /// while more waited than the history's depth, `late` for what could not arrive in time, `no_key` while there
    /// was none, `no_link`, `no_route` when the other host did not want them any more. On arrival: `ring`, `no_link`,
    /// `no_route`, `no_client`, `held` where the other host's samples take as much memory here as they may.
    pub dropped: BTreeMap<String, u64>,
    /// The publishers on this host, stand-ins for remote ones among them: up to 64, those with the
    /// most memory first.
    pub writers: Vec<WriterStatus>,
    /// Number of further ones.
    pub more_writers: usize,
    /// What each reader on this host took and lost, relays to other hosts among them: up to 64,
    /// those that wait longest and lost most first.
    pub readers: Vec<ReaderStatus>,
    /// Number of further ones.
    pub more_readers: usize,
    /// Pairs that are not matched since one session is out of the other's discovery range. Of
    /// endpoints on other hosts it has those that their daemons showed to this one.
    #[serde(default)]
    pub out_of_range: Vec<OutOfRangeStatus>,
    /// Endpoints on this host that match endpoints on another host and exchange no samples with them because a route is
    /// refused, and endpoints that this daemon refuses. Up to 64 in all.
    #[serde(default)]
    pub refused: Vec<RefusedRouteStatus>,
}

/// An endpoint that waits for a route which one of two hosts refuses, or that is refused itself.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct RefusedRouteStatus {
    /// Its GID.
    pub endpoint: String,
    /// The other host, as it calls itself; empty if this daemon refuses the endpoint.
    pub host: String,
    /// The host that refuses it, and the reason.
    pub reason: String,
}

/// A pair that the discovery ranges of its sessions keep apart.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct OutOfRangeStatus {
    /// The GID of the publisher, or of the endpoint of a service.
    pub writer: String,
    /// The GID of the subscription, or of the endpoint of a service.
    pub reader: String,
    /// The reason.
    pub reason: String,
}

/// A publisher's ring.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[non_exhaustive]
pub struct WriterStatus {
    /// The publisher's process.
    pub pid: u32,
    /// The publisher's GID.
    pub writer: String,
    /// True if it is the stand-in for a publisher on another host.
    pub stand_in: bool,
    /// Its history's depth; `null` for KEEP_ALL.
    pub depth: Option<u32>,
    /// Minimum number of samples that it keeps, for its own depth and those of its readers.
    pub window: u64,
    /// Bytes of memory that it has committed: descriptors, small samples, segments of large ones.
    pub bytes_committed: u64,
    /// Samples published.
    pub published: u64,
    /// Number of publishes that failed because a KEEP_ALL reader freed no space for as long as they could wait.
    pub blocked: u64,
    /// Number of publishes that failed for want of memory or descriptors, and of samples that were dropped for that
    /// reason although they should have been kept: for late joiners, or within the depth of a reader.
    pub no_memory: u64,
    /// Number of publishes that failed because readers or loans hold all of its memory.
    pub pinned: u64,
}

/// A reader's share of one writer's samples.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[non_exhaustive]
pub struct ReaderStatus {
    /// The reader's process.
    pub pid: u32,
    /// The reader's GID.
    pub reader: String,
    /// The writer's GID.
    pub writer: String,
    /// True if it carries samples to other hosts.
    pub relay: bool,
    /// Its history's depth; `null` for KEEP_ALL.
    pub depth: Option<u32>,
    /// Number of samples that it can take, at most its depth.
    pub unread: u64,
    /// Samples taken.
    pub received: u64,
    /// Samples overwritten before they were taken, within its depth.
    pub lost: u64,
    /// Number of samples skipped because more recent ones filled its depth: no loss.
    pub skipped: u64,
    /// The time since the publication of the oldest sample that it has not taken, by the clocks of both hosts if the
    /// publisher is on another one. Milliseconds in JSON; `null` if it has taken all.
    #[serde(default, rename = "waiting_ms", with = "times::optional_millis")]
    pub waiting: Option<Duration>,
    /// True if its process is stopped, by a signal or a debugger.
    pub stopped: bool,
}

impl ReaderStatus {
    /// Returns whether it has not taken a sample that has been available for a second.
    pub fn is_stalled(&self) -> bool {
        self.waiting.is_some_and(|waiting| waiting >= Duration::from_secs(1))
    }
}

/// A refusal of a peer, session or endpoint.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[non_exhaustive]
pub struct RefusalStatus {
    /// The time of the refusal; milliseconds since the Unix epoch in JSON.
    #[serde(rename = "unix_ms", with = "times::unix_millis")]
    pub at: SystemTime,
    /// The refused peer or session.
    pub peer: String,
    /// The subject of the refusal, or the variable that differs.
    pub what: String,
    /// The reason.
    pub reason: String,
}

impl RefusalStatus {
    /// Creates the refusal of `peer` at this time.
    pub fn new(at: SystemTime, peer: String, what: String, reason: String) -> Self {
        Self { at, peer, what, reason }
    }
}

/// The result of reading a daemon's settings again.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct ReloadReport {
    /// Settings that now have another value.
    pub changed: Vec<String>,
    /// Settings that differ from those in force and take effect only when the daemon is started again.
    pub needs_restart: Vec<String>,
    /// The error in the settings. If there is one, nothing was changed.
    pub error: Option<String>,
}

/// The decisions of a linked peer's access rules about this host.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct PeerDecisions {
    /// One decision for each use that was asked about, in that order.
    pub decisions: Vec<PeerDecision>,
    /// The reason why there are none.
    pub error: Option<String>,
}

/// The decision of a peer's access rules about one use.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct PeerDecision {
    /// True if the peer allows it.
    pub allowed: bool,
    /// The rule that decides, in the peer's words, without control characters.
    pub reason: String,
}

impl PeerDecision {
    /// Creates a peer's decision.
    pub fn new(allowed: bool, reason: String) -> Self {
        Self { allowed, reason }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The names, order and units of what `axon status --json` prints are read by programs.
    #[test]
    fn the_json_of_a_status_is_as_programs_know_it() {
        let reader = concat!(
            r#"{"pid":41,"reader":"aa","writer":"bb","relay":false,"depth":10,"unread":3,"received":4,"lost":5,"#,
            r#""skipped":6,"waiting_ms":1234,"stopped":true}"#
        );
        let read: ReaderStatus = serde_json::from_str(reader).unwrap();
        assert_eq!(read.waiting, Some(Duration::from_millis(1234)));
        assert!(read.is_stalled());
        assert_eq!(serde_json::to_string(&read).unwrap(), reader);

        let link = concat!(
            r#"{"peer":"cc","host":"robot-2","sae":null,"address":"192.0.2.1:61348","state":"connected","#,
            r#""key_exchange":"X25519MLKEM768","cipher":"c","authenticated_as":"UNAUTHENTICATED","party":"","#,
            r#""since_unix_ms":1700000000123,"rtt_us":1500,"rtt_min_us":740,"congestion_window":1,"#,
            r#""packets_sent":2,"packets_lost":3,"bytes_lost":4,"ecn_marks_in":5,"ecn_marks_out":6,"#,
            r#""congestion_events":7,"mtu":1452,"mtu_black_holes":8,"waiting_bytes":9,"#,
            r#""waiting":{"control":1,"services":2,"small_reliable":3,"small_best_effort":4,"bulk":5},"#,
            r#""waiting_ms":88,"samples_in":10,"samples_out":11,"bytes_in":12,"bytes_out":13,"#,
            r#""compressed":{"samples":19,"bytes":20,"bytes_sent":21},"#,
            r#""dropped":{"no_key":1},"routes_refused":{},"more_routes_refused":0,"denied":{},"more_denied":0,"limits":[],"more_limits":0,"endpoints":14,"#,
            r#""endpoints_left_out":15,"graph_bytes":16,"held_bytes":17,"held_limit":18}"#
        );
        let read: LinkStatus = serde_json::from_str(link).unwrap();
        let since = SystemTime::UNIX_EPOCH + Duration::from_millis(1_700_000_000_123);
        assert_eq!((read.since, read.rtt_min), (Some(since), Duration::from_micros(740)));
        assert_eq!(read.oldest_waits, Duration::from_millis(88));
        assert_eq!(serde_json::to_string(&read).unwrap(), link);

        let refusal = r#"{"unix_ms":18446744073709551615,"peer":"p","what":"w","reason":"r"}"#;
        let read: RefusalStatus = serde_json::from_str(refusal).unwrap();
        assert_eq!(serde_json::to_string(&read).unwrap(), refusal);
    }

    #[test]
    fn times_are_whole_numbers_of_their_unit() {
        let status = Status { uptime: Duration::from_millis(90_999), ..Status::default() };
        let json = serde_json::to_value(&status).unwrap();
        assert_eq!(json["uptime_s"], 90);
        let mut link = LinkStatus::default();
        assert_eq!(serde_json::to_value(&link).unwrap()["since_unix_ms"], 0);
        link.rtt = Duration::from_nanos(1_999);
        link.oldest_waits = Duration::MAX;
        let json = serde_json::to_value(&link).unwrap();
        assert_eq!((&json["rtt_us"], &json["waiting_ms"]), (&1.into(), &u64::MAX.into()));
    }

    /// An earlier daemon says nothing of what it does not know.
    #[test]
    fn missing_status_fields_have_their_default() {
        let reader = r#"{"pid":41,"reader":"aa","writer":"bb","relay":false,"depth":null,"unread":0,
            "received":0,"lost":0,"skipped":0,"stopped":false}"#;
        let read: ReaderStatus = serde_json::from_str(reader).unwrap();
        assert_eq!(read.waiting, None);
    }
}
