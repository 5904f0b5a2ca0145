//! Runs the gateway on a separate thread, and starts it again when it fails.

use std::{
    cell::RefCell,
    panic::{AssertUnwindSafe, catch_unwind},
    rc::Rc,
    sync::Arc,
    time::Duration,
};

use rustix::net::{AddressFamily, SocketFlags, SocketType, socketpair};
use tokio::{
    sync::{
        mpsc::{self, error::TrySendError},
        oneshot,
    },
    task::spawn_local,
    time::{sleep, timeout},
};

use super::{
    listen::{InternalPeer, serve},
    plane::ControlPlane,
};
use crate::bridge::{CHANNEL, GatewayParts, ToControl, ToGateway};

/// The function that runs on the gateway's thread.
pub type GatewayEntry = fn(GatewayParts) -> Result<(), String>;

/// Maximum time that the first gateway may take to start.
const START: Duration = Duration::from_secs(10);
/// Maximum time that a gateway may take to say goodbye.
const GOODBYE: Duration = Duration::from_secs(2);
/// Minimum run time of a gateway after which its failure does not lengthen the pause.
const STEADY: Duration = Duration::from_secs(60);

/// A gateway that runs, or ran.
pub(super) struct RunningGateway {
    orders: mpsc::Sender<ToGateway>,
    events: mpsc::Receiver<ToControl>,
    end: oneshot::Receiver<String>,
}

impl RunningGateway {
    /// Starts a gateway.
    pub(super) fn start(
        control: &Rc<RefCell<ControlPlane>>,
        entry: GatewayEntry,
    ) -> std::io::Result<Self> {
        let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
        let (ours, theirs) = socketpair(AddressFamily::UNIX, SocketType::SEQPACKET, flags, None)?;
        let (to_control, events) = mpsc::channel(CHANNEL);
        let (orders, from_control) = mpsc::channel(CHANNEL);
        let (ended, end) = oneshot::channel();
        let parts = {
            let mut control = control.borrow_mut();
            control.gateway = "starting".into();
            GatewayParts {
                config: Arc::clone(&control.config),
                daemon: control.id,
                daemon_key: control.daemon_key.clone(),
                keys: Arc::clone(&control.keys_of_sessions),
                known_peers: Arc::clone(&control.known_peers),
                socket: theirs,
                control: to_control,
                orders: from_control,
            }
        };
        std::thread::Builder::new().name("axon-gateway".into()).spawn(move || {
            let outcome = catch_unwind(AssertUnwindSafe(|| entry(parts)));
            let _ = ended.send(match outcome {
                Ok(Ok(())) => "ended".to_owned(),
                Ok(Err(error)) => error,
                Err(_) => "panicked; the log says where".to_owned(),
            });
        })?;
        spawn_local(serve(control.clone(), ours.into(), InternalPeer::Gateway, None));
        Ok(Self { orders, events, end })
    }

    /// Waits until the gateway has started.
    ///
    /// # Errors
    /// The reason why it has not started.
    pub(super) async fn stands(
        &mut self,
        control: &Rc<RefCell<ControlPlane>>,
    ) -> Result<(), String> {
        let started = async {
            tokio::select! {
                // A gateway that started and has failed since then did start.
                biased;
                event = self.events.recv() => event,
                why = &mut self.end => return Err(why.unwrap_or_else(|_| "ended".into())),
            }
            .ok_or_else(String::new)
        };
        match timeout(START, started).await {
            Ok(Ok(event)) => {
                control.borrow_mut().gateway_says(event);
                Ok(())
            }
            // The gateway closed the channel before it ended: the end has the reason.
            Ok(Err(why)) if why.is_empty() => {
                Err((&mut self.end).await.unwrap_or_else(|_| "ended".into()))
            }
            Ok(Err(why)) => Err(why),
            Err(_) => Err(format!("it did not stand within {} s", START.as_secs())),
        }
    }

    /// Returns the gateway's next message; `Err` with the reason if it has ended.
    pub(super) async fn next(&mut self) -> Result<ToControl, String> {
        match self.events.recv().await {
            Some(event) => Ok(event),
            None => Err((&mut self.end).await.unwrap_or_else(|_| "ended".into())),
        }
    }

    /// Sends an order, unless the gateway is gone or so far behind that the channel is full. Returns whether it was
    /// sent.
    pub(super) fn order(&self, order: ToGateway) -> bool {
        let sent = self.orders.try_send(order);
        if let Err(TrySendError::Full(order)) = &sent {
            tracing::debug!(?order, "the gateway is busy; an order was dropped");
        }
        sent.is_ok()
    }

    /// Makes the gateway say goodbye, and waits for that for a limited time.
    pub(super) async fn end(mut self) {
        let goodbye = async {
            if self.orders.send(ToGateway::Shutdown).await.is_ok() {
                while self.events.recv().await.is_some() {}
                let _ = self.end.await;
            }
        };
        if timeout(GOODBYE, goodbye).await.is_err() {
            tracing::warn!("the gateway did not end in time");
        }
    }
}

/// The pause before a gateway that failed is started again.
#[derive(Debug)]
pub(super) struct RestartPause {
    next: Duration,
    since: std::time::Instant,
}

impl RestartPause {
    pub(super) fn new() -> Self {
        Self { next: Duration::from_millis(200), since: std::time::Instant::now() }
    }

    pub(super) async fn wait(&mut self) {
        if self.since.elapsed() > STEADY {
            *self = Self::new();
        }
        sleep(self.next).await;
        self.next = (self.next * 2).min(Duration::from_secs(10));
        self.since = std::time::Instant::now();
    }
}
