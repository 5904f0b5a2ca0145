//! The reactor: drives the [engine](crate::engine) with sockets, rings, clocks and the KME.
//!
//! One thread does all the work of links. Each pass takes in the ready inputs, lets the engine settle, sends its
//! packets and carries out its effects. The KME client and the compression of samples have a thread each, and files are
//! read and written on others.

mod bind;
mod compressor;
mod control_outbox;
mod inputs;
mod key_reports;
mod kme;
mod pass;
mod poll_rule;
mod qlog;
mod rings;
mod session;
mod shutdown;
mod sockets;
mod timer;

pub(crate) use self::bind::bind_daemon;

use std::{
    path::Path,
    rc::Rc,
    sync::Arc,
    time::{Duration, Instant, SystemTime},
};

use axon_shm::{ids::DaemonId, internal::monotonic};
use axon_transport::config::Security;
use tokio::runtime::{Builder, Runtime};

use self::{
    kme::KmeThread,
    pass::{Reactor, ReactorParts},
    qlog::{LastWrites, QlogFiles},
    rings::ShmRings,
    sockets::Sockets,
};
use crate::{
    bridge::{GatewayParts, ToControl},
    engine::{
        Engine, EngineParts,
        credentials::Credentials,
        links::LinkParts,
        peer::MAX_ROUTES,
        quic::{qlog::Qlogs, transport::endpoint_config},
    },
    error::GatewayError,
    identity,
    keys::Events,
    link::LinkHello,
};

/// Maximum wait, at the end, for tasks on other threads, such as a write to the ledger of used keys.
const LAST_TASKS: Duration = Duration::from_secs(1);

/// Runs the gateway until the control plane shuts it down.
///
/// # Errors
/// [`GatewayError`]: before [`ToControl::Started`] why it cannot start, later that its session was dropped.
pub(crate) fn run(parts: GatewayParts) -> Result<(), GatewayError> {
    let runtime = Builder::new_current_thread().enable_all().build()?;
    let (kme, events) = kme::start(&parts.config)?.unzip();
    let (kme, kme_runtime) =
        kme.map(|KmeThread { kme, used, runtime }| ((kme, used), runtime)).unzip();
    let result = runtime.block_on(serve(parts, kme, events));
    let runtimes: [Option<Runtime>; 2] = [Some(runtime), kme_runtime];
    runtimes.into_iter().flatten().for_each(|runtime| runtime.shutdown_timeout(LAST_TASKS));
    result
}

async fn serve(
    parts: GatewayParts,
    kme: Option<(crate::keys::Kme, crate::keys::UsedKeys)>,
    key_events: Option<Events>,
) -> Result<(), GatewayError> {
    let GatewayParts { config, daemon, daemon_key, keys, known_peers, socket, control, orders } =
        parts;
    let mut hello = LinkHello::new(&config, daemon);
    hello.routes = u32::try_from(MAX_ROUTES).ok();
    let identity = match &config.security {
        Security::Classic(classic) => Some(Arc::new(identity::load(classic, &hello.host)?)),
        Security::Qkd(_) => None,
    };
    if let Some(identity) = &identity {
        identity.host().clone_into(&mut hello.host);
    }
    let sockets = Sockets::bind(&config)?;
    let port = sockets.port();
    let (session, notices) = session::open(socket, &config, known_peers)?;
    let rings = ShmRings::new(session.clone())?;
    let reset = bind::reset_key(config.runtime_dir.as_deref(), config.domain);
    let mut of_session = [0; 12];
    of_session.copy_from_slice(&session.id().0[..12]);
    let (epoch, poll) = (Instant::now(), config.link.poll);
    let qlogs = config.link.qlog.as_deref().and_then(|directory| start_qlog(directory, daemon));
    let (qlogs, last_writes) = qlogs.unzip();
    let engine = Engine::new(EngineParts {
        links: LinkParts {
            credentials: Credentials::new(Arc::clone(&config), identity.clone()),
            hello,
            daemon_key,
            addresses: sockets.addresses(),
            endpoint: Arc::new(endpoint_config(&reset)),
            qlogs: qlogs.map(|files| Rc::new(files) as Rc<dyn Qlogs>),
            epoch,
            wall: Rc::new(SystemTime::now),
            seed: rand::random(),
            config,
        },
        rings: rings.clone(),
        session_keys: keys,
        session: of_session,
        epoch_nanos: monotonic(),
    })?;
    // An error means that the control plane is gone; the channel of orders reports that as well.
    let _ = control.send(ToControl::Started { port }).await;
    let reactor = Reactor::new(ReactorParts {
        engine,
        poll,
        epoch,
        sockets,
        rings,
        session,
        notices,
        control,
        orders,
        kme,
        key_events,
        identity,
    })?;
    let result = reactor.run().await;
    if let Some(last) = last_writes {
        last.wait(LAST_TASKS);
    }
    result
}

/// Opens the files for QUIC's events. If that fails, the daemon starts without them.
fn start_qlog(directory: &Path, daemon: DaemonId) -> Option<(QlogFiles, LastWrites)> {
    let started = QlogFiles::start(directory, daemon);
    started
        .inspect_err(|error| {
            tracing::warn!(directory = %directory.display(), %error,
                "could not start the thread that writes QUIC's events: there are none");
        })
        .ok()
}
