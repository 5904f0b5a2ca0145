//! Sessions.

use std::{ffi::OsString, os::raw::c_char, path::PathBuf};

use super::{
    AXON_SESSION_ABI,
    error::{AXON_RET_ABI, AXON_RET_CONFIG, CallFailure, axon_ret_t},
    guarded,
    handles::{axon_session_t, give, named, revoke},
    memory::{elements, present, store, text, value},
};
use crate::{
    config::{ClassicAuth, Config, DaemonPolicy, Security},
    session::{DaemonCommand, Session, SessionOptions},
};

/// The domain is what `ROS_DOMAIN_ID` says, else 0.
pub const AXON_DOMAIN_ENVIRONMENT: u32 = 0xffff_ffff;

/// Discovery reaches as far as `ROS_AUTOMATIC_DISCOVERY_RANGE`, `ROS_STATIC_PEERS` and
/// `ROS_LOCALHOST_ONLY` say.
pub const AXON_DISCOVERY_ENVIRONMENT: u32 = 0;
/// Nowhere: the session reaches its own endpoints alone, static peers or not.
pub const AXON_DISCOVERY_OFF: u32 = 1;
/// This host, and other hosts of which either side lists the other as a static peer.
pub const AXON_DISCOVERY_LOCALHOST: u32 = 2;
/// What multicast reaches, and static peers.
pub const AXON_DISCOVERY_SUBNET: u32 = 3;
/// What multicast reaches; the list is passed over.
pub const AXON_DISCOVERY_SYSTEM_DEFAULT: u32 = 4;

/// `AXON_SECURITY_MODE` is `classic` and `AXON_CLASSIC_AUTH` is `none`: any host that answers is a peer.
pub const AXON_AUTHENTICATION_NONE: u32 = 0;
/// `classic` and `pinned`: a peer has a key of the trust file.
pub const AXON_AUTHENTICATION_PINNED: u32 = 1;
/// `classic` and `ca`: a peer has a certificate of the CA.
pub const AXON_AUTHENTICATION_CA: u32 = 2;
/// `qkd`: a peer has a key that the KMEs gave to both.
pub const AXON_AUTHENTICATION_QKD: u32 = 3;

/// How a session is opened. `axon_session_options_init` fills it in; what is to be otherwise is
/// changed then. Everything that it does not say, the environment and `axon.toml` do.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct axon_session_options_t {
    /// The interface that the program was compiled against.
    pub abi: u32,
    /// 0 to 232, or AXON_DOMAIN_ENVIRONMENT.
    pub domain: u32,
    /// AXON_DISCOVERY_*: how far the session is discovered, whichever process started the daemon.
    pub discovery: u32,
    /// 0.
    pub reserved: u32,
    /// Addresses or host names of other hosts, for any discovery but AXON_DISCOVERY_ENVIRONMENT.
    pub static_peers: *const *const c_char,
    /// How many there are.
    pub static_peer_count: usize,
    /// Shown to people; null or empty: the program's name.
    pub name: *const c_char,
    /// The daemon's program, where `AXON_DAEMON_PATH` names none. An `axon.toml` beside it is read. Null:
    /// `axon_daemon`, else `axon`, in the first of the following folders that has it: this program's own, the
    /// library's, those in `PATH`, and the one where cargo installs programs.
    pub daemon_path: *const c_char,
    /// The file with the permissions of an SROS2 enclave, `permissions.p7s` or `permissions.xml`: the session creates no
    /// endpoint that they do not allow (AXON_RET_DENIED). Their signature is not verified. Null: no limit. A library
    /// that was built without the feature `sros2` takes null alone.
    pub permissions_path: *const c_char,
    /// The enclave, as `/robot/arm`. Not null where `permissions_path` is not.
    pub enclave: *const c_char,
}

/// Fills options in with what is usual. `abi` is the program's AXON_SESSION_ABI: AXON_RET_ABI where
/// the library has another, and nothing is written then.
///
/// # Safety
/// `options` points to room for them, as the program's header declares them.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_options_init(
    options: *mut axon_session_options_t,
    abi: u32,
) -> axon_ret_t {
    guarded(|| {
        check_abi(abi)?;
        let usual = axon_session_options_t {
            abi,
            domain: AXON_DOMAIN_ENVIRONMENT,
            discovery: AXON_DISCOVERY_ENVIRONMENT,
            reserved: 0,
            static_peers: std::ptr::null(),
            static_peer_count: 0,
            name: std::ptr::null(),
            daemon_path: std::ptr::null(),
            permissions_path: std::ptr::null(),
            enclave: std::ptr::null(),
        };
        // SAFETY: the caller's word.
        unsafe { store(options, usual, "the place of the options") }
    })
}

fn check_abi(abi: u32) -> Result<(), CallFailure> {
    if abi == AXON_SESSION_ABI {
        return Ok(());
    }
    let text = format_args!(
        "the program was compiled against version {abi} of the interface, the library has \
         {AXON_SESSION_ABI}: compile it against this library's axon.h"
    );
    Err(CallFailure::new(AXON_RET_ABI, text))
}

/// Checks the settings as `axon_session_open` does, and opens nothing.
///
/// AXON_RET_CONFIG: one is wrong; the text names the variable, what was read, and what is accepted.
///
/// # Safety
/// As for `axon_session_open`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_options_check(
    options: *const axon_session_options_t,
) -> axon_ret_t {
    guarded(|| {
        // SAFETY: the caller's word.
        unsafe { settings(options) }.map(drop)
    })
}

/// How other hosts prove who they are to a session with these options: AXON_AUTHENTICATION_*, as the
/// environment and `axon.toml` say it. Opens nothing.
///
/// AXON_RET_CONFIG: a setting is wrong, as for `axon_session_options_check`.
///
/// # Safety
/// As for `axon_session_open`; `authentication` points to room for a number.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_options_authentication(
    options: *const axon_session_options_t,
    authentication: *mut u32,
) -> axon_ret_t {
    guarded(|| {
        present(authentication, "the place of the authentication")?;
        // SAFETY: the caller's word.
        let (config, _) = unsafe { settings(options) }?;
        let of = match &config.security {
            Security::Classic(classic) => match classic.auth {
                ClassicAuth::None => AXON_AUTHENTICATION_NONE,
                ClassicAuth::Pinned => AXON_AUTHENTICATION_PINNED,
                ClassicAuth::Ca => AXON_AUTHENTICATION_CA,
            },
            Security::Qkd(_) => AXON_AUTHENTICATION_QKD,
        };
        // SAFETY: the caller's word.
        unsafe { store(authentication, of, "the place of the authentication") }
    })
}

/// Opens a session, and starts a daemon where none runs and `AXON_DAEMON` lets it. A process may have
/// any number of them.
///
/// Blocks until the daemon has answered: milliseconds, or up to 20 s where one is started.
///
/// AXON_RET_CONFIG: a setting is wrong, or the daemon that runs has other security settings; the text
/// names the variable. Or the permissions cannot be read, are not valid now, or allow nothing in the
/// session's domain; the text names the file. AXON_RET_ERROR: there is no daemon and none can be
/// started, or it does not answer. AXON_RET_BAD_ALLOC: shared memory is short.
///
/// # Safety
/// `options` points to options that `axon_session_options_init` filled in, whose pointers are null or
/// point to what they say; `session` points to room for a handle.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_open(
    options: *const axon_session_options_t,
    session: *mut axon_session_t,
) -> axon_ret_t {
    guarded(|| {
        present(session, "the place of the session")?;
        // SAFETY: the caller's word.
        let (config, options) = unsafe { settings(options) }?;
        let opened = Session::open(&config, options)?;
        // SAFETY: the caller's word.
        unsafe { give(opened, session) }
    })
}

/// # Safety
/// As for [`axon_session_open`].
unsafe fn settings(
    options: *const axon_session_options_t,
) -> Result<(Config, SessionOptions), CallFailure> {
    // SAFETY: the caller's word. All versions of it begin with their number.
    check_abi(unsafe { value(options.cast::<u32>(), "the pointer to the options") }?)?;
    // SAFETY: the caller's word. The caller has this version.
    let options = unsafe { value(options, "the pointer to the options") }?;
    let mut overrides: Vec<(&'static str, Option<OsString>)> = Vec::new();
    if options.domain != AXON_DOMAIN_ENVIRONMENT {
        overrides.push(("ROS_DOMAIN_ID", Some(options.domain.to_string().into())));
    }
    let range = match options.discovery {
        AXON_DISCOVERY_ENVIRONMENT => None,
        AXON_DISCOVERY_OFF => Some("OFF"),
        AXON_DISCOVERY_LOCALHOST => Some("LOCALHOST"),
        AXON_DISCOVERY_SUBNET => Some("SUBNET"),
        AXON_DISCOVERY_SYSTEM_DEFAULT => Some("SYSTEM_DEFAULT"),
        other => return Err(CallFailure::argument(format_args!("there is no discovery {other}"))),
    };
    if let Some(range) = range {
        let (peers, count) = (options.static_peers, options.static_peer_count);
        // SAFETY: the caller's word.
        let peers = unsafe { elements(peers, count, "the list of static peers") }?;
        let mut texts = Vec::with_capacity(peers.len());
        for peer in peers {
            // SAFETY: the caller's word.
            texts.push(unsafe { text(*peer, "a static peer") }?);
        }
        overrides.push(("ROS_LOCALHOST_ONLY", None));
        overrides.push(("ROS_AUTOMATIC_DISCOVERY_RANGE", Some(range.into())));
        overrides.push(("ROS_STATIC_PEERS", Some(texts.join(";").into())));
    }
    let daemon = if options.daemon_path.is_null() {
        None
    } else {
        // SAFETY: the caller's word.
        Some(PathBuf::from(unsafe { text(options.daemon_path, "the daemon's path") }?))
    };
    let config = Config::from_env_with(overrides, daemon.as_deref())
        .map_err(|error| CallFailure::new(AXON_RET_CONFIG, error))?;
    let name = if options.name.is_null() {
        ""
    } else {
        // SAFETY: the caller's word.
        unsafe { text(options.name, "the session's name") }?
    };
    let mut open = SessionOptions::new(if name.is_empty() { own_name() } else { name.to_owned() });
    if let Some(program) = daemon {
        open = open.daemon_command(DaemonCommand { program, arguments: Vec::new() });
    }
    if !options.permissions_path.is_null() {
        // SAFETY: the caller's word.
        let path = unsafe { text(options.permissions_path, "the path of the permissions") }?;
        // SAFETY: the caller's word.
        let enclave = unsafe { text(options.enclave, "the enclave") }?;
        open = limit(open, &config, path, enclave)?;
    }
    Ok((config, open))
}

/// Limits a session to what an enclave may do.
#[cfg(feature = "sros2")]
fn limit(
    options: SessionOptions,
    config: &Config,
    path: &str,
    enclave: &str,
) -> Result<SessionOptions, CallFailure> {
    let failure = |error| CallFailure::new(AXON_RET_CONFIG, error);
    let permissions = crate::sros2::EnclavePermissions::read(path, enclave).map_err(failure)?;
    permissions.check_domain(config.domain, std::time::SystemTime::now()).map_err(failure)?;
    Ok(options.permissions(permissions))
}

/// Refuses the session: what cannot be judged is not let through.
#[cfg(not(feature = "sros2"))]
fn limit(
    _: SessionOptions,
    _: &Config,
    path: &str,
    _: &str,
) -> Result<SessionOptions, CallFailure> {
    Err(CallFailure::argument(format_args!(
        "{path}: this library reads no permissions: build axon-transport with its feature sros2"
    )))
}

fn own_name() -> String {
    let path = std::env::current_exe().unwrap_or_default();
    path.file_name().map_or_else(String::new, |name| name.to_string_lossy().into_owned())
}

/// Gives a session's handle up. The session ends when the last of its nodes, endpoints and events is
/// destroyed and the last call returns that uses one, which then blocks for milliseconds while its
/// thread ends.
#[unsafe(no_mangle)]
pub extern "C" fn axon_session_close(session: axon_session_t) -> axon_ret_t {
    guarded(|| revoke(session).map(drop))
}

/// The domain that the session is in.
///
/// # Safety
/// `domain` points to room for a number.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_domain(
    session: axon_session_t,
    domain: *mut u32,
) -> axon_ret_t {
    guarded(|| {
        let of = named(session)?.domain();
        // SAFETY: the caller's word.
        unsafe { store(domain, of, "the place of the domain") }
    })
}

/// Whether the session reaches its daemon: 1, or 0 while there is none, as after it died, until
/// another has taken over. Where `AXON_DAEMON` is `off` there is none to reach: 1. What is attached
/// flows on either way.
///
/// # Safety
/// `connected` points to room for a number.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_is_connected(
    session: axon_session_t,
    connected: *mut u8,
) -> axon_ret_t {
    guarded(|| {
        let session = named(session)?;
        let off = session.daemon_policy() == DaemonPolicy::Off;
        let is = off || session.daemon().is_some();
        // SAFETY: the caller's word.
        unsafe { store(connected, u8::from(is), "the place of the answer") }
    })
}
