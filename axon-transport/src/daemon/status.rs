//! What a daemon says of itself: the JSON behind `axon status`.

use std::{collections::BTreeMap, time::SystemTime};

use serde::{Deserialize, Serialize};

/// The whole status.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Status {
    /// The daemon's id, in hexadecimal; new at each start.
    pub daemon: String,
    /// Its process.
    pub pid: u32,
    /// Seconds since its start.
    pub uptime_s: u64,
    /// The session protocol's version.
    pub protocol: u32,
    /// This crate's version.
    pub version: String,
    /// `ROS_DOMAIN_ID`.
    pub domain: u32,
    /// The effective security settings, as sessions are compared with them: `AXON_` name and value
    /// or digest.
    pub settings: BTreeMap<String, String>,
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
    /// Where sessions find the daemon.
    pub socket: String,
    /// Where it keeps files; nothing is kept when absent.
    pub runtime_dir: Option<String>,
    /// The gateway's UDP port; absent while it does not stand.
    pub port: Option<u16>,
    /// `running`, `starting`, or why it is not.
    pub gateway: String,
    /// Sessions on this host.
    pub sessions: Vec<SessionStatus>,
    /// Topics with an endpoint somewhere.
    pub topics: Vec<TopicStatus>,
    /// Links to other hosts' daemons.
    pub links: Vec<LinkStatus>,
    /// The key supply, as the gateway describes it.
    pub keys: serde_json::Value,
    /// The last refusals, oldest first.
    pub refusals: Vec<RefusalStatus>,
}

/// A session.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct SessionStatus {
    /// Its process.
    pub pid: u32,
    /// Its name.
    pub name: String,
    /// `application` or `gateway`.
    pub role: String,
    /// How many endpoints it has.
    pub endpoints: usize,
    /// Control packets that wait for it.
    pub queued: usize,
}

/// A topic.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
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
    /// What each reader on this host took and lost, relays to other hosts among them.
    pub readers: Vec<ReaderStatus>,
}

/// A reader's share of one writer's samples.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct ReaderStatus {
    /// The reader's process.
    pub pid: u32,
    /// The reader's GID.
    pub reader: String,
    /// The writer's GID.
    pub writer: String,
    /// Whether it carries samples to other hosts.
    pub relay: bool,
    /// Samples taken.
    pub received: u64,
    /// Samples overwritten before they were taken.
    pub lost: u64,
}

/// A link to another host's daemon.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct LinkStatus {
    /// The peer's daemon id, in hexadecimal.
    pub peer: String,
    /// The peer's host name, as it calls itself.
    pub host: String,
    /// The peer's SAE ID in qkd.
    pub sae: Option<String>,
    /// Its address and port.
    pub address: String,
    /// `connected`, or what it waits for.
    pub state: String,
    /// The key exchange as negotiated, read from the handshake.
    pub key_exchange: String,
    /// The cipher suite as negotiated.
    pub cipher: String,
    /// How and as whom the peer proved itself.
    pub authenticated_as: String,
    /// Milliseconds since the Unix epoch at which it was established.
    pub since_unix_ms: u64,
    /// Round-trip time in microseconds.
    pub rtt_us: u64,
    /// Samples received.
    pub samples_in: u64,
    /// Samples sent.
    pub samples_out: u64,
    /// Bytes received.
    pub bytes_in: u64,
    /// Bytes sent.
    pub bytes_out: u64,
    /// Samples dropped, by cause.
    pub dropped: BTreeMap<String, u64>,
}

/// Somebody who was refused.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct RefusalStatus {
    /// Milliseconds since the Unix epoch.
    pub unix_ms: u64,
    /// Who.
    pub peer: String,
    /// What was refused, or the variable that differs.
    pub what: String,
    /// Why.
    pub reason: String,
}

/// Now, in milliseconds since the Unix epoch.
pub fn unix_ms() -> u64 {
    SystemTime::now()
        .duration_since(SystemTime::UNIX_EPOCH)
        .map_or(0, |d| u64::try_from(d.as_millis()).unwrap_or(u64::MAX))
}
