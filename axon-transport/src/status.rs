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
    link::{CompressedStatus, LinkStatus, StandbyStatus, WaitingStatus},
};

/// The whole status of a daemon.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[non_exhaustive]
pub struct Status {
    /// The daemon's id, in hexadecimal; new at each start.
    pub daemon: String,
    /// The id of the daemon's process.
    pub pid: u32,
    /// The time since the daemon's start; whole seconds in JSON.
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
    /// The only cipher that is offered.
    pub cipher: String,
    /// This host's SAE ID in qkd.
    pub sae: Option<String>,
    /// The address at which sessions find the daemon.
    pub socket: String,
    /// The directory of the daemon's files. If absent, the daemon keeps no files.
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
    /// The session's name.
    pub name: String,
    /// `application` or `gateway`.
    pub role: String,
    /// The session's user, if that is not the daemon's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub user: Option<u32>,
    /// The common beginning of the GIDs of the session's endpoints, in hexadecimal.
    #[serde(default)]
    pub gids: String,
    /// Number of the session's endpoints.
    pub endpoints: usize,
    /// Number of control packets that wait for the session.
    pub queued: usize,
    /// The session's discovery range: `SUBNET`, `LOCALHOST` or `OFF`; absent for the gateway.
    #[serde(default)]
    pub range: Option<String>,
    /// True if the session stated that range. A session that did not is limited to `LOCALHOST`.
    #[serde(default)]
    pub range_stated: bool,
    /// The session's static peers.
    #[serde(default)]
    pub static_peers: Vec<String>,
    /// The daemon ids of the linked peers among the session's static peers.
    #[serde(default)]
    pub lists: Vec<String>,
    /// Present if the session shares no memory. The daemon then relays its samples.
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
    /// Number of bytes of these samples from the session.
    pub bytes_in: u64,
    /// Number of samples to the session.
    pub samples_out: u64,
    /// Number of bytes of these samples to the session.
    pub bytes_out: u64,
    /// Number of lost samples. A sample of the session's publishers is lost if it is overwritten before it crosses,
    /// or if there is no memory for it. A sample of a writer outside the session is lost if the writer ended and the
    /// session did not take it.
    pub lost: u64,
}

/// A topic.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[non_exhaustive]
pub struct TopicStatus {
    /// The topic's name.
    pub topic: String,
    /// The topic's type.
    pub type_name: String,
    /// Number of publishers on this host.
    pub publishers: usize,
    /// Number of subscriptions on this host.
    pub subscriptions: usize,
    /// Number of publishers on other hosts.
    pub remote_publishers: usize,
    /// Number of subscriptions on other hosts.
    pub remote_subscriptions: usize,
    /// Number of samples that publishers of this host wrote.
    pub published: u64,
    /// Number of samples that arrived from other hosts.
    pub arrived: u64,
    /// Bytes of memory that the topic's publishers on this host have committed, including the stand-ins for remote
    /// publishers.
    pub bytes_committed: u64,
    /// Number of samples that were not delivered, by reason.
    ///
    /// On this host: `overwritten` before a reader took them within its depth; `blocked`, `no_memory` and `pinned` as
    /// for [`WriterStatus`].
    ///
    /// Samples of publishers on this host that another host did not acknowledge: `link_ended` if the link ended, also
    /// for requests and responses that were not sent; `publisher_ended` if ten seconds passed without progress after
    /// the publisher ended; `stalled` if the other host's readers took nothing.
    ///
    /// Samples of a process that shares no memory: `publisher_ended` also counts samples that the process left when
    /// it ended and that no reader took for a second; `ring` also counts samples that the daemon could not write for
    /// the process.
    ///
    /// On the way to other hosts: `queue` while more samples waited than the history's depth; `late` if a sample
    /// could not arrive in time; `no_key` while there was no key; `no_link`; `no_route` if the other host no longer
    /// wanted the samples.
    ///
    /// On arrival: `ring`, `no_link`, `no_route` and `no_client`; `held` while the other host's samples take the
    /// maximum amount of memory on this host.
    pub dropped: BTreeMap<String, u64>,
    /// The publishers on this host, including the stand-ins for remote publishers: up to 64, those with the most
    /// memory first.
    pub writers: Vec<WriterStatus>,
    /// Number of further publishers.
    pub more_writers: usize,
    /// The readers on this host with their taken and lost samples, including the relays to other hosts: up to 64,
    /// those that wait longest and lost most first.
    pub readers: Vec<ReaderStatus>,
    /// Number of further readers.
    pub more_readers: usize,
    /// Pairs that are not matched because one session is outside the other's discovery range. An endpoint on another
    /// host is included only if its daemon showed it to this one.
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
    /// The endpoint's GID.
    pub endpoint: String,
    /// The name that the other host states for itself; empty if this daemon refuses the endpoint.
    pub host: String,
    /// The host that refuses the endpoint, and the reason.
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
    /// True if the publisher is the stand-in for a publisher on another host.
    pub stand_in: bool,
    /// The depth of the publisher's history; `null` for KEEP_ALL.
    pub depth: Option<u32>,
    /// Minimum number of samples that the publisher keeps, for its own depth and those of its readers.
    pub window: u64,
    /// Bytes of memory that the publisher has committed: descriptors, small samples, and segments of large samples.
    pub bytes_committed: u64,
    /// Number of published samples.
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
    /// True if the reader carries samples to other hosts.
    pub relay: bool,
    /// The depth of the reader's history; `null` for KEEP_ALL.
    pub depth: Option<u32>,
    /// Number of samples that the reader can take, at most its depth.
    pub unread: u64,
    /// Number of samples taken.
    pub received: u64,
    /// Number of samples overwritten before the reader took them, within its depth.
    pub lost: u64,
    /// Number of samples skipped because more recent ones filled the reader's depth. They are not lost.
    pub skipped: u64,
    /// The time since the publication of the oldest sample that the reader has not taken. If the publisher is on
    /// another host, the clocks of both hosts determine it. Milliseconds in JSON; `null` if the reader has taken all
    /// samples.
    #[serde(default, rename = "waiting_ms", with = "times::optional_millis")]
    pub waiting: Option<Duration>,
    /// True if the reader's process is stopped, by a signal or a debugger.
    pub stopped: bool,
}

impl ReaderStatus {
    /// Returns whether the reader has not taken a sample that has been available for a second.
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
    /// The reason why there are no decisions.
    pub error: Option<String>,
}

/// The decision of a peer's access rules about one use.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct PeerDecision {
    /// True if the peer allows the use.
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

    /// Programs read the names, order and units in the output of `axon status --json`.
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

    /// An earlier daemon omits fields that it does not know.
    #[test]
    fn missing_status_fields_have_their_default() {
        let reader = r#"{"pid":41,"reader":"aa","writer":"bb","relay":false,"depth":null,"unread":0,
            "received":0,"lost":0,"skipped":0,"stopped":false}"#;
        let read: ReaderStatus = serde_json::from_str(reader).unwrap();
        assert_eq!(read.waiting, None);
    }
}
