//! Links that are silent though their path works again.
//!
//! QUIC doubles its pause after each packet that nobody acknowledges: after an outage of eight seconds a
//! link may stay silent for eight more. A link over which something went out and nothing comes is therefore
//! probed beside QUIC, four times a second. When a probe is answered and the peer still acknowledges
//! nothing, a successor is dialled (`docs/architecture.md`, links).
//!
//! What counts is acknowledgements. A packet that the peer sends of itself does not end our QUIC's pause:
//! what waits here would still wait for it.

use std::{
    collections::HashMap,
    sync::{Arc, Mutex},
    time::{Duration, Instant},
};

use axon_shm::ids::DaemonId;
use quinn::Connection;
use tokio::sync::{mpsc, oneshot};

use super::{endpoint::Endpoints, hub::Event, keyring::lock, socket};
use crate::{link::Side, wire::beacon::Datagram};

/// Between two probes.
const PROBE_EVERY: Duration = Duration::from_millis(250);
/// QUIC is given so long after an answer: a packet of its own may be on its way.
const GRACE: Duration = Duration::from_millis(300);
/// After a long silence QUIC's next packet is as far away as the silence was long.
const LONG: Duration = Duration::from_secs(3);
const GRACE_AFTER_LONG: Duration = Duration::from_millis(100);
/// The side that was dialled waits for so much longer: two successors would be one too many.
const DIALLED: Duration = Duration::from_millis(200);
/// A successor that does not come about is dialled again after this.
const AGAIN: Duration = Duration::from_secs(5);

/// The answers to probes that somebody waits for, by the nonce of the probe.
#[derive(Debug, Default)]
pub(super) struct Echoes(Mutex<HashMap<[u8; 8], oneshot::Sender<()>>>);

impl Echoes {
    /// Takes a datagram that answers a probe. Whether it did.
    pub(super) fn take(&self, datagram: &socket::Datagram) -> bool {
        let mut awaited = lock(&self.0);
        if awaited.is_empty() {
            return false;
        }
        let Ok(Datagram::Echo { nonce, .. }) = Datagram::decode(&datagram.bytes) else {
            return false;
        };
        // An error: nobody waits any more.
        awaited.remove(&nonce).is_some_and(|waits| waits.send(()).is_ok())
    }

    fn await_one(&self, nonce: [u8; 8]) -> oneshot::Receiver<()> {
        let (sender, receiver) = oneshot::channel();
        lock(&self.0).insert(nonce, sender);
        receiver
    }

    fn forget(&self, nonce: [u8; 8]) {
        lock(&self.0).remove(&nonce);
    }
}

/// What went over a connection, as far as silence is concerned.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Traffic {
    /// Datagrams that came.
    came: u64,
    /// Acknowledgements among what came.
    acknowledged: u64,
    /// Frames that were sent and ask for an answer. What QUIC sends by itself to keep the connection, or
    /// to find out how long a packet may be, is not among them.
    asked: u64,
}

impl Traffic {
    pub(super) fn of(connection: &Connection) -> Self {
        let stats = connection.stats();
        let sent = stats.frame_tx;
        let asked = sent.stream
            + sent.datagram
            + sent.reset_stream
            + sent.stop_sending
            + sent.max_data
            + sent.max_stream_data;
        Self { came: stats.udp_rx.datagrams, acknowledged: stats.frame_rx.acks, asked }
    }

    /// Whether the peer acknowledged something since `before`: QUIC repeats at once what it has not got.
    pub(super) fn answered_since(self, before: Self) -> bool {
        self.acknowledged != before.acknowledged
    }

    /// Whether something was asked since `before` and nothing came.
    pub(super) fn is_silent_since(self, before: Self) -> bool {
        self.came == before.came && self.asked > before.asked
    }
}

/// A link to be watched.
pub(super) struct Watch {
    /// Its number at the hub.
    pub(super) number: u64,
    /// The connection.
    pub(super) connection: Connection,
    /// What had gone over it when it was found silent. An answer may have come since.
    pub(super) traffic: Traffic,
    /// Which end this side is.
    pub(super) side: Side,
    /// This daemon.
    pub(super) daemon: DaemonId,
    /// Where probes are sent from.
    pub(super) endpoints: Arc<Endpoints>,
    /// Where answers come.
    pub(super) echoes: Arc<Echoes>,
    /// To the hub.
    pub(super) events: mpsc::Sender<Event>,
}

impl Watch {
    /// Probes until the peer acknowledges something, or the link ends; tells the hub when the path works
    /// and the link stays silent.
    pub(super) async fn run(self) {
        let nonce = rand::random();
        self.probe(nonce).await;
        self.echoes.forget(nonce);
    }

    async fn probe(&self, nonce: [u8; 8]) {
        let began = Instant::now();
        let silent = || {
            let over = self.connection.close_reason().is_some();
            !over && !Traffic::of(&self.connection).answered_since(self.traffic)
        };
        let bytes = Datagram::Probe { daemon: self.daemon, nonce }.encode();
        let mut echo = self.echoes.await_one(nonce);
        while silent() {
            self.endpoints.send(self.connection.remote_address(), &bytes);
            if tokio::time::timeout(PROBE_EVERY, &mut echo).await.is_err() {
                continue;
            }
            let grace = if began.elapsed() < LONG { GRACE } else { GRACE_AFTER_LONG };
            let more = if self.side == Side::Client { Duration::ZERO } else { DIALLED };
            tokio::time::sleep(grace + more).await;
            let silence = Event::Silent(self.number, self.traffic);
            if !silent() || self.events.send(silence).await.is_err() {
                return;
            }
            tokio::time::sleep(AGAIN).await;
            echo = self.echoes.await_one(nonce);
        }
    }
}
