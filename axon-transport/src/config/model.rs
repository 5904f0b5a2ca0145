//! The validated settings of one process.

use std::{net::IpAddr, path::PathBuf, time::Duration};

use minicbor::{Decode, Encode};

use super::{TopicPriority, TopicRule, daemon_env::DaemonEnv, topics};
use crate::access::{AccessRules, RateLimit};

/// All settings that the environment and `axon.toml`, or a [`ConfigBuilder`](super::ConfigBuilder), determine.
///
/// To change a setting, use the builder. A value that is assigned to a field is not validated, and does not reach the
/// daemon that a session starts.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Config {
    /// Authentication of peers and key agreement.
    pub security: Security,
    /// The only cipher that is offered (`AXON_QUIC_CIPHER`).
    pub cipher: QuicCipher,
    /// The ROS domain (`ROS_DOMAIN_ID`).
    pub domain: u32,
    /// Discovery range of a session (`ROS_AUTOMATIC_DISCOVERY_RANGE`, `ROS_LOCALHOST_ONLY`). A daemon uses its own
    /// range only while it has no session.
    pub range: DiscoveryRange,
    /// Addresses or host names of static peers (`ROS_STATIC_PEERS`). Empty if the range ignores them.
    pub static_peers: Vec<String>,
    /// Use of a daemon (`AXON_DAEMON`).
    pub daemon: DaemonPolicy,
    /// The daemon's program (`AXON_DAEMON_PATH`).
    pub daemon_path: Option<PathBuf>,
    /// Directory for the daemon's files: `AXON_RUNTIME_DIR`, otherwise `$XDG_RUNTIME_DIR/axon`. `None` if neither
    /// variable is an absolute path.
    pub runtime_dir: Option<PathBuf>,
    /// True if `AXON_RUNTIME_DIR` was set. The directory then also holds the session socket.
    pub socket_in_runtime_dir: bool,
    /// Local addresses of discovery and links (`AXON_BIND_ADDRS`). Empty means every address.
    pub bind_addrs: Vec<IpAddr>,
    /// Peers to try besides those that discovery finds (`AXON_DAEMON_PEERS`).
    pub daemon_peers: Vec<PeerAddress>,
    /// Addresses in beacons (`AXON_ADVERTISE_ADDRS`). Empty means the addresses of the interfaces.
    pub advertise_addrs: Vec<IpAddr>,
    /// Size of the history per ring, in bytes (`AXON_RING_BUFFER_SIZE_MB`).
    pub ring_bytes: u64,
    /// Size of the largest message, in bytes (`AXON_MAX_MESSAGE_MB`).
    pub max_message: u64,
    /// Size of the daemon's reliable queue, in bytes (`AXON_RELIABLE_QUEUE_MB`).
    pub reliable_queue: u64,
    /// True if sessions share memory (`AXON_SHM`). Otherwise, their samples pass through the daemon.
    pub shm: bool,
    /// True if samples of more than 4 KiB are copied when they are taken (`AXON_SHM_COPY`).
    pub shm_copy: bool,
    /// Other users whose daemon and sessions are trusted (`AXON_TRUSTED_UIDS`).
    pub trusted_uids: Vec<u32>,
    /// Log filter in the syntax of `tracing` (`AXON_LOG`).
    pub log: String,
    /// Access rules of `AXON_ACCESS_FILE` or `axon.toml`.
    pub access: AccessRules,
    /// The file of the access rules, or `/dev/null` if `AXON_ACCESS_FILE` disables rules. `None` without either.
    pub access_file: Option<PathBuf>,
    /// The section `[link]` of `axon.toml`.
    pub link: LinkConfig,
    /// The entries `[[topic]]` of `axon.toml`. The first entry that fits a name applies.
    pub topics: Vec<TopicRule>,
    /// Environment variables that begin with `AXON_` and are not settings. AXON ignores them.
    pub unknown_variables: Vec<String>,
    /// Environment that passes these settings to a daemon which a session starts.
    pub(crate) daemon_env: DaemonEnv,
}

impl Config {
    /// Returns the priority of a topic or service between hosts, by its name.
    pub fn topic_priority(&self, name: &str) -> TopicPriority {
        topics::first(&self.topics, name).map_or(TopicPriority::Normal, |rule| rule.priority)
    }

    /// Returns whether the daemon may compress the samples of a topic or service for other hosts.
    pub fn topic_compression(&self, name: &str) -> bool {
        let of_topic = topics::first(&self.topics, name).map(|rule| rule.compression);
        [Some(self.link.compression), of_topic]
            .iter()
            .all(|one| *one != Some(LinkCompression::Never))
    }

    /// Returns whether small RELIABLE samples of a topic, or small requests and responses of a service, may cross both paths
    /// to a host. In `messages10` they do only if a rule asks for it.
    pub fn topic_redundancy(&self, name: &str) -> bool {
        let rule = topics::first(&self.topics, name).and_then(|rule| rule.redundant);
        rule.unwrap_or_else(|| !self.seals_messages())
    }

    /// Returns whether each message between hosts has an envelope under a KME key (`messages10`).
    fn seals_messages(&self) -> bool {
        matches!(&self.security, Security::Qkd(qkd) if qkd.key_mode == KeyMode::Messages10)
    }

    /// Returns the limit that `max_hz` sets for the samples of a topic to each other host.
    pub fn topic_limit(&self, name: &str) -> Option<RateLimit> {
        topics::first(&self.topics, name)?.limit()
    }
}

/// The security mode (`AXON_SECURITY_MODE`). [`Security`] holds its settings.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SecurityMode {
    /// Keys from X25519MLKEM768 alone.
    Classic,
    /// A KME key as external PSK.
    Qkd,
}

impl SecurityMode {
    /// Returns the value of `AXON_SECURITY_MODE`.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Classic => "classic",
            Self::Qkd => "qkd",
        }
    }
}

/// Authentication of peers and key agreement (`AXON_SECURITY_MODE`).
#[derive(Clone, Debug)]
pub enum Security {
    /// Keys from X25519MLKEM768 alone.
    Classic(ClassicConfig),
    /// A KME key as external PSK.
    Qkd(QkdConfig),
}

/// Settings of `classic`.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct ClassicConfig {
    /// Authentication of peers (`AXON_CLASSIC_AUTH`).
    pub auth: ClassicAuth,
    /// File of this host's private key, PKCS#8, mode 0600 or 0400 (`AXON_CLASSIC_KEY`).
    pub key: Option<PathBuf>,
    /// File of pins (`AXON_CLASSIC_TRUST`).
    pub trust: Option<PathBuf>,
    /// File of roots (`AXON_CLASSIC_CA`).
    pub ca: Option<PathBuf>,
    /// File of this host's certificate chain (`AXON_CLASSIC_CERT`).
    pub cert: Option<PathBuf>,
    /// File of certificate revocation lists (`AXON_CLASSIC_CRL`).
    pub crl: Option<PathBuf>,
}

impl ClassicConfig {
    /// Creates settings without files.
    pub fn new(auth: ClassicAuth) -> Self {
        Self { auth, key: None, trust: None, ca: None, cert: None, crl: None }
    }
}

/// Authentication of a peer in `classic`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ClassicAuth {
    /// No authentication. Protects against eavesdroppers, not against an active attacker.
    None,
    /// Raw public keys listed in a trust file.
    Pinned,
    /// Certificates that chain to the given roots.
    Ca,
}

/// Settings of `qkd`.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct QkdConfig {
    /// Scope of KME keys (`AXON_QKD_KEY_MODE`).
    pub key_mode: KeyMode,
    /// Key exchange beside the KME key (`AXON_QKD_KEX`).
    pub kex: QkdKex,
    /// SAEs that may be peers (`AXON_QKD_PEERS`).
    pub peers: QkdPeers,
    /// Age at which a connection is replaced by one under a new key (`AXON_QKD_SESSION_MAX_AGE`).
    pub session_max_age: Duration,
    /// URL of this host's KME (`AXON_KME_URL`).
    pub kme_url: String,
    /// File of roots for the KME's certificate (`AXON_KME_CA`).
    pub kme_ca: PathBuf,
    /// Common name that the KME's certificate must also have (`AXON_KME_ID`). `None` disables the check.
    pub kme_id: Option<String>,
    /// This host's SAE ID (`AXON_SAE_ID`).
    pub sae_id: String,
    /// File of the client certificate for the KME (`AXON_SAE_CERT`).
    pub sae_cert: PathBuf,
    /// File of the client certificate's private key, mode 0600 or 0400 (`AXON_SAE_KEY`).
    pub sae_key: PathBuf,
    /// Tolerated deviations of the KME, by the names of [`KME_QUIRKS`](Self::KME_QUIRKS) (`AXON_KME_QUIRKS`).
    pub kme_quirks: Vec<String>,
    /// Maximum time for TCP and TLS to the KME (`AXON_KME_CONNECT_TIMEOUT`).
    pub kme_connect_timeout: Duration,
    /// Maximum time for a whole call to the KME (`AXON_KME_ANSWER_TIMEOUT`).
    pub kme_answer_timeout: Duration,
}

impl QkdConfig {
    /// Creates settings with defaults for all values that are not given here. Only [`Config::builder`] validates
    /// settings.
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

    /// Quirk of a KME whose certificate does not name the host in the KME's URL, for example because it has no
    /// subjectAltName. The client then does not check the host name. Only [`kme_id`](Self::kme_id) distinguishes the
    /// KME from other holders of a certificate from [`kme_ca`](Self::kme_ca). Not valid without `kme_id`.
    pub const NO_NAME_CHECK: &'static str = "no-name-check";

    /// Quirks that [`kme_quirks`](Self::kme_quirks) may name: the quirks of `etsi-qkd014`, and
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

    /// Returns whether the KME's certificate must name the host in the KME's URL.
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
    /// Returns the value of `AXON_QUIC_CIPHER`.
    pub const fn name(self) -> &'static str {
        match self {
            Self::ChaCha20Poly1305 => "chacha20-poly1305",
            Self::Aes256Gcm => "aes-256-gcm",
        }
    }
}

/// Use of a KME key as a pre-shared key (`AXON_QKD_KEX`; RFC 8446 section 4.2.9).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum QkdKex {
    /// The key alone. No forward secrecy: an attacker who learns the key later can decrypt a recorded connection.
    #[default]
    PskKe,
    /// The key together with X25519MLKEM768.
    PskDheKe,
}

impl QkdKex {
    /// Returns the value of `AXON_QKD_KEX`.
    pub const fn name(self) -> &'static str {
        match self {
            Self::PskKe => "psk_ke",
            Self::PskDheKe => "psk_dhe_ke",
        }
    }
}

/// Scope of KME keys (`AXON_QKD_KEY_MODE`).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum KeyMode {
    /// The QUIC session alone.
    Session,
    /// The QUIC session, and each message in an envelope whose key changes every ten messages.
    Messages10,
}

/// SAEs that may be peers (`AXON_QKD_PEERS`).
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum QkdPeers {
    /// Any SAE that the KME knows; written `*`.
    Any,
    /// The listed SAE IDs.
    Listed(Vec<String>),
}

impl QkdPeers {
    /// Returns whether `sae` may be a peer.
    pub fn allows(&self, sae: &str) -> bool {
        match self {
            Self::Any => true,
            Self::Listed(saes) => saes.iter().any(|s| s == sae),
        }
    }
}

/// Use of a daemon by a session (`AXON_DAEMON`).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DaemonPolicy {
    /// Start a daemon if none runs.
    Spawn,
    /// Fail if no daemon runs.
    Require,
    /// Never use a daemon. The session then reaches only its own process.
    Off,
}

/// Discovery range of a session, as ROS 2 defines it. The order begins with the narrowest range.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Encode, Decode)]
#[cbor(index_only)]
pub enum DiscoveryRange {
    /// The session matches only its own endpoints.
    #[n(2)]
    Off,
    /// This host, and other hosts if either side lists the other as a static peer.
    #[n(1)]
    Localhost,
    /// Hosts that multicast reaches, and static peers.
    #[n(0)]
    Subnet,
}

impl DaemonPolicy {
    /// Returns the value of `AXON_DAEMON`.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Spawn => "spawn",
            Self::Require => "require",
            Self::Off => "off",
        }
    }
}

impl DiscoveryRange {
    /// Returns the number in the wire formats.
    pub const fn number(self) -> u8 {
        match self {
            Self::Subnet => 0,
            Self::Localhost => 1,
            Self::Off => 2,
        }
    }

    /// Returns the value of `ROS_AUTOMATIC_DISCOVERY_RANGE`.
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
    /// Address or host name.
    pub host: String,
    /// The QUIC port. `None` means that the daemon tries all sixteen ports of the domain.
    pub port: Option<u16>,
}

/// The section `[link]` of `axon.toml`.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct LinkConfig {
    /// Time for which a daemon outlives its last session.
    pub grace: Duration,
    /// Time after which a peer that reads nothing of a KEEP_ALL topic is disconnected from it.
    pub stalled: Duration,
    /// Largest UDP payload that path discovery tries, in bytes.
    pub mtu: u16,
    /// Memory for the graph of one peer, in bytes. The peer's routes may take four times as much.
    pub graph: usize,
    /// Memory for one peer's samples and calls that this host keeps for its readers and servers, in bytes.
    pub held: u64,
    /// Polling of the reactor before it sleeps.
    pub poll: LinkPoll,
    /// Directory for QUIC's events in the format qlog.
    pub qlog: Option<PathBuf>,
    /// Congestion controller of links.
    pub congestion: Congestion,
    /// Compression of samples for other hosts.
    pub compression: LinkCompression,
    /// Maximum number of links with one peer at a time, each to another address of the peer: 1 or 2. With 2 a second
    /// link stands by, and takes over when the path of the first one does not answer. Both hosts must have it.
    pub paths: u8,
}

/// Polling of the daemon for the next input before it sleeps (`AXON_LINK_POLL`).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum LinkPoll {
    /// Spins for tens of microseconds while this often finds an input.
    #[default]
    Adaptive,
    /// Never sleeps, and keeps one processor busy.
    Always,
    /// Sleeps at once.
    Never,
}

/// The congestion controller of links (`AXON_LINK_CONGESTION`). Each side of a link selects the controller of its
/// output.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Congestion {
    /// `Delay` to private and link-local addresses, `Cubic` to all others.
    #[default]
    Auto,
    /// AXON's own controller. It keeps queues short and ignores random loss, as radio links require.
    Delay,
    /// CUBIC (RFC 9438), which most of the Internet uses.
    Cubic,
    /// BBR, as the QUIC library implements it.
    Bbr,
}

/// Compression of samples for other hosts (`AXON_LINK_COMPRESSION`). Each daemon decides for its own output.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum LinkCompression {
    /// Compresses samples of 1 KiB to 8 MiB with zstd while the link is the bottleneck and compression takes at most
    /// 0.3 of the sample's sending time.
    #[default]
    Auto,
    /// Compresses no samples.
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
            paths: 1,
        }
    }
}
