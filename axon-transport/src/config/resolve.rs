//! Checks which settings may be combined, and sets the defaults.

use std::{
    ffi::OsString,
    path::{Path, PathBuf},
    time::Duration,
};

use super::{
    ClassicAuth, ClassicConfig, Config, ConfigError, Congestion, DaemonPolicy, DiscoveryRange,
    KeyMode, LinkCompression, LinkConfig, LinkPoll, QkdConfig, QkdKex, QkdPeers, QuicCipher,
    Security, SecurityMode,
    daemon_env::DaemonEnv,
    files::Files,
    names, rules_file,
    sources::{Given, SettingSources},
    values::{self, FileUse, Values},
};

const MIB: u64 = 1 << 20;
/// Longest path of a Unix socket on Linux, in bytes, without the terminating zero.
const LONGEST_SOCKET_PATH: usize = 107;
/// Maximum number of static peers, as in rcl.
const MOST_ROS_PEERS: usize = 32;
/// Maximum value of `[link] paths`.
const MAX_PATHS: u8 = 2;

pub(super) fn resolve(
    env: impl IntoIterator<Item = (OsString, OsString)>,
    given: &Given,
    default_file: Option<&Path>,
    files: &impl Files,
    daemon_env: DaemonEnv,
) -> Result<Config, ConfigError> {
    let mut sources = SettingSources::collect(env, given, default_file, files)?;
    let modes = [SecurityMode::Classic, SecurityMode::Qkd].map(|mode| (mode.name(), mode));
    let mode = Values { sources: &sources, files }.choice("AXON_SECURITY_MODE", &modes)?;
    let mode = match mode {
        Some(mode) => mode,
        // The user who wrote the section expects it to apply.
        None if sources.has_qkd() => {
            let accepted = "classic or qkd: a file with a section [qkd] needs security_mode";
            return Err(ConfigError::missing("AXON_SECURITY_MODE", accepted));
        }
        None => SecurityMode::Classic,
    };
    if mode == SecurityMode::Qkd {
        sources.enter_qkd();
    }
    let values = Values { sources: &sources, files };

    let security = match mode {
        SecurityMode::Classic => {
            refuse_all(&values, names::QKD_ONLY, "qkd")?;
            Security::Classic(classic(&values)?)
        }
        SecurityMode::Qkd => {
            refuse_all(&values, names::CLASSIC_ONLY, "classic")?;
            Security::Qkd(qkd(&values)?)
        }
    };
    let (access, access_file) = rules_file::of_settings(&values, &security)?;
    let ciphers = [QuicCipher::ChaCha20Poly1305, QuicCipher::Aes256Gcm].map(|c| (c.name(), c));
    let policies = [DaemonPolicy::Spawn, DaemonPolicy::Require, DaemonPolicy::Off];
    let policies = policies.map(|policy| (policy.name(), policy));
    let domain = domain(&sources)?;
    let (range, static_peers) = range(&sources)?;
    let (runtime_dir, socket_in_runtime_dir) = runtime_dir(&values)?;
    let megabytes = |name: &str, most: u64, default: u64| {
        values.number(name, 1..=most, "MiB").map(|given| given.unwrap_or(default) * MIB)
    };

    let bind_addrs = values.addresses("AXON_BIND_ADDRS", 16)?;
    if values.is_set("AXON_BIND_ADDRS") && bind_addrs.is_empty() {
        // An empty list must not mean all addresses.
        return Err(values.refuse("AXON_BIND_ADDRS", "local addresses; unset it for all of them"));
    }
    Ok(Config {
        security,
        cipher: values.choice("AXON_QUIC_CIPHER", &ciphers)?.unwrap_or_default(),
        domain,
        range,
        static_peers,
        daemon: values.choice("AXON_DAEMON", &policies)?.unwrap_or(DaemonPolicy::Spawn),
        daemon_path: values.file("AXON_DAEMON_PATH", FileUse::Program)?,
        runtime_dir,
        socket_in_runtime_dir,
        bind_addrs,
        daemon_peers: values.peer_addresses("AXON_DAEMON_PEERS")?,
        advertise_addrs: values.addresses("AXON_ADVERTISE_ADDRS", 4)?,
        ring_bytes: megabytes("AXON_RING_BUFFER_SIZE_MB", 65_536, 64)?,
        // Every wire format has a u32 for the length of a message.
        max_message: megabytes("AXON_MAX_MESSAGE_MB", 4_095, 256)?,
        reliable_queue: megabytes("AXON_RELIABLE_QUEUE_MB", 65_536, 256)?,
        shm: values.choice("AXON_SHM", &[("on", true), ("off", false)])?.unwrap_or(true),
        shm_copy: values.choice("AXON_SHM_COPY", &[("0", false), ("1", true)])?.unwrap_or(false),
        trusted_uids: values.uids(names::TRUSTED_UIDS)?,
        access,
        access_file,
        log: values.log_filter("AXON_LOG")?.unwrap_or_else(|| "warn".to_owned()),
        link: link(&values)?,
        topics: sources.topics.clone(),
        daemon_env,
        unknown_variables: sources.strangers.clone(),
    })
}

/// Refuses settings of the other mode. They would have no effect, but the user expects a protection from
/// them.
fn refuse_all(
    values: &Values<'_, impl Files>,
    settings: &[&str],
    mode: &str,
) -> Result<(), ConfigError> {
    match settings.iter().find(|name| values.is_set(name)) {
        None => Ok(()),
        Some(name) => Err(values.refuse(
            name,
            format!("this setting with AXON_SECURITY_MODE={mode} only; set that, or remove this"),
        )),
    }
}

fn required<T>(value: Option<T>, name: &str, accepted: &str) -> Result<T, ConfigError> {
    value.ok_or_else(|| ConfigError::missing(name, accepted))
}

fn classic(values: &Values<'_, impl Files>) -> Result<ClassicConfig, ConfigError> {
    const KEY: &str = "AXON_CLASSIC_KEY";
    const TRUST: &str = "AXON_CLASSIC_TRUST";
    const CA: &str = "AXON_CLASSIC_CA";
    const CERT: &str = "AXON_CLASSIC_CERT";
    const CRL: &str = "AXON_CLASSIC_CRL";

    let auths =
        [("none", ClassicAuth::None), ("pinned", ClassicAuth::Pinned), ("ca", ClassicAuth::Ca)];
    let given = values.choice("AXON_CLASSIC_AUTH", &auths)?;
    let of_ca = [CA, CERT, CRL].into_iter().find(|name| values.is_set(name));
    let auth = match given {
        Some(auth) => auth,
        None => match of_ca {
            Some(name) => {
                let with = "this setting with AXON_CLASSIC_AUTH=ca only; set that, or remove this";
                return Err(values.refuse(name, with));
            }
            None if values.is_set(KEY) || values.is_set(TRUST) => ClassicAuth::Pinned,
            None => ClassicAuth::None,
        },
    };
    let (needed, unused): (&[&str], &[&str]) = match auth {
        ClassicAuth::None => (&[], &[KEY, TRUST, CA, CERT, CRL]),
        ClassicAuth::Pinned => (&[KEY, TRUST], &[CA, CERT, CRL]),
        ClassicAuth::Ca => (&[CA, CERT, KEY], &[TRUST]),
    };
    let name_of = |auth| auths.iter().find(|(_, a)| *a == auth).map_or("", |(name, _)| *name);
    if let Some(name) = unused.iter().find(|name| values.is_set(name)) {
        return Err(values.refuse(
            name,
            format!(
                "nothing, AXON_CLASSIC_AUTH={} makes no use of it; remove one of the two",
                name_of(auth)
            ),
        ));
    }
    if let Some(name) = needed.iter().find(|name| !values.is_set(name)) {
        return Err(ConfigError::missing(
            name,
            format!(
                "the path of a file; AXON_CLASSIC_AUTH={} needs {}",
                name_of(auth),
                needed.join(" and ")
            ),
        ));
    }
    Ok(ClassicConfig {
        auth,
        key: values.file(KEY, FileUse::Secret)?,
        trust: values.file(TRUST, FileUse::Public)?,
        ca: values.file(CA, FileUse::Public)?,
        cert: values.file(CERT, FileUse::Public)?,
        crl: values.file(CRL, FileUse::Public)?,
    })
}

fn qkd(values: &Values<'_, impl Files>) -> Result<QkdConfig, ConfigError> {
    let key_modes = [("messages10", KeyMode::Messages10), ("session", KeyMode::Session)];
    let kexes = [QkdKex::PskKe, QkdKex::PskDheKe].map(|kex| (kex.name(), kex));
    let file = |name: &str, usage: FileUse| {
        let path = values.file(name, usage)?;
        required(path, name, "the path of a file; AXON_SECURITY_MODE=qkd needs it")
    };

    let sae_id = values.sae_id("AXON_SAE_ID")?;
    let sae_id = required(sae_id, "AXON_SAE_ID", "this host's SAE ID, as its KME knows it")?;
    let peers = required(
        values.qkd_peers("AXON_QKD_PEERS")?,
        "AXON_QKD_PEERS",
        "the SAE IDs of the peers separated by ;, or * for every SAE that the KME knows",
    )?;
    if matches!(&peers, QkdPeers::Listed(_)) && peers.allows(&sae_id) {
        let accepted = format!("SAE IDs of others; {sae_id} is this host's own, remove it");
        return Err(values.refuse("AXON_QKD_PEERS", accepted));
    }
    let max_age = values.number("AXON_QKD_SESSION_MAX_AGE", 1..=86_400, "seconds")?;
    let (kme_connect_timeout, kme_answer_timeout) = kme_timeouts(values)?;
    let kme_id = values.kme_id("AXON_KME_ID")?;
    let kme_quirks = values.quirks("AXON_KME_QUIRKS")?;
    if kme_id.is_none() && kme_quirks.iter().any(|quirk| quirk == QkdConfig::NO_NAME_CHECK) {
        let accepted = "no-name-check with AXON_KME_ID only: without it any certificate of AXON_KME_CA \
                        would do; set that, or remove this";
        return Err(values.refuse("AXON_KME_QUIRKS", accepted));
    }
    Ok(QkdConfig {
        key_mode: values.choice("AXON_QKD_KEY_MODE", &key_modes)?.unwrap_or(KeyMode::Messages10),
        kex: values.choice("AXON_QKD_KEX", &kexes)?.unwrap_or_default(),
        peers,
        session_max_age: Duration::from_secs(max_age.unwrap_or(3_600)),
        kme_url: required(
            values.kme_url("AXON_KME_URL")?,
            "AXON_KME_URL",
            "https://host:port of this host's KME",
        )?,
        kme_ca: file("AXON_KME_CA", FileUse::Public)?,
        kme_id,
        sae_id,
        sae_cert: file("AXON_SAE_CERT", FileUse::Public)?,
        sae_key: file("AXON_SAE_KEY", FileUse::Secret)?,
        kme_quirks,
        kme_connect_timeout,
        kme_answer_timeout,
    })
}

/// Returns the time limits for a connection to the KME and for a whole call.
fn kme_timeouts(values: &Values<'_, impl Files>) -> Result<(Duration, Duration), ConfigError> {
    const CONNECT: &str = "AXON_KME_CONNECT_TIMEOUT";
    const ANSWER: &str = "AXON_KME_ANSWER_TIMEOUT";
    let connect = values.number(CONNECT, 1..=10, "seconds")?;
    let answer = values.number(ANSWER, 1..=10, "seconds")?.unwrap_or(3);
    // An answer timeout of 1 s also lowers the default of the connect timeout.
    let connect = connect.unwrap_or(answer.min(2));
    if connect > answer {
        let accepted = format!(
            "at most {answer} (seconds): a call may take that long with its connection, \
             {ANSWER}"
        );
        return Err(values.refuse(CONNECT, accepted));
    }
    Ok((Duration::from_secs(connect), Duration::from_secs(answer)))
}

pub(super) fn domain(sources: &SettingSources) -> Result<u32, ConfigError> {
    const NAME: &str = "ROS_DOMAIN_ID";
    match sources.foreign.get(NAME).map(String::as_str) {
        None | Some("") => Ok(0),
        Some(text) => match values::decimal(text).and_then(|n| u32::try_from(n).ok()) {
            Some(domain @ 0..=232) => Ok(domain),
            _ => Err(ConfigError::value(NAME, text, "0 to 232")),
        },
    }
}

/// Returns ROS 2's discovery range and static peers, by the rules of rcl. `ROS_LOCALHOST_ONLY=1` wins over
/// the other variables.
fn range(sources: &SettingSources) -> Result<(DiscoveryRange, Vec<String>), ConfigError> {
    const RANGE: &str = "ROS_AUTOMATIC_DISCOVERY_RANGE";
    const PEERS: &str = "ROS_STATIC_PEERS";
    let variable = |name| sources.foreign.get(name).map_or("", String::as_str);

    let peers: Vec<String> =
        variable(PEERS).split(';').filter(|peer| !peer.is_empty()).map(str::to_owned).collect();
    let good =
        |peer: &String| peer.parse::<std::net::IpAddr>().is_ok() || values::is_host_name(peer);
    if peers.len() > MOST_ROS_PEERS || !peers.iter().all(good) {
        let accepted = "at most 32 addresses or host names, without ports, separated by ;";
        return Err(ConfigError::value(PEERS, variable(PEERS), accepted));
    }
    if variable("ROS_LOCALHOST_ONLY") == "1" {
        return Ok((DiscoveryRange::Localhost, Vec::new()));
    }
    match variable(RANGE) {
        "" | "NOT_SET" | "SUBNET" => Ok((DiscoveryRange::Subnet, peers)),
        "LOCALHOST" => Ok((DiscoveryRange::Localhost, peers)),
        "SYSTEM_DEFAULT" => Ok((DiscoveryRange::Subnet, Vec::new())),
        "OFF" => Ok((DiscoveryRange::Off, Vec::new())),
        other => Err(ConfigError::value(RANGE, other, "SUBNET, LOCALHOST, OFF, SYSTEM_DEFAULT")),
    }
}

pub(super) fn runtime_dir(
    values: &Values<'_, impl Files>,
) -> Result<(Option<PathBuf>, bool), ConfigError> {
    const NAME: &str = names::RUNTIME_DIR;
    if let Some(path) = values.directory(NAME)? {
        let socket = path.as_os_str().len() + "/axon-232.sock".len();
        if socket > LONGEST_SOCKET_PATH {
            let longest = LONGEST_SOCKET_PATH - "/axon-232.sock".len();
            let accepted = format!("a path of at most {longest} bytes: a socket is to stand in it");
            return Err(values.refuse(NAME, accepted));
        }
        return Ok((Some(path), true));
    }
    // The XDG specification requires that relative paths are ignored.
    let xdg = values.sources.foreign.get("XDG_RUNTIME_DIR").map(Path::new);
    Ok((xdg.filter(|path| path.is_absolute()).map(|path| path.join("axon")), false))
}

/// The values of `AXON_LINK_POLL`.
const POLL: [(&str, LinkPoll); 3] =
    [("adaptive", LinkPoll::Adaptive), ("always", LinkPoll::Always), ("never", LinkPoll::Never)];

/// Parses `qlog` of the section `[link]`.
fn qlog(
    name: &str,
    value: &toml::Value,
    place: &str,
    files: &impl Files,
) -> Result<PathBuf, ConfigError> {
    let text = value.as_str().unwrap_or_else(|| value.type_str());
    let path = value.as_str().and_then(|text| values::absolute_directory(text, files));
    path.ok_or_else(|| ConfigError::value(name, text, values::DIRECTORY).at(place))
}

/// The values of `AXON_LINK_CONGESTION`.
const CONGESTION: [(&str, Congestion); 4] = [
    ("auto", Congestion::Auto),
    ("delay", Congestion::Delay),
    ("cubic", Congestion::Cubic),
    ("bbr", Congestion::Bbr),
];

/// The values of `AXON_LINK_COMPRESSION`.
pub(super) const COMPRESSION: [(&str, LinkCompression); 2] =
    [("auto", LinkCompression::Auto), ("never", LinkCompression::Never)];

/// Parses one of `words` in the section `[link]`.
fn word<T: Copy>(
    name: &str,
    value: &toml::Value,
    place: &str,
    words: &[(&str, T)],
) -> Result<T, ConfigError> {
    let read = value.as_str().unwrap_or_else(|| value.type_str());
    let accepted = || words.iter().map(|(word, _)| *word).collect::<Vec<_>>().join(", ");
    let known = words.iter().find(|(word, _)| *word == read);
    known
        .map(|(_, value)| *value)
        .ok_or_else(|| ConfigError::value(name, read, accepted()).at(place))
}

fn link(values: &Values<'_, impl Files>) -> Result<LinkConfig, ConfigError> {
    let sources = values.sources;
    let mut link = LinkConfig::default();
    for (key, value) in &sources.link {
        let name = format!("link.{key}");
        let place = sources.file.as_ref().map_or(String::new(), |path| path.display().to_string());
        let number = |low: i64, high: i64, unit: &str| match value {
            toml::Value::Integer(number) if (low..=high).contains(number) => Ok(*number as u64),
            other => {
                let read = other
                    .as_integer()
                    .map_or_else(|| other.type_str().to_owned(), |number| number.to_string());
                Err(ConfigError::value(&name, &read, format!("{low} to {high} ({unit})"))
                    .at(&*place))
            }
        };
        match key.as_str() {
            "grace_s" => link.grace = Duration::from_secs(number(0, 86_400, "seconds")?),
            "stalled_s" => link.stalled = Duration::from_secs(number(1, 86_400, "seconds")?),
            "mtu" => link.mtu = number(1_200, 65_527, "bytes")? as u16,
            "graph_mb" => link.graph = (number(1, 1_024, "MiB")? as usize) << 20,
            "held_mb" => link.held = number(16, 1 << 20, "MiB")? << 20,
            "poll" => link.poll = word(&name, value, &place, &POLL)?,
            "qlog" => link.qlog = Some(qlog(&name, value, &place, values.files)?),
            "congestion" => link.congestion = word(&name, value, &place, &CONGESTION)?,
            "compression" => link.compression = word(&name, value, &place, &COMPRESSION)?,
            "paths" => link.paths = number(1, MAX_PATHS.into(), "paths")? as u8,
            _ => {
                let known = "grace_s, stalled_s, mtu, graph_mb, held_mb, poll, qlog, congestion, compression, paths";
                return Err(ConfigError::name(&name, known).at(place));
            }
        }
    }
    // The variables win over the file.
    if let Some(grace) = values.number("AXON_LINK_GRACE_S", 0..=86_400, "seconds")? {
        link.grace = Duration::from_secs(grace);
    }
    if let Some(stalled) = values.number("AXON_LINK_STALLED_S", 1..=86_400, "seconds")? {
        link.stalled = Duration::from_secs(stalled);
    }
    if let Some(mtu) = values.number("AXON_LINK_MTU", 1_200..=65_527, "bytes")? {
        link.mtu = mtu as u16;
    }
    if let Some(graph) = values.number("AXON_LINK_GRAPH_MB", 1..=1_024, "MiB")? {
        link.graph = (graph as usize) << 20;
    }
    if let Some(held) = values.number("AXON_LINK_HELD_MB", 16..=1 << 20, "MiB")? {
        link.held = held << 20;
    }
    if let Some(poll) = values.choice("AXON_LINK_POLL", &POLL)? {
        link.poll = poll;
    }
    if let Some(qlog) = values.directory(names::QLOG)? {
        link.qlog = Some(qlog);
    }
    if let Some(congestion) = values.choice("AXON_LINK_CONGESTION", &CONGESTION)? {
        link.congestion = congestion;
    }
    if let Some(compression) = values.choice("AXON_LINK_COMPRESSION", &COMPRESSION)? {
        link.compression = compression;
    }
    if let Some(paths) = values.number("AXON_LINK_PATHS", 1..=MAX_PATHS.into(), "paths")? {
        link.paths = paths as u8;
    }
    Ok(link)
}
