//! Tests the text that shows a status.

use std::time::SystemTime;

use axon_transport::status::{
    LimitStatus, OutOfRangeStatus, ReaderStatus, RefusalStatus, RefusedRouteStatus, WriterStatus,
};
use serde_json::json;

use super::*;

fn status() -> Status {
    let mut status = Status::default();
    status.daemon = "00ff".to_owned();
    status.pid = 7;
    status.uptime = Duration::from_secs(90);
    status.protocol = 1;
    status.version = "0.1.0".to_owned();
    status.domain = 3;
    status.settings = BTreeMap::from([("AXON_SECURITY_MODE".to_owned(), "qkd".to_owned())]);
    status.mode = "qkd".to_owned();
    status.key_mode = Some("messages10".to_owned());
    status.kex = Some("psk_ke".to_owned());
    status.cipher = "chacha20-poly1305".to_owned();
    status.sae = Some("sae-a".to_owned());
    status.socket = "@axon/0/3/1".to_owned();
    status.port = Some(61_348);
    status.gateway = "running".to_owned();
    status.discovery.range = "SUBNET".to_owned();
    status.discovery.hosts = vec!["robot-2".to_owned()];
    status.sessions = vec![session()];
    status.topics = vec![topic()];
    status.links = vec![link()];
    status.keys = json!({"kme": {"enc": {"calls": 12}}, "peers": [{"ready": 4}]});
    let at = SystemTime::UNIX_EPOCH + Duration::from_millis(u64::MAX);
    let [peer, what, reason] = ["sae-x", "handshake", "wrong PSK"].map(str::to_owned);
    status.refusals = vec![RefusalStatus::new(at, peer, what, reason)];
    status
}

fn session() -> SessionStatus {
    let mut session = SessionStatus::default();
    session.pid = 9;
    session.name = "talker".to_owned();
    session.role = "application".to_owned();
    session.endpoints = 1;
    session.range = Some("LOCALHOST".to_owned());
    session.range_stated = true;
    session.static_peers = vec!["robot-2".to_owned()];
    session
}

fn topic() -> TopicStatus {
    let mut topic = TopicStatus::default();
    topic.topic = "/scan".to_owned();
    topic.bytes_committed = 3 << 20;
    topic.dropped = BTreeMap::from([("overwritten".to_owned(), 5)]);
    topic.writers = vec![WriterStatus::default(), WriterStatus::default()];
    topic.writers[0].depth = Some(10);
    let mut pair = OutOfRangeStatus::default();
    pair.writer = "aa".to_owned();
    pair.reader = "bb".to_owned();
    pair.reason = "the range is LOCALHOST".to_owned();
    topic.out_of_range = vec![pair];
    let mut route = RefusedRouteStatus::default();
    route.endpoint = "cc".to_owned();
    route.host = "robot-3".to_owned();
    route.reason = "refused by the peer: no room".to_owned();
    topic.refused = vec![route];
    topic.readers = vec![reader(41, 12_000), reader(42, 999)];
    topic
}

fn link() -> LinkStatus {
    let mut link = LinkStatus::default();
    link.host = "evil\x1b[2J".to_owned();
    link.dropped = BTreeMap::from([("no_key".to_owned(), 1_000), ("other".to_owned(), 0)]);
    link.rtt_min = Duration::from_micros(740);
    link.packets_lost = 7_654;
    link.bytes_lost = 9_100_000;
    link.ecn_marks_out = 321;
    link.waiting.control = 17;
    link.waiting.bulk = 4_500_000;
    link.oldest_waits = Duration::from_millis(88);
    let denied = ("publish /brake (the peer's)", "here: denied by access.toml:7");
    link.denied = BTreeMap::from([(denied.0.to_owned(), denied.1.to_owned())]);
    link.more_denied = 3;
    let mut limit = LimitStatus::default();
    (limit.verb, limit.name) = ("subscribe".to_owned(), "/camera".to_owned());
    (limit.limit, limit.place) = ("30 msg/s".to_owned(), "access.toml:12".to_owned());
    (limit.passed, limit.dropped) = (4_321, 98);
    link.limits = vec![limit];
    link.more_limits = 1_234;
    link.compressed = serde_json::from_value(
        json!({"samples": 2_345, "bytes": 5_000_000, "bytes_sent": 1_700_000}),
    )
    .expect("a status");
    link
}

/// Returns a reader of a stopped process whose oldest sample has waited for `waiting_ms`.
fn reader(pid: u32, waiting_ms: u64) -> ReaderStatus {
    let mut reader = ReaderStatus::default();
    reader.pid = pid;
    reader.waiting = Some(Duration::from_millis(waiting_ms));
    reader.stopped = true;
    reader
}

#[test]
fn withheld_status_fields_are_not_shown_as_empty() {
    let mut status = Status::default();
    status.daemon = "00ff".to_owned();
    status.gateway = "running".to_owned();
    status.withheld = true;
    let text = render(&status);
    assert!(text.contains("00ff") && text.contains("running"), "{text}");
    assert!(text.contains("tells no other user its settings"), "{text}");
    for untrue in ["none", "no other host", "nobody", "nothing", "everything is allowed"] {
        assert!(!text.contains(untrue), "{untrue}: {text}");
    }
}

#[test]
fn status_removes_control_characters_of_peer_names() {
    assert!(!render(&status()).contains('\x1b'));
}

#[test]
fn every_part_is_shown() {
    let text = render(&status());
    for part in [
        "qkd (messages10, psk_ke, chacha20-poly1305), SAE sae-a",
        "AXON_SECURITY_MODE",
        "1,000 no_key",
        "740 us",
        "7,654 (9.10 MB)",
        "321",
        "17 B control, 4.50 MB bulk",
        "88.0 ms",
        "kme enc calls",
        "peers 1 ready",
        "/scan",
        "10 to all",
        "3.15 MB",
        "5 overwritten",
        "pid 41 (stopped, 12.0 s)",
        "wrong PSK",
        "SUBNET, looks for robot-2",
        "LOCALHOST, lists robot-2; linked: none",
        "the range is LOCALHOST",
        "refused by the peer: no room",
        "publish /brake (the peer's)",
        "denied by access.toml:7",
        "subscribe /camera",
        "30 msg/s",
        "access.toml:12",
        "4,321",
        "98",
        "\nDenied by access rules\n",
        "and 3 more",
        "\nLimits\n",
        "and 1,234 more",
        "2,345: 5.00 MB to 1.70 MB",
    ] {
        assert!(text.contains(part), "{part:?} is missing in:\n{text}");
    }
    assert!(!text.contains("pid 42"), "what has just come is no sign of a stall:\n{text}");
    assert!(!text.contains("other"), "a cause that never happened is not shown:\n{text}");
}

#[test]
fn a_session_says_whether_it_shares_memory() {
    assert_eq!(memory(None), "shared");
    let mut relay = RelayStatus::default();
    relay.reason = "AXON_SHM is off".to_owned();
    (relay.samples_in, relay.bytes_in, relay.lost) = (1, 2048, 3);
    let text = memory(Some(&relay));
    assert!(text.starts_with("relayed: AXON_SHM is off; in 1 ("), "{text}");
    assert!(text.ends_with("lost 3"), "{text}");
}
