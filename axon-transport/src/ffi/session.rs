//! The C functions of sessions and their options.

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

/// The domain in `ROS_DOMAIN_ID`, or 0 if that is not set.
pub const AXON_DOMAIN_ENVIRONMENT: u32 = 0xffff_ffff;

/// The discovery range in `ROS_AUTOMATIC_DISCOVERY_RANGE`, `ROS_STATIC_PEERS` and `ROS_LOCALHOST_ONLY`.
pub const AXON_DISCOVERY_ENVIRONMENT: u32 = 0;
/// No discovery: the session reaches only its own endpoints. Static peers are ignored.
pub const AXON_DISCOVERY_OFF: u32 = 1;
/// This host. Another host is reached if either of the two lists the other as a static peer.
pub const AXON_DISCOVERY_LOCALHOST: u32 = 2;
/// The hosts that multicast reaches, and the static peers.
pub const AXON_DISCOVERY_SUBNET: u32 = 3;
/// The hosts that multicast reaches. The list of static peers is ignored.
pub const AXON_DISCOVERY_SYSTEM_DEFAULT: u32 = 4;

/// `AXON_SECURITY_MODE` is `classic` and `AXON_CLASSIC_AUTH` is `none`: any host that answers is accepted as
/// a peer.
pub const AXON_AUTHENTICATION_NONE: u32 = 0;
/// `classic` and `pinned`: a peer proves a key of the trust file.
pub const AXON_AUTHENTICATION_PINNED: u32 = 1;
/// `classic` and `ca`: a peer proves a certificate of the CA.
pub const AXON_AUTHENTICATION_CA: u32 = 2;
/// `qkd`: a peer proves a key that the KMEs gave to both hosts.
pub const AXON_AUTHENTICATION_QKD: u32 = 3;

/// The options of a session. Fill them in with `axon_session_options_init`, then change individual fields.
/// The environment and `axon.toml` give all other settings.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct axon_session_options_t {
    /// The interface version that the program was compiled against.
    pub abi: u32,
    /// 0 to 232, or AXON_DOMAIN_ENVIRONMENT.
    pub domain: u32,
    /// AXON_DISCOVERY_*: the discovery range of the session. It does not depend on the process that started
    /// the daemon.
    pub discovery: u32,
    /// Must be 0.
    pub reserved: u32,
    /// Addresses or host names of other hosts, for any discovery but AXON_DISCOVERY_ENVIRONMENT.
    pub static_peers: *const *const c_char,
    /// The number of static peers.
    pub static_peer_count: usize,
    /// The name of the session in tools; null or empty for the program's name.
    pub name: *const c_char,
    /// The path of the daemon's program, used if `AXON_DAEMON_PATH` is not set. The daemon's folder may hold
    /// an `axon.toml`, which is read. Null selects `axon_daemon`, else `axon`, in the first of these folders
    /// that has one: the folder of this program, that of the library, those in `PATH`, and the folder where
    /// cargo installs programs.
    pub daemon_path: *const c_char,
    /// The file with the permissions of an SROS2 enclave, `permissions.p7s` or `permissions.xml`. The session
    /// refuses to create an endpoint that the permissions do not allow (AXON_RET_DENIED). The signature of
    /// the file is not verified. Null means no limit. A library that was built without the feature `sros2`
    /// accepts only null.
    pub permissions_path: *const c_char,
    /// The enclave, for instance `/robot/arm`. It must not be null if `permissions_path` is set.
    pub enclave: *const c_char,
}

/// Fills in options with the defaults. `abi` is the program's AXON_SESSION_ABI. AXON_RET_ABI: the library has
/// another version; the call has written nothing.
///
/// # Safety
/// `options` points to room for options as the program's header declares them.
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
        // SAFETY: guaranteed by the caller.
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

/// Checks the settings as `axon_session_open` does, without opening a session.
///
/// AXON_RET_CONFIG: a setting is wrong. The text of the error names the variable, the value, and the accepted
/// values.
///
/// # Safety
/// As for `axon_session_open`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_options_check(
    options: *const axon_session_options_t,
) -> axon_ret_t {
    guarded(|| {
        // SAFETY: guaranteed by the caller.
        unsafe { settings(options) }.map(drop)
    })
}

/// Stores how a session with these options authenticates other hosts: AXON_AUTHENTICATION_*, according to the
/// environment and `axon.toml`. Opens no session.
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
        // SAFETY: guaranteed by the caller.
        let (config, _) = unsafe { settings(options) }?;
        let of = match &config.security {
            Security::Classic(classic) => match classic.auth {
                ClassicAuth::None => AXON_AUTHENTICATION_NONE,
                ClassicAuth::Pinned => AXON_AUTHENTICATION_PINNED,
                ClassicAuth::Ca => AXON_AUTHENTICATION_CA,
            },
            Security::Qkd(_) => AXON_AUTHENTICATION_QKD,
        };
        // SAFETY: guaranteed by the caller.
        unsafe { store(authentication, of, "the place of the authentication") }
    })
}

/// Opens a session. Starts a daemon if none runs and `AXON_DAEMON` permits it. A process may have any number
/// of sessions.
///
/// Blocks until the daemon answers: for milliseconds, or up to 20 s if the call starts a daemon.
///
/// AXON_RET_CONFIG: a setting is wrong, or the running daemon has other security settings; the text names the
/// variable. AXON_RET_CONFIG also means that the permissions cannot be read, are not valid now, or allow
/// nothing in the session's domain; the text names the file. AXON_RET_ERROR: no daemon runs and none can be
/// started, or the daemon does not answer. AXON_RET_BAD_ALLOC: shared memory is short.
///
/// # Safety
/// `options` points to options that `axon_session_options_init` filled in. Each of their pointers is null or
/// points to valid data. `session` points to room for a handle.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn axon_session_open(
    options: *const axon_session_options_t,
    session: *mut axon_session_t,
) -> axon_ret_t {
    guarded(|| {
        present(session, "the place of the session")?;
        // SAFETY: guaranteed by the caller.
        let (config, options) = unsafe { settings(options) }?;
        let opened = Session::open(&config, options)?;
        // SAFETY: guaranteed by the caller.
        unsafe { give(opened, session) }
    })
}

/// # Safety
/// As for [`axon_session_open`].
unsafe fn settings(
    options: *const axon_session_options_t,
) -> Result<(Config, SessionOptions), CallFailure> {
    // SAFETY: guaranteed by the caller. All versions of the options begin with their version number.
    check_abi(unsafe { value(options.cast::<u32>(), "the pointer to the options") }?)?;
    // SAFETY: guaranteed by the caller, which has this version of the options.
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
        // SAFETY: guaranteed by the caller.
        let peers = unsafe { elements(peers, count, "the list of static peers") }?;
        let mut texts = Vec::with_capacity(peers.len());
        for peer in peers {
            // SAFETY: guaranteed by the caller.
            texts.push(unsafe { text(*peer, "a static peer") }?);
        }
        overrides.push(("ROS_LOCALHOST_ONLY", None));
        overrides.push(("ROS_AUTOMATIC_DISCOVERY_RANGE", Some(range.into())));
        overrides.push(("ROS_STATIC_PEERS", Some(texts.join(";").into())));
    }
    let daemon = if options.daemon_path.is_null() {
        None
    } else {
        // SAFETY: guaranteed by the caller.
        Some(PathBuf::from(unsafe { text(options.daemon_path, "the daemon's path") }?))
    };
    let config = Config::from_env_with(overrides, daemon.as_deref())
        .map_err(|error| CallFailure::new(AXON_RET_CONFIG, error))?;
    let name = if options.name.is_null() {
        ""
    } else {
        // SAFETY: guaranteed by the caller.
        unsafe { text(options.name, "the session's name") }?
    };
    let mut open = SessionOptions::new(if name.is_empty() { own_name() } else { name.to_owned() });
    if let Some(program) = daemon {
        open = open.daemon_command(DaemonCommand { program, arguments: Vec::new() });
    }
    if !options.permissions_path.is_null() {
        // SAFETY: guaranteed by the caller.
        let path = unsafe { text(options.permissions_path, "the path of the permissions") }?;
        // SAFETY: guaranteed by the caller.
        let enclave = unsafe { text(options.enclave, "the enclave") }?;
        open = limit(open, &config, path, enclave)?;
    }
    Ok((config, open))
}

/// Limits a session to the permissions of an enclave.
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

/// Refuses the session, because this build cannot check permissions.
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

/// Destroys the handle of a session. The session ends when its last node, endpoint and event is destroyed and
/// the last call that uses one of them returns. That call blocks for milliseconds while the session's thread
/// ends.
#[unsafe(no_mangle)]
pub extern "C" fn axon_session_close(session: axon_session_t) -> axon_ret_t {
    guarded(|| revoke(session).map(drop))
}

/// Stores the domain of the session.
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
        // SAFETY: guaranteed by the caller.
        unsafe { store(domain, of, "the place of the domain") }
    })
}

/// Stores 1 if the session is connected to a daemon, else 0. A session is not connected after its daemon has
/// died, until another daemon takes over. If `AXON_DAEMON` is `off`, the result is always 1. Data flows
/// between attached endpoints in both cases.
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
        // SAFETY: guaranteed by the caller.
        unsafe { store(connected, u8::from(is), "the place of the answer") }
    })
}
