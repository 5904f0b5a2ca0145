//! The life of a daemon: from its first system call to its exit status.

use std::{
    cell::RefCell, ffi::OsString, io::Write as _, os::fd::OwnedFd, process::ExitCode, rc::Rc,
    sync::Arc, time::Duration,
};

use axon_shm::internal::{
    close_inherited, descriptors, erase_from_now_on, survive_file_size_limit,
};
use axon_transport::{
    config::{Config, ConfigError, security_settings},
    internal::session::daemon::{
        address::{Address, AddressError, private_directory},
        spawn::{DETACHED, SPAWNED},
    },
};
use rustix::process::{
    DumpableBehavior, Resource, Rlimit, getrlimit, set_dumpable_behavior, setrlimit,
};
use tokio::{
    signal::unix::{SignalKind, signal},
    sync::mpsc,
    task::{LocalSet, spawn_local},
};

use super::{
    daemonize::{Report, detach, start_detached},
    descriptors::SpareDescriptors,
    gateway::GatewayEntry,
    listen::accept,
    log,
    plane::ControlPlane,
    reload::{SettingsSource, reload},
    remote::{DaemonGateway, GATEWAY},
};
use crate::discovery::DiscoveryEvent;

/// Time within which changes of the graph are sent together.
const COALESCE: Duration = Duration::from_millis(5);

/// The way in which a daemon process was started.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Start {
    /// Started by hand or by a service manager: it stays in the foreground until a signal ends it.
    Foreground,
    /// Started by a session (`--spawned`): starts the real daemon and ends.
    Spawned,
    /// Started by the first process (`--detached`): the real daemon.
    Detached,
}

impl Start {
    /// Parses the arguments of a daemon program: none, or the one flag that a session adds to its
    /// [`DaemonCommand`](axon_transport::DaemonCommand). Returns `None` for any others.
    pub fn from_arguments(arguments: impl IntoIterator<Item = OsString>) -> Option<Self> {
        let mut arguments = arguments.into_iter();
        let start = match arguments.next() {
            None => Self::Foreground,
            Some(flag) if flag == SPAWNED => Self::Spawned,
            Some(flag) if flag == DETACHED => Self::Detached,
            Some(_) => return None,
        };
        arguments.next().is_none().then_some(start)
    }
}

/// Minimum time that a daemon waits for its first session.
const FIRST_SESSION: Duration = Duration::from_secs(10);

/// Maximum number of segments that are kept of ended sessions.
const MAX_RETAINED_SEGMENTS: usize = 256;
/// Time within which sessions that lost the previous daemon return: a process may be stopped for a while.
const RETURN: Duration = Duration::from_secs(20);

/// The options of a daemon besides its configuration.
#[derive(Debug)]
pub struct DaemonOptions {
    /// The report to the process that waits for the daemon to be ready.
    report: Report,
    /// The gateway to other hosts. Without one, the daemon serves this host alone.
    gateway: Option<GatewayEntry>,
    stays: bool,
    /// The source of the settings, to read them again.
    settings: Option<SettingsSource>,
}

impl DaemonOptions {
    /// Sets whether the daemon stays when no session needs it. Otherwise, and by default, it ends after its grace time.
    #[must_use]
    pub fn stays(mut self, whether: bool) -> Self {
        self.stays = whether;
        self
    }

    /// Sets another gateway than the real one, for tests.
    #[doc(hidden)]
    #[must_use]
    pub fn gateway(mut self, gateway: GatewayEntry) -> Self {
        self.gateway = Some(gateway);
        self
    }
}

impl Default for DaemonOptions {
    fn default() -> Self {
        Self { report: Report::none(), gateway: GATEWAY, stays: false, settings: None }
    }
}

/// The reason why a daemon does not run.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DaemonError {
    /// A setting, or a file that it names, is wrong.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// Another daemon serves this user and domain.
    #[error("another daemon serves {0} already")]
    Taken(String),
    /// The session socket cannot be used. The text says what is wrong with its address.
    #[error("{0}")]
    Address(String),
    /// The gateway to other hosts did not start.
    #[error("the gateway: {0}")]
    Gateway(String),
    /// A system call failed.
    #[error("{what}: {source}")]
    System {
        /// The operation.
        what: &'static str,
        /// The error of the system.
        source: std::io::Error,
    },
}

/// Runs a whole daemon program: reads the configuration from the environment and the files that it names, detaches if
/// requested, sets up logging (to standard error, which is the log file by then), and runs. A setting or a file that
/// cannot be used ends the program with status 2 before it creates anything. Call it from `main`, before other code
/// opens a file or starts a thread.
pub fn main(start: Start) -> ExitCode {
    survive_file_size_limit();
    let fail = |report: &mut Report, text: &str, status: u8| {
        report.error(text);
        eprint_line(text);
        ExitCode::from(status)
    };
    if start == Start::Spawned {
        close_inherited();
        return match start_detached() {
            Ok(()) => ExitCode::SUCCESS,
            Err(error) => {
                let mut report = Report::from_stdout().unwrap_or(Report::none());
                fail(&mut report, &error.to_string(), 1)
            }
        };
    }
    let detached = start == Start::Detached;
    let mut report = if detached {
        match Report::from_stdout() {
            Ok(report) => report,
            Err(error) => return fail(&mut Report::none(), &error.to_string(), 1),
        }
    } else {
        Report::none()
    };
    // Read before the process leaves the directory in which relative paths begin.
    let settings = SettingsSource::environment();
    let config = match settings.read() {
        Ok(config) => config,
        Err(error) => return fail(&mut report, &error.to_string(), 2),
    };
    // The check reads the private key.
    harden();
    if let Err(error) = crate::check(&config) {
        return fail(&mut report, &error.to_string(), 2);
    }
    if detached && let Err(error) = detach(Some(&config)) {
        return fail(&mut report, &error.to_string(), 1);
    }
    log::start(&config);
    if let Some(line) = config.unknown_variables() {
        tracing::warn!("{line}");
    }
    let settings = Some(settings);
    let options = DaemonOptions { report, stays: !detached, settings, ..DaemonOptions::default() };
    match run(config, options) {
        Ok(()) => ExitCode::SUCCESS,
        // All daemons but one lose the race to start.
        Err(DaemonError::Taken(_)) if detached => ExitCode::SUCCESS,
        Err(error @ DaemonError::Config(_)) => {
            eprint_line(&error.to_string());
            ExitCode::from(2)
        }
        Err(error) => {
            eprint_line(&error.to_string());
            ExitCode::FAILURE
        }
    }
}

/// Runs a daemon on this thread until SIGTERM or SIGINT, or, unless it [stays](DaemonOptions::stays),
/// until no session has needed it for its grace time.
///
/// # Errors
/// When it cannot start. Later errors are logged and shown in its status.
pub fn run(config: Config, mut options: DaemonOptions) -> Result<(), DaemonError> {
    let started = start(config, &options);
    let (control, listeners, _bound) = match started {
        Ok(started) => started,
        Err(error) => {
            match &error {
                DaemonError::Taken(_) => options.report.taken(),
                other => options.report.error(&other.to_string()),
            }
            return Err(error);
        }
    };
    let system = |what| move |source| DaemonError::System { what, source };
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .map_err(system("the control runtime"))?;
    let control = Rc::new(RefCell::new(control));
    let local = LocalSet::new();
    let outcome = local.block_on(&runtime, serve(control.clone(), listeners, options));
    let address = control.borrow().address.clone();
    address.remove();
    // A session that is being served, or a gateway that hangs, does not delay the end.
    runtime.shutdown_background();
    outcome
}

type Started =
    (ControlPlane, Vec<OwnedFd>, axon_transport::internal::session::daemon::address::Lock);

/// Prepares everything before the runtime: the socket first, because it is the lock.
fn start(config: Config, _options: &DaemonOptions) -> Result<Started, DaemonError> {
    erase_from_now_on();
    harden();
    let config = config.with_rules_of_host()?;
    let settings = security_settings(&config)?;
    // Opened before other descriptors take the low numbers.
    let spare = SpareDescriptors::default();
    spare.fill();
    let address = Address::of(&config);
    let (listeners, lock) = match address.bind() {
        Ok(bound) => bound.into_parts(),
        Err(AddressError::Taken) => return Err(DaemonError::Taken(address.to_string())),
        Err(error) => return Err(DaemonError::Address(error.to_string())),
    };
    let mut config = config;
    if let Some(dir) = &config.runtime_dir
        && let Err(error) = private_directory(dir)
    {
        tracing::warn!(%error, "nothing is kept across restarts");
        config.runtime_dir = None;
    }
    Ok((ControlPlane::new(Arc::new(config), settings, spare), listeners, lock))
}

/// Hardens the process, because it holds keys: no core file, no debugger of the same user. Also raises the limit of
/// descriptors: a robot has many sessions with four descriptors each.
fn harden() {
    let refused = |what, error: rustix::io::Errno| tracing::warn!(what, %error, "could not harden the process");
    if let Err(error) = set_dumpable_behavior(DumpableBehavior::NotDumpable) {
        refused("PR_SET_DUMPABLE", error);
    }
    let none = Rlimit { current: Some(0), maximum: Some(0) };
    if let Err(error) = setrlimit(Resource::Core, none) {
        refused("RLIMIT_CORE", error);
    }
    let size = getrlimit(Resource::Fsize);
    if let Err(error) = setrlimit(Resource::Fsize, Rlimit { current: size.maximum, ..size }) {
        refused("RLIMIT_FSIZE", error);
    }
    let files = getrlimit(Resource::Nofile);
    if let Err(error) = setrlimit(Resource::Nofile, Rlimit { current: files.maximum, ..files }) {
        refused("RLIMIT_NOFILE", error);
    }
    if let Some(limit) = getrlimit(Resource::Nofile).current
        && descriptors::is_scarce(limit)
    {
        tracing::warn!(
            limit,
            "few descriptors (RLIMIT_NOFILE): few sessions are served, and one of this user that \
             sends others which are slow to close may hold all of them up"
        );
    }
}

async fn serve(
    control: Rc<RefCell<ControlPlane>>,
    listeners: Vec<OwnedFd>,
    mut options: DaemonOptions,
) -> Result<(), DaemonError> {
    let signals = || {
        let [terminate, interrupt, hangup] =
            [SignalKind::terminate(), SignalKind::interrupt(), SignalKind::hangup()].map(signal);
        Ok((terminate?, interrupt?, hangup?))
    };
    let (mut terminate, mut interrupt, hangup) =
        signals().map_err(|source| DaemonError::System { what: "watching signals", source })?;
    let mut remote = match DaemonGateway::start(&control, options.gateway).await {
        Ok(remote) => remote,
        Err(text) => {
            options.report.error(&format!("the gateway: {text}"));
            return Err(DaemonError::Gateway(text));
        }
    };
    {
        let control = control.borrow();
        tracing::info!(daemon = %control.id, address = %control.address, "the daemon takes sessions");
    }
    let accepting = spawn_local(accept(control.clone(), listeners));
    let flushing = spawn_local(flush(control.clone(), remote.digests()));
    spawn_local(keep_left_memory(control.clone()));
    spawn_local(reload(control.clone(), hangup, options.settings.take()));
    options.report.ready();
    let told = tokio::select! {
        _ = terminate.recv() => Some("SIGTERM"),
        _ = interrupt.recv() => Some("SIGINT"),
        () = unneeded(&control), if !options.stays => None,
        () = remote.run(&control) => None,
    };
    match told {
        Some(signal) => {
            tracing::info!("{signal}: flushing samples queued for other hosts before exit");
            tokio::select! {
                () = remote.finish(&control) => {}
                _ = terminate.recv() => tracing::info!("second SIGTERM: the daemon ends now"),
                _ = interrupt.recv() => tracing::info!("second SIGINT: the daemon ends now"),
            }
        }
        None => tracing::info!("no session needs the daemon any more"),
    }
    // The address is free from here on: a process that connects now starts a new daemon.
    accepting.abort();
    let _ = accepting.await;
    flushing.abort();
    // The task holds a sender, and discovery ends when there is none.
    let _ = flushing.await;
    remote.end().await;
    Ok(())
}

/// Keeps the memory of sessions that end, until its readers have come back from the previous daemon.
async fn keep_left_memory(control: Rc<RefCell<ControlPlane>>) {
    control
        .borrow_mut()
        .registry
        .keep_left_memory(MAX_RETAINED_SEGMENTS.min(descriptors::share() / 4));
    tokio::time::sleep(RETURN).await;
    control.borrow_mut().registry.keep_left_memory(0);
}

/// Sends changes of the graph a moment after they happened, and notifies discovery, whose beacons show whether a peer
/// has missed some.
async fn flush(control: Rc<RefCell<ControlPlane>>, digests: Option<mpsc::Sender<DiscoveryEvent>>) {
    loop {
        if control.borrow().registry.needs_flush() {
            tokio::time::sleep(COALESCE).await;
            let control = &mut *control.borrow_mut();
            control.registry.flush();
            control.settle();
            if let Some(digests) = &digests {
                // The next digest replaces a dropped one.
                let _ = digests.try_send(DiscoveryEvent::GraphDigest(control.registry.digest()));
            }
        }
        let changed = control.borrow().changed.clone();
        changed.notified().await;
    }
}

/// Waits until there was no application for the grace time.
async fn unneeded(control: &Rc<RefCell<ControlPlane>>) {
    let grace = control.borrow().config.link.grace;
    let changed = control.borrow().need.clone();
    // The session that started this daemon has yet to come, however short the grace time is.
    if !control.borrow().is_needed() {
        let first = grace.max(FIRST_SESSION);
        if tokio::time::timeout(first, changed.notified()).await.is_err() {
            return;
        }
    }
    loop {
        if control.borrow().is_needed() {
            changed.notified().await;
        } else if tokio::time::timeout(grace, changed.notified()).await.is_err() {
            return;
        }
    }
}

/// Prints the one line of a program that cannot continue.
fn eprint_line(text: &str) {
    // If it cannot be written, the exit status still shows the failure.
    let _ = writeln!(std::io::stderr(), "axon: {}", text.replace('\n', " "));
}
