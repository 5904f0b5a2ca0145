//! The validated settings of one process.

use std::{net::IpAddr, path::PathBuf, time::Duration};

use minicbor::{Decode, Encode};

use super::{TopicPriority, TopicRule, daemon_env::DaemonEnv, topics};
use crate::access::{AccessRules, RateLimit};

/// Everything that the environment and `axon.toml`, or a [`ConfigBuilder`](super::ConfigBuilder), decide.
///
/// To change one, change the builder: neither validation nor the daemon that a session starts knows of a
/// field that was assigned to.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Config {
    /// How peers prove themselves and agree on keys.
    pub security: Security,
    /// The one cipher offered (`AXON_QUIC_CIPHER`).
    pub cipher: QuicCipher,
    /// `ROS_DOMAIN_ID`.
    pub domain: u32,
    /// How far a session is discovered (`ROS_AUTOMATIC_DISCOVERY_RANGE`, `ROS_LOCALHOST_ONLY`). Of a
    /// daemon it counts while the daemon has no session.
    pub range: DiscoveryRange,
    /// `ROS_STATIC_PEERS`: addresses or host names; empty where the range ignores them.
    pub static_peers: Vec<String>,
    /// `AXON_DAEMON`.
    pub daemon: DaemonPolicy,
    /// `AXON_DAEMON_PATH`.
    pub daemon_path: Option<PathBuf>,
    /// Where a daemon keeps files: `AXON_RUNTIME_DIR`, else `$XDG_RUNTIME_DIR/axon`, else nowhere.
    pub runtime_dir: Option<PathBuf>,
    /// Whether `AXON_RUNTIME_DIR` was set: then it holds the session socket too.
    pub socket_in_runtime_dir: bool,
    /// `AXON_BIND_ADDRS`; empty means every address.
    pub bind_addrs: Vec<IpAddr>,
    /// `AXON_DAEMON_PEERS`.
    pub daemon_peers: Vec<PeerAddress>,
    /// `AXON_ADVERTISE_ADDRS`; empty means the interfaces' addresses.
    pub advertise_addrs: Vec<IpAddr>,
    /// `AXON_RING_BUFFER_SIZE_MB` in bytes: history per ring.
    pub ring_bytes: u64,
    /// `AXON_MAX_MESSAGE_MB` in bytes: the largest message.
    pub max_message: u64,
    /// `AXON_RELIABLE_QUEUE_MB` in bytes: the daemon's reliable queue.
    pub reliable_queue: u64,
    /// `AXON_SHM`: whether sessions share memory; their samples pass through the daemon otherwise.
    pub shm: bool,
    /// `AXON_SHM_COPY`.
    pub shm_copy: bool,
    /// `AXON_TRUSTED_UIDS`.
    pub trusted_uids: Vec<u32>,
    /// `AXON_LOG`: a tracing filter.
    pub log: String,
    /// Who may do what: the rules of `AXON_ACCESS_FILE`, or those of `axon.toml`.
    pub access: AccessRules,
    /// Where those rules are; `None` where there are none.
    pub access_file: Option<PathBuf>,
    /// `[link]` of `axon.toml`.
    pub link: LinkConfig,
    /// `[[topic]]` of `axon.toml`. The first entry that a name fits counts.
    pub topics: Vec<TopicRule>,
    /// Variables of the environment that begin with `AXON_` and are no settings. They count for nothing.
    pub unknown_variables: Vec<String>,
    /// How a daemon that a session starts comes to these settings.
    pub(crate) daemon_env: DaemonEnv,
}

impl Config {
    /// The priority of a topic or service between hosts, by its name.
    pub fn topic_priority(&self, name: &str) -> TopicPriority {
        topics::first(&self.topics, name).map_or(TopicPriority::Normal, |rule| rule.priority)
    }

    /// Whether the samples of a topic or service may be compressed for other hosts.
    pub fn topic_compression(&self, name: &str) -> bool {
        let of_topic = topics::first(&self.topics, name).map(|rule| rule.compression);
        [Some(self.link.compression), of_topic]
            .iter()
            .all(|one| *one != Some(LinkCompression::Never))
    }

    /// The limit that `max_hz` sets for the samples of a topic to each other host.
    pub fn topic_limit(&self, name: &str) -> Option<RateLimit> {
        topics::first(&self.topics, name)?.limit()
    }
}

/// The choice that [`Security`] holds the settings of (`AXON_SECURITY_MODE`).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SecurityMode {
    /// X25519MLKEM768 and nothing else.
    Classic,
    /// A KME key as external PSK.
    Qkd,
}

impl SecurityMode {
    /// As `AXON_SECURITY_MODE` spells it.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Classic => "classic",
            Self::Qkd => "qkd",
        }
    }
}

/// How peers prove themselves and agree on keys (`AXON_SECURITY_MODE`).
#[derive(Clone, Debug)]
pub enum Security {
    /// X25519MLKEM768 and nothing else.
    Classic(ClassicConfig),
    /// A KME key as external PSK.
    Qkd(QkdConfig),
}

/// Settings of `classic`.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct ClassicConfig {
    /// `AXON_CLASSIC_AUTH`.
    pub auth: ClassicAuth,
    /// `AXON_CLASSIC_KEY`: PKCS#8, mode 0600.
    pub key: Option<PathBuf>,
    /// `AXON_CLASSIC_TRUST`: the pins.
    pub trust: Option<PathBuf>,
    /// `AXON_CLASSIC_CA`.
    pub ca: Option<PathBuf>,
    /// `AXON_CLASSIC_CERT`.
    pub cert: Option<PathBuf>,
    /// `AXON_CLASSIC_CRL`.
    pub crl: Option<PathBuf>,
}

impl ClassicConfig {
    /// These settings, without any file.
    pub fn new(auth: ClassicAuth) -> Self {
        Self { auth, key: None, trust: None, ca: None, cert: None, crl: None }
    }
}

/// How a peer is known in `classic`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ClassicAuth {
    /// Not at all: stops a recording adversary, not an active one.
    None,
    /// Raw public keys listed in a trust file.
    Pinned,
    /// Certificates under given roots.
    Ca,
}

/// Settings of `qkd`.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct QkdConfig {
    /// `AXON_QKD_KEY_MODE`.
    pub key_mode: KeyMode,
    /// `AXON_QKD_KEX`.
    pub kex: QkdKex,
    /// `AXON_QKD_PEERS`.
    pub peers: QkdPeers,
    /// `AXON_QKD_SESSION_MAX_AGE`.
    pub session_max_age: Duration,
    /// `AXON_KME_URL`.
    pub kme_url: String,
    /// `AXON_KME_CA`.
    pub kme_ca: PathBuf,
    /// `AXON_KME_ID`.
    pub kme_id: Option<String>,
    /// `AXON_SAE_ID`.
    pub sae_id: String,
    /// `AXON_SAE_CERT`.
    pub sae_cert: PathBuf,
    /// `AXON_SAE_KEY`.
    pub sae_key: PathBuf,
    /// `AXON_KME_QUIRKS`.
    pub kme_quirks: Vec<String>,
    /// `AXON_KME_CONNECT_TIMEOUT`: how long TCP and TLS to the KME may take.
    pub kme_connect_timeout: Duration,
    /// `AXON_KME_ANSWER_TIMEOUT`: how long a whole call may take.
    pub kme_answer_timeout: Duration,
}

impl QkdConfig {
    /// Settings with a default for each that is not given here. Only [`Config::builder`] checks them.
    pub fn new(
        sae_id: impl Into<String>,
        peers: QkdPeers,
        kme_url: impl Into<String>,
        kme_ca: impl Into<PathBuf>,
        sae_cert: impl Into<PathBuf>,
        sae_key: impl Into<PathBuf>,
    ) -> Self {
        Self {
            key_mode: KeyMode::Messages10,
            kex: QkdKex::PskKe,
            peers,
            session_max_age: Duration::from_secs(3600),
            kme_url: kme_url.into(),
            kme_ca: kme_ca.into(),
            kme_id: None,
            sae_id: sae_id.into(),
            sae_cert: sae_cert.into(),
            sae_key: sae_key.into(),
            kme_quirks: Vec::new(),
            kme_connect_timeout: Duration::from_secs(2),
            kme_answer_timeout: Duration::from_secs(3),
        }
    }

    /// The quirk of a KME whose certificate does not name the host in its URL, as one without a
    /// subjectAltName: the host's name is not checked, and [`kme_id`](Self::kme_id) alone tells the KME
    /// from other holders of a certificate from [`kme_ca`](Self::kme_ca). Not valid without that ID.
    pub const NO_NAME_CHECK: &'static str = "no-name-check";

    /// The quirks that [`kme_quirks`](Self::kme_quirks) may name: those of `etsi-qkd014`, and
    /// [`NO_NAME_CHECK`](Self::NO_NAME_CHECK).
    pub const KME_QUIRKS: [&'static str; 10] = [
        "any-key-id",
        "null-members",
        "missing-status-numbers",
        "size-in-bytes",
        "any-case-members",
        "any-media-type",
        "extra-members",
        "http-1.0",
        "any-extension",
        Self::NO_NAME_CHECK,
    ];

    /// Whether the KME's certificate must name the host in the KME's URL.
    pub fn checks_name(&self) -> bool {
        !self.kme_quirks.iter().any(|quirk| quirk == Self::NO_NAME_CHECK)
    }
}

/// The cipher suite of every connection (`AXON_QUIC_CIPHER`): TLS 1.3 with a 256-bit key.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum QuicCipher {
    /// TLS_CHACHA20_POLY1305_SHA256
    #[default]
    ChaCha20Poly1305,
    /// TLS_AES_256_GCM_SHA384
    Aes256Gcm,
}

impl QuicCipher {
    /// As `AXON_QUIC_CIPHER` spells it.
    pub const fn name(self) -> &'static str {
        match self {
            Self::ChaCha20Poly1305 => "chacha20-poly1305",
            Self::Aes256Gcm => "aes-256-gcm",
        }
    }
}

/// How a KME key is used as a pre-shared key (`AXON_QKD_KEX`; RFC 8446 section 4.2.9).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum QkdKex {
    /// The key alone. No forward secrecy: who learns the key later reads a recorded connection.
    #[default]
    PskKe,
    /// The key together with X25519MLKEM768.
    PskDheKe,
}

impl QkdKex {
    /// As `AXON_QKD_KEX` spells it.
    pub const fn name(self) -> &'static str {
        match self {
            Self::PskKe => "psk_ke",
            Self::PskDheKe => "psk_dhe_ke",
        }
    }
}

/// What KME keys protect (`AXON_QKD_KEY_MODE`).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum KeyMode {
    /// The QUIC session alone.
    Session,
    /// The QUIC session, and each message in an envelope whose key changes every ten.
    Messages10,
}

/// Which SAEs may be peers (`AXON_QKD_PEERS`).
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum QkdPeers {
    /// Any SAE that the KME knows; written `*`.
    Any,
    /// These.
    Listed(Vec<String>),
}

impl QkdPeers {
    /// Whether `sae` may be a peer.
    pub fn allows(&self, sae: &str) -> bool {
        match self {
            Self::Any => true,
            Self::Listed(saes) => saes.iter().any(|s| s == sae),
        }
    }
}

/// What a session does about its daemon (`AXON_DAEMON`).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DaemonPolicy {
    /// Start one when there is none.
    Spawn,
    /// Fail when there is none.
    Require,
    /// Never use one: only what this process reaches by itself.
    Off,
}

/// How far a session is discovered, as ROS 2 means it; the narrowest first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Encode, Decode)]
#[cbor(index_only)]
pub enum DiscoveryRange {
    /// Nowhere: the session matches nothing but itself.
    #[n(2)]
    Off,
    /// This host, and hosts of which either side lists the other as a static peer.
    #[n(1)]
    Localhost,
    /// What multicast reaches, and static peers.
    #[n(0)]
    Subnet,
}

impl DaemonPolicy {
    /// As `AXON_DAEMON` spells it.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Spawn => "spawn",
            Self::Require => "require",
            Self::Off => "off",
        }
    }
}

impl DiscoveryRange {
    /// Its number on every wire.
    pub const fn number(self) -> u8 {
        match self {
            Self::Subnet => 0,
            Self::Localhost => 1,
            Self::Off => 2,
        }
    }

    /// The value of `ROS_AUTOMATIC_DISCOVERY_RANGE`.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Off => "OFF",
            Self::Localhost => "LOCALHOST",
            Self::Subnet => "SUBNET",
        }
    }
}

/// A static peer (`AXON_DAEMON_PEERS`).
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct PeerAddress {
    /// Address or name.
    pub host: String,
    /// The QUIC port; all sixteen of the domain are tried when absent.
    pub port: Option<u16>,
}

/// `[link]` of `axon.toml`.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct LinkConfig {
    /// How long a daemon outlives its last session.
    pub grace: Duration,
    /// A peer that reads nothing of a KEEP_ALL topic for so long is disconnected from it.
    pub stalled: Duration,
    /// Largest UDP payload that path discovery tries, in bytes.
    pub mtu: u16,
    /// Memory for the graph of one peer, in bytes. Its routes may take four times as much.
    pub graph: usize,
    /// Memory for the samples and calls of one peer that are kept here for readers and servers, in bytes.
    pub held: u64,
    /// How long the reactor looks for input before it sleeps.
    pub poll: LinkPoll,
    /// Where QUIC's events are written, in the format qlog.
    pub qlog: Option<PathBuf>,
    /// How a link finds its share of the path.
    pub congestion: Congestion,
    /// Whether samples are compressed.
    pub compression: LinkCompression,
}

/// Whether the daemon looks for the next input before it sleeps (`AXON_LINK_POLL`).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum LinkPoll {
    /// For some tens of microseconds, while that often finds an input.
    #[default]
    Adaptive,
    /// It never sleeps, and keeps a processor busy.
    Always,
    /// It sleeps at once.
    Never,
}

/// The congestion controller of links (`AXON_LINK_CONGESTION`). Either side of a link decides for what it sends.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Congestion {
    /// `Delay` to private and link-local addresses, `Cubic` to all others.
    #[default]
    Auto,
    /// AXON's own: it keeps queues short and ignores random loss, as radio links need it.
    Delay,
    /// CUBIC (RFC 9438), which most of the Internet uses.
    Cubic,
    /// BBR, as the QUIC library has it.
    Bbr,
}

/// Whether samples are compressed for other hosts (`AXON_LINK_COMPRESSION`). A daemon decides for what it sends.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum LinkCompression {
    /// Those of 1 KiB to 8 MiB by zstd, while the link carries less than waits for it and compression takes at most 0.3 of
    /// the time for which the link is busy with the sample.
    #[default]
    Auto,
    /// None.
    Never,
}

impl Default for LinkConfig {
    fn default() -> Self {
        let ten = Duration::from_secs(10);
        Self {
            grace: ten,
            stalled: ten,
            mtu: 1452,
            graph: 16 << 20,
            held: 2 << 30,
            poll: LinkPoll::Adaptive,
            qlog: None,
            congestion: Congestion::Auto,
            compression: LinkCompression::Auto,
        }
    }
}
