//! A configuration that a program builds, instead of the environment or on top of it.

use std::{fmt::Display, net::IpAddr, path::Path, time::Duration};

use super::{
    ClassicAuth, Config, ConfigError, Congestion, DaemonPolicy, DiscoveryRange, KeyMode,
    LinkCompression, LinkPoll, OsFiles, QkdKex, QkdPeers, QuicCipher, SecurityMode,
    daemon_env::DaemonEnv, names, resolve::resolve, sources::Given, values::method,
};

/// Builds a [`Config`] in code. Each method sets the setting of the same name in `docs/configuration.md`:
/// [`kme_url`](Self::kme_url) is `AXON_KME_URL`, and `kme_url` of `axon.toml`.
///
/// [`Config::builder`] starts from the defaults and reads no environment and no file. [`ConfigBuilder::from_env`]
/// starts from the settings that [`Config::from_env`] would read. [`build`](Self::build) validates all settings
/// together, by the same rules as for the environment. A daemon that a session starts with the configuration gets the
/// same settings.
///
/// ```
/// use axon_transport::{
///     EndpointSpec, Session, SessionOptions,
///     config::{Config, DaemonPolicy},
///     qos::Qos,
/// };
///
/// let config = Config::builder()
///     .domain(7)
///     .ring_buffer_size_mb(16)
///     .daemon_peers(["robot-2", "10.0.0.7:61300"])
///     // Without a daemon, the session reaches only this process.
///     .daemon(DaemonPolicy::Off)
///     .build()?;
/// let session = Session::open(&config, SessionOptions::new("example"))?;
/// let publisher = session.create_publisher(EndpointSpec::new("/t", "T", Qos::default()))?;
/// publisher.publish(b"hello")?;
///
/// // An incomplete set of a mode's settings is an error that names the missing setting.
/// let error = Config::builder().classic_key("/dev/null").build().unwrap_err();
/// assert_eq!(error.variable(), "AXON_CLASSIC_TRUST");
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug, Default)]
#[must_use]
pub struct ConfigBuilder {
    reads_environment: bool,
    given: Given,
    /// The first value that cannot be expressed as a setting.
    refused: Option<ConfigError>,
}

impl Config {
    /// Returns a builder that starts from the defaults. It reads no environment, and no file except those given to it.
    pub fn builder() -> ConfigBuilder {
        ConfigBuilder::default()
    }
}

/// Returns the defaults of `docs/configuration.md`. Reads no environment and no file.
impl Default for Config {
    fn default() -> Self {
        match Self::builder().build() {
            Ok(config) => config,
            Err(error) => unreachable!("the defaults are valid: {error}"),
        }
    }
}

impl ConfigBuilder {
    /// Returns a builder that starts from the environment and the `axon.toml` that [`Config::from_env`] would read.
    /// [`build`](Self::build) reads both. Settings that are given to the builder win.
    pub fn from_env() -> Self {
        Self { reads_environment: true, ..Self::default() }
    }

    /// Validates the settings and returns the configuration.
    ///
    /// # Errors
    /// A setting is wrong, incomplete or without effect; the error names its variable. Files that the settings name
    /// must exist and have the right mode.
    pub fn build(self) -> Result<Config, ConfigError> {
        let Self { reads_environment, given, refused } = self;
        if let Some(error) = refused {
            return Err(error);
        }
        if reads_environment {
            return Config::from_environment(given);
        }
        let set =
            given.iter().filter_map(|(name, text)| Some((name.into(), text.as_ref()?.into())));
        let daemon_env = DaemonEnv::whole(set, None, &OsFiles);
        resolve([], &given, None, &OsFiles, daemon_env)
    }

    /// Returns the names of the settings that were given.
    #[cfg(test)]
    pub(super) fn names(&self) -> Vec<&'static str> {
        self.given.keys().copied().collect()
    }

    fn set(mut self, name: &'static str, text: impl Display) -> Self {
        self.given.insert(name, Some(text.to_string()));
        self
    }

    fn refuse(mut self, name: &'static str, read: &str, accepted: &str) -> Self {
        let error = ConfigError::value(name, read, accepted).at(method(name));
        self.refused.get_or_insert(error);
        self
    }

    fn path(self, name: &'static str, path: impl AsRef<Path>) -> Self {
        match path.as_ref().to_str() {
            Some(path) => self.set(name, path),
            None => self.refuse(name, &path.as_ref().to_string_lossy(), "a path in UTF-8"),
        }
    }

    /// Sets a list. Refuses an entry that could be read as two entries or as something else.
    fn list<T: Display>(self, name: &'static str, entries: impl IntoIterator<Item = T>) -> Self {
        let entries: Vec<String> = entries.into_iter().map(|entry| entry.to_string()).collect();
        let one = |entry: &&String| {
            entry.is_empty()
                || *entry == "*"
                || entry.trim() != **entry
                || entry.contains([';', ','])
        };
        if let Some(entry) = entries.iter().find(one) {
            let accepted = "entries that are not empty and not *, without ; and , and outer spaces";
            return self.refuse(name, entry, accepted);
        }
        self.set(name, entries.join(";"))
    }

    fn seconds(self, name: &'static str, time: Duration) -> Self {
        if time.subsec_nanos() != 0 {
            return self.refuse(name, &format!("{time:?}"), "whole seconds");
        }
        self.set(name, time.as_secs())
    }

    /// Sets how peers authenticate and agree on keys. Default [`Classic`](SecurityMode::Classic).
    pub fn security_mode(self, mode: SecurityMode) -> Self {
        self.set("AXON_SECURITY_MODE", mode.name())
    }

    /// Sets the only cipher that is offered. Default ChaCha20-Poly1305.
    pub fn quic_cipher(self, cipher: QuicCipher) -> Self {
        self.set("AXON_QUIC_CIPHER", cipher.name())
    }

    /// Sets how a peer is identified in `classic`. Default [`Pinned`](ClassicAuth::Pinned) if
    /// [`classic_key`](Self::classic_key) or [`classic_trust`](Self::classic_trust) is given, otherwise
    /// [`None`](ClassicAuth::None).
    pub fn classic_auth(self, auth: ClassicAuth) -> Self {
        self.set("AXON_CLASSIC_AUTH", auth.name())
    }

    /// Sets the file of this host's private key, PKCS#8, mode 0600 or 0400.
    pub fn classic_key(self, file: impl AsRef<Path>) -> Self {
        self.path("AXON_CLASSIC_KEY", file)
    }

    /// Sets the file of pins.
    pub fn classic_trust(self, file: impl AsRef<Path>) -> Self {
        self.path("AXON_CLASSIC_TRUST", file)
    }

    /// Sets the file of roots, for [`Ca`](ClassicAuth::Ca).
    pub fn classic_ca(self, file: impl AsRef<Path>) -> Self {
        self.path("AXON_CLASSIC_CA", file)
    }

    /// Sets the file of this host's certificate chain, for [`Ca`](ClassicAuth::Ca).
    pub fn classic_cert(self, file: impl AsRef<Path>) -> Self {
        self.path("AXON_CLASSIC_CERT", file)
    }

    /// Sets the file of certificate revocation lists, for [`Ca`](ClassicAuth::Ca).
    pub fn classic_crl(self, file: impl AsRef<Path>) -> Self {
        self.path("AXON_CLASSIC_CRL", file)
    }

    /// Sets what KME keys protect. Default [`Messages10`](KeyMode::Messages10).
    pub fn qkd_key_mode(self, mode: KeyMode) -> Self {
        self.set("AXON_QKD_KEY_MODE", mode.name())
    }

    /// Sets the key exchange beside the KME key. Default [`PskKe`](QkdKex::PskKe), no key exchange.
    pub fn qkd_kex(self, kex: QkdKex) -> Self {
        self.set("AXON_QKD_KEX", kex.name())
    }

    /// Sets the SAEs that may be peers. Required in `qkd`.
    pub fn qkd_peers(self, peers: QkdPeers) -> Self {
        const NAME: &str = "AXON_QKD_PEERS";
        match peers {
            QkdPeers::Any => self.set(NAME, "*"),
            QkdPeers::Listed(saes) => self.list(NAME, saes),
        }
    }

    /// Sets the age at which a connection is replaced by one under a new key, in whole seconds up to a day. Default
    /// one hour.
    pub fn qkd_session_max_age(self, age: Duration) -> Self {
        self.seconds("AXON_QKD_SESSION_MAX_AGE", age)
    }

    /// Sets the URL of this host's KME, `https://host[:port][/path]`. Required in `qkd`.
    pub fn kme_url(self, url: impl Into<String>) -> Self {
        self.set("AXON_KME_URL", url.into())
    }

    /// Sets the file of roots for the KME's certificate. Required in `qkd`.
    pub fn kme_ca(self, file: impl AsRef<Path>) -> Self {
        self.path("AXON_KME_CA", file)
    }

    /// Sets the common name that the KME's certificate must also have. By default, the client does not check it.
    pub fn kme_id(self, id: impl Into<String>) -> Self {
        self.set("AXON_KME_ID", id.into())
    }

    /// Sets the deviations of the KME to tolerate, by the names of
    /// [`QkdConfig::KME_QUIRKS`](super::QkdConfig::KME_QUIRKS). Default none.
    pub fn kme_quirks(self, names: impl IntoIterator<Item = impl Into<String>>) -> Self {
        self.list("AXON_KME_QUIRKS", names.into_iter().map(Into::into))
    }

    /// Sets the time that TCP and TLS to the KME may take, 1 to 10 whole seconds. Default 2 s.
    pub fn kme_connect_timeout(self, time: Duration) -> Self {
        self.seconds("AXON_KME_CONNECT_TIMEOUT", time)
    }

    /// Sets the time that a whole call to the KME may take, 1 to 10 whole seconds. Default 3 s.
    pub fn kme_answer_timeout(self, time: Duration) -> Self {
        self.seconds("AXON_KME_ANSWER_TIMEOUT", time)
    }

    /// Sets this host's SAE ID. Required in `qkd`.
    pub fn sae_id(self, id: impl Into<String>) -> Self {
        self.set("AXON_SAE_ID", id.into())
    }

    /// Sets the file of the client certificate for the KME. Required in `qkd`.
    pub fn sae_cert(self, file: impl AsRef<Path>) -> Self {
        self.path("AXON_SAE_CERT", file)
    }

    /// Sets the file of the client certificate's private key, mode 0600 or 0400. Required in `qkd`.
    pub fn sae_key(self, file: impl AsRef<Path>) -> Self {
        self.path("AXON_SAE_KEY", file)
    }

    /// Sets whether a session starts, requires or does not use a daemon. Default [`Spawn`](DaemonPolicy::Spawn).
    pub fn daemon(self, policy: DaemonPolicy) -> Self {
        self.set("AXON_DAEMON", policy.name())
    }

    /// Sets the daemon's program. By default, the session searches for it as `docs/configuration.md` describes.
    pub fn daemon_path(self, program: impl AsRef<Path>) -> Self {
        self.path("AXON_DAEMON_PATH", program)
    }

    /// Sets the absolute path of the directory for the daemon's files and the session socket. Default none: the
    /// daemon then has only an abstract name, and keeps no files.
    pub fn runtime_dir(self, directory: impl AsRef<Path>) -> Self {
        self.path("AXON_RUNTIME_DIR", directory)
    }

    /// Sets the size of a publisher's history, 1 to 65536 MiB. Default 64.
    pub fn ring_buffer_size_mb(self, mib: u64) -> Self {
        self.set("AXON_RING_BUFFER_SIZE_MB", mib)
    }

    /// Sets the size of the largest message, 1 to 4095 MiB. Default 256.
    pub fn max_message_mb(self, mib: u64) -> Self {
        self.set("AXON_MAX_MESSAGE_MB", mib)
    }

    /// Sets the size of the daemon's queue of reliable samples for other hosts, 1 to 65536 MiB. Default 256.
    pub fn reliable_queue_mb(self, mib: u64) -> Self {
        self.set("AXON_RELIABLE_QUEUE_MB", mib)
    }

    /// Sets whether the process shares memory with others. Default true.
    pub fn shm(self, shared: bool) -> Self {
        self.set("AXON_SHM", if shared { "on" } else { "off" })
    }

    /// Sets whether samples of more than 4 KiB are copied when they are taken. Default false.
    pub fn shm_copy(self, copy: bool) -> Self {
        self.set("AXON_SHM_COPY", u8::from(copy))
    }

    /// Sets the other users whose daemon and sessions are trusted. Default none.
    pub fn trusted_uids(self, uids: impl IntoIterator<Item = u32>) -> Self {
        self.list("AXON_TRUSTED_UIDS", uids)
    }

    /// Sets the file of access rules. Default none: everything is allowed.
    pub fn access_file(self, file: impl AsRef<Path>) -> Self {
        self.path("AXON_ACCESS_FILE", file)
    }

    /// Sets the daemon's log filter: levels or `target=level`, separated by commas. Default `warn`.
    pub fn log(self, filter: impl Into<String>) -> Self {
        self.set("AXON_LOG", filter.into())
    }

    /// Sets an `axon.toml` to read. Settings that are given to the builder win over it. Default none from
    /// [`Config::builder`].
    pub fn config(self, file: impl AsRef<Path>) -> Self {
        self.path(names::CONFIG, file)
    }

    /// Sets the local addresses of discovery and links, 1 to 16. Default all.
    pub fn bind_addrs(self, addresses: impl IntoIterator<Item = IpAddr>) -> Self {
        self.list("AXON_BIND_ADDRS", addresses)
    }

    /// Sets the peers to try besides those that discovery finds: `host`, `host:port` or `[IPv6]:port`, up to 64.
    pub fn daemon_peers(self, peers: impl IntoIterator<Item = impl Into<String>>) -> Self {
        self.list("AXON_DAEMON_PEERS", peers.into_iter().map(Into::into))
    }

    /// Sets the addresses to state in beacons, up to 4. Default the addresses of the interfaces.
    pub fn advertise_addrs(self, addresses: impl IntoIterator<Item = IpAddr>) -> Self {
        self.list("AXON_ADVERTISE_ADDRS", addresses)
    }

    /// Sets `ROS_DOMAIN_ID`, 0 to 232. Default 0.
    pub fn domain(self, domain: u32) -> Self {
        self.set("ROS_DOMAIN_ID", domain)
    }

    /// Sets the discovery range of a session (`ROS_AUTOMATIC_DISCOVERY_RANGE`). Default
    /// [`Subnet`](DiscoveryRange::Subnet).
    pub fn discovery_range(mut self, range: DiscoveryRange) -> Self {
        // `ROS_LOCALHOST_ONLY=1` would win over the range.
        self.given.insert("ROS_LOCALHOST_ONLY", None);
        self.set("ROS_AUTOMATIC_DISCOVERY_RANGE", range.name())
    }

    /// Sets the addresses or host names of static peers (`ROS_STATIC_PEERS`), up to 32.
    pub fn static_peers(self, peers: impl IntoIterator<Item = impl Into<String>>) -> Self {
        self.list("ROS_STATIC_PEERS", peers.into_iter().map(Into::into))
    }

    /// Sets the time for which a daemon that a session started outlives its last session, in whole seconds up to a
    /// day. Default 10 s.
    pub fn link_grace(self, time: Duration) -> Self {
        self.seconds("AXON_LINK_GRACE_S", time)
    }

    /// Sets the time after which a peer that reads nothing of a KEEP_ALL topic is disconnected from it, in whole
    /// seconds from 1 s to a day. Default 10 s.
    pub fn link_stalled(self, time: Duration) -> Self {
        self.seconds("AXON_LINK_STALLED_S", time)
    }

    /// Sets the largest UDP payload that path discovery tries, 1200 to 65527 bytes. Default 1452.
    pub fn link_mtu(self, bytes: u16) -> Self {
        self.set("AXON_LINK_MTU", bytes)
    }

    /// Sets the memory for the graph of one peer, 1 to 1024 MiB. Its routes may take four times as much. Default 16.
    pub fn link_graph_mb(self, mib: u64) -> Self {
        self.set("AXON_LINK_GRAPH_MB", mib)
    }

    /// Sets the memory for one peer's samples and calls that this host keeps for its readers and servers, 16 to
    /// 1,048,576 MiB. Default 2,048.
    pub fn link_held_mb(self, mib: u64) -> Self {
        self.set("AXON_LINK_HELD_MB", mib)
    }

    /// Sets whether the daemon polls for the next input before it sleeps. Default [`LinkPoll::Adaptive`].
    pub fn link_poll(self, poll: LinkPoll) -> Self {
        let word = match poll {
            LinkPoll::Adaptive => "adaptive",
            LinkPoll::Always => "always",
            LinkPoll::Never => "never",
        };
        self.set("AXON_LINK_POLL", word)
    }

    /// Sets the absolute path of the directory for QUIC's events, which the daemon writes. Default none.
    pub fn link_qlog(self, directory: impl AsRef<Path>) -> Self {
        self.path("AXON_LINK_QLOG", directory)
    }

    /// Sets the congestion controller of links. Default [`Congestion::Auto`].
    pub fn link_congestion(self, congestion: Congestion) -> Self {
        let word = match congestion {
            Congestion::Auto => "auto",
            Congestion::Delay => "delay",
            Congestion::Cubic => "cubic",
            Congestion::Bbr => "bbr",
        };
        self.set("AXON_LINK_CONGESTION", word)
    }

    /// Sets whether the daemon compresses samples for other hosts. Default [`LinkCompression::Auto`].
    pub fn link_compression(self, compression: LinkCompression) -> Self {
        let word = match compression {
            LinkCompression::Auto => "auto",
            LinkCompression::Never => "never",
        };
        self.set("AXON_LINK_COMPRESSION", word)
    }

    /// Sets the maximum number of links with one peer at a time, each to another address of the peer: 1 or 2. With 2 a
    /// second link stands by, and takes over when the path of the first one does not answer. Both hosts must have it.
    /// Default 1.
    pub fn link_paths(self, paths: u8) -> Self {
        self.set("AXON_LINK_PATHS", paths.to_string())
    }
}
