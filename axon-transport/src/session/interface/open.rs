//! Opens and closes sessions: with a daemon, without one, or relayed by one.

use std::sync::{Arc, Once};

use axon_shm::internal::{BlockedSignals, SessionSegment};

use crate::{
    config::{Config, DaemonPolicy},
    ids::SessionId,
    session::{
        control::{ControlThread, FirstPeer, in_process::LocalRegistry},
        daemon::connect::Caller,
        error::SessionError,
        handle::{Handle, Session},
        options::SessionOptions,
        relayed::session_end,
        state::SessionShared,
    },
    session_key::SessionKey,
    wire::session::SessionRole,
};

impl Session {
    /// Opens a session with the daemon of this user and domain. If there is no daemon and `AXON_DAEMON` is `spawn`, it
    /// starts one. Under `off`, endpoints of the session reach only each other.
    ///
    /// # Errors
    /// When the daemon cannot be reached or started, or has other security settings: the error
    /// names the variable.
    pub fn open(config: &Config, mut options: SessionOptions) -> Result<Self, SessionError> {
        warn_of_unknown_variables(config);
        #[cfg(feature = "sros2")]
        crate::session::state::check_domain(config, &options)?;
        options.key = SessionKey::generate().map(Arc::new);
        let id = options.key.as_ref().map_or_else(SessionId::random, |key| key.id());
        if config.daemon == DaemonPolicy::Off {
            let segment = SessionSegment::create(id)?;
            return Ok(Self::of(Self::start(config, options, segment, FirstPeer::Alone)?));
        }
        let reason = if config.shm {
            let segment = SessionSegment::create(id)?;
            let caller = Caller { segment: Some(&segment), ..Caller::new(config, &options, id) };
            match caller.connect() {
                Ok(daemon) => {
                    let start = FirstPeer::Daemon(daemon);
                    return Ok(Self::of(Self::start(config, options, segment, start)?));
                }
                Err(SessionError::NotShared(reason)) => reason,
                Err(error) => return Err(error),
            }
        } else {
            "AXON_SHM is off".to_owned()
        };
        Self::relayed(config, options, id, reason)
    }

    /// Opens a session whose samples pass through the daemon. In this process, a second session represents the
    /// endpoints outside, and a local registry connects the two sessions.
    fn relayed(
        config: &Config,
        options: SessionOptions,
        id: SessionId,
        reason: String,
    ) -> Result<Self, SessionError> {
        tracing::info!(reason, "samples pass through the daemon");
        let caller = Caller { relay: Some(&reason), ..Caller::new(config, &options, id) };
        let connected = caller.connect()?;
        let local_registry = Arc::<LocalRegistry>::default();
        let segment = SessionSegment::create(id)?;
        let start = FirstPeer::LocalRegistry(Arc::clone(&local_registry));
        let mut handle = Self::start(config, options, segment, start)?;
        let outside = SessionOptions::new("relay").role(SessionRole::Gateway);
        let segment = SessionSegment::create(SessionId::random())?;
        let start = FirstPeer::LocalRegistry(Arc::clone(&local_registry));
        let outside = Self::of(Self::start(config, outside, segment, start)?);
        handle.relay = Some(session_end::start(
            Arc::clone(&handle.shared),
            local_registry,
            outside,
            connected,
            reason,
        )?);
        Ok(Self::of(handle))
    }

    pub(super) fn start(
        config: &Config,
        options: SessionOptions,
        segment: Arc<SessionSegment>,
        start: FirstPeer,
    ) -> Result<Handle, SessionError> {
        let system = |what| move |source: std::io::Error| SessionError::System { what, source };
        let shared = SessionShared::new(config.clone(), options, segment)
            .map_err(system("creating an eventfd"))?;
        let shared = Arc::new(shared);
        let control = ControlThread::new(shared.clone(), start)?;
        let blocked = BlockedSignals::all();
        let thread = std::thread::Builder::new()
            .name("axon-ctl".into())
            .spawn(move || control.run())
            .map_err(system("starting the control thread"))?;
        drop(blocked);
        let core = shared.core.clone();
        Ok(Handle { core, shared, thread: Some(thread), relay: None })
    }
}

/// Warns once per process about variables that begin like settings and are none.
fn warn_of_unknown_variables(config: &Config) {
    static SAID: Once = Once::new();
    if let Some(line) = config.unknown_variables() {
        SAID.call_once(|| tracing::warn!("{line}"));
    }
}
