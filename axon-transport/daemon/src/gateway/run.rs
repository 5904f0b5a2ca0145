//! Starting the gateway on the calling thread.

use std::{
    net::{Ipv4Addr, SocketAddr},
    sync::{Arc, Mutex},
    time::Duration,
};

use axon_transport::{Session, SessionEvent, SessionOptions, internal::wire::session::SessionRole};
use tokio::sync::mpsc;

use super::{
    accept::{MAX_HANDSHAKES, accept},
    account::Accounts,
    context::Context,
    endpoint::{Endpoints, reset_key},
    error::GatewayError,
    hub::{Event, Hub, Noticed, Shared},
    keyring::Keyring,
    queue_budget::QueueBudget,
    ring_wakeups::RingWakeups,
    shares::Handshakes,
    silence::Echoes,
    stand_in::StandIns,
};
use crate::{
    gateway::bridge::{CHANNEL, GatewayParts, ToControl},
    keys::UsedKeys,
};

/// Worker threads at most: one that carries samples may be deep in an AEAD while another answers.
const WORKERS: usize = 2;
/// Between two looks at the files of the identity: a change is in force within a second.
const LOOK: Duration = Duration::from_millis(250);

/// Runs the gateway until the control plane shuts it down.
///
/// # Errors
/// [`GatewayError`]: before [`ToControl::Started`] why it cannot start, later that its session was
/// dropped.
pub(crate) fn run(parts: GatewayParts) -> Result<(), GatewayError> {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(workers())
        .thread_name("axon-gw")
        .enable_all()
        .build()?;
    runtime.block_on(serve(parts))
}

/// Of two processors a second worker would take the one that the applications have.
fn workers() -> usize {
    let processors = std::thread::available_parallelism().map_or(1, usize::from);
    (processors / 2).clamp(1, WORKERS)
}

async fn serve(parts: GatewayParts) -> Result<(), GatewayError> {
    let GatewayParts { config, daemon, keys, socket, control, mut orders } = parts;
    let used = || UsedKeys::open(config.runtime_dir.as_deref(), config.domain);
    let keyring = Keyring::start(&config, used)?;
    let (keyring, key_events) = match keyring {
        Some((keyring, events)) => (Some(keyring), Some(events)),
        None => (None, None),
    };
    let context = Arc::new(Context::new(Arc::clone(&config), daemon, keyring.clone())?);

    let unspecified = SocketAddr::from((Ipv4Addr::UNSPECIFIED, 0));
    let (server, _) = context.server(unspecified)?;
    let reset = reset_key(config.runtime_dir.as_deref(), config.domain);
    let (datagrams, mut received) = mpsc::channel(CHANNEL);
    let endpoints = Arc::new(Endpoints::bind(&config, &reset, Some(server), &datagrams)?);

    let (events, inbox) = mpsc::channel(CHANNEL);
    let noticed = Arc::new(Noticed::default());
    let session = open_session(socket, &config, Arc::clone(&noticed)).await?;
    let shared = Arc::new(Shared {
        stand_ins: StandIns::default(),
        ring_wakeups: RingWakeups::start(&session)?,
        session,
        domain: config.domain,
        max_message: config.max_message,
        keys,
        accounts: Accounts::new(config.link.graph),
        queues: QueueBudget::new(config.reliable_queue),
        stalled_after: config.link.stalled,
        stalls: Mutex::default(),
    });
    if let (Some(keyring), Some(key_events)) = (keyring, key_events) {
        tokio::spawn(keyring.run(key_events));
    }
    let _ = control.send(ToControl::Started { port: endpoints.port }).await;

    if context.has_files() {
        tokio::spawn(watch_files(Arc::clone(&context), events.clone()));
    }
    let handshakes = Handshakes::new(MAX_HANDSHAKES);
    for endpoint in &endpoints.all {
        let (incomers, mut answered) = mpsc::channel(64);
        tokio::spawn(accept(
            Arc::clone(&context),
            endpoint.clone(),
            Arc::clone(&handshakes),
            incomers,
        ));
        let events = events.clone();
        tokio::spawn(async move {
            while let Some(incomer) = answered.recv().await {
                if events.send(Event::Incomer(incomer)).await.is_err() {
                    return;
                }
            }
        });
    }
    let forward = control.clone();
    let echoes = Arc::<Echoes>::default();
    let answered = Arc::clone(&echoes);
    tokio::spawn(async move {
        while let Some(datagram) = received.recv().await {
            if answered.take(&datagram) {
                continue;
            }
            let notice = ToControl::Datagram { from: datagram.from, bytes: datagram.bytes };
            // A datagram that finds the control plane busy is lost, as datagrams may be.
            let _ = forward.try_send(notice);
        }
    });
    let ordered = events.clone();
    tokio::spawn(async move {
        while let Some(order) = orders.recv().await {
            if ordered.send(Event::Order(order)).await.is_err() {
                return;
            }
        }
        let _ = ordered.send(Event::Order(crate::gateway::bridge::ToGateway::Shutdown)).await;
    });
    let hub = Hub::new(context, endpoints, echoes, shared, control, events);
    if hub.run(inbox, &noticed).await { Ok(()) } else { Err(GatewayError::SessionLost) }
}

/// Looks at the files of the identity until the hub is gone.
async fn watch_files(context: Arc<Context>, events: mpsc::Sender<Event>) {
    let mut looks = tokio::time::interval(LOOK);
    // After a stall: two looks at once would see nothing of a write in between.
    looks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    while !events.is_closed() {
        looks.tick().await;
        let context = Arc::clone(&context);
        // On another thread: a file system can hang.
        let looked = tokio::task::spawn_blocking(move || context.look_at_files()).await;
        if looked.unwrap_or(false) && events.send(Event::Identity).await.is_err() {
            return;
        }
    }
}

/// The gateway's own session; what it notices goes to `noticed`. Opening waits for the control plane, so
/// it must not hold up the runtime.
async fn open_session(
    socket: std::os::fd::OwnedFd,
    config: &Arc<axon_transport::config::Config>,
    noticed: Arc<Noticed>,
) -> Result<Session, GatewayError> {
    let config = Arc::clone(config);
    let opened = tokio::task::spawn_blocking(move || {
        let options = SessionOptions::new("gateway").role(SessionRole::Gateway);
        Session::over(socket, &config, options)
    })
    .await
    .map_err(|e| std::io::Error::other(e.to_string()))?;
    let session = opened?;
    session.set_listener(move |event| match event {
        SessionEvent::Graph => noticed.graph.notify_one(),
        SessionEvent::DaemonLost => noticed.lost.notify_one(),
        _ => {}
    });
    Ok(session)
}
