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
        let silent = || {
            let over = self.connection.close_reason().is_some();
            !over && !Traffic::of(&self.connection).answered_since(self.traffic)
        };
        let bytes = Datagram::Probe { daemon: self.daemon, nonce }.encode();
        let mut echo = None;
        let mut prober = Prober::new(Instant::now(), self.side);
        while silent() {
            match prober.handle_timeout(Instant::now()) {
                Some(Step::Probe) => {
                    echo.get_or_insert_with(|| self.echoes.await_one(nonce));
                    self.endpoints.send(self.connection.remote_address(), &bytes);
                }
                Some(Step::Replace) => {
                    let silence = Event::Silent(self.number, self.traffic);
                    if self.events.send(silence).await.is_err() {
                        return;
                    }
                }
                None => {}
            }
            let due = tokio::time::Instant::from_std(prober.poll_timeout());
            let asked = echo.as_mut().filter(|_| prober.awaits_echo());
            let Some(asked) = asked else {
                tokio::time::sleep_until(due).await;
                continue;
            };
            if let Ok(answer) = tokio::time::timeout_at(due, asked).await {
                echo = None;
                // An error: nobody will answer, and it is not asked for again.
                if answer.is_err() {
                    return;
                }
                prober.handle_echo(Instant::now());
            }
        }
    }
}

/// What to do for a silent link.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Step {
    /// Send a probe.
    Probe,
    /// Dial a successor: the path works.
    Replace,
}

/// Decides when a silent link is probed and when it is replaced. Plain data: its owner calls
/// [`handle_timeout`](Self::handle_timeout) at [`poll_timeout`](Self::poll_timeout), and
/// [`handle_echo`](Self::handle_echo) when a probe is answered.
#[derive(Debug)]
struct Prober {
    began: Instant,
    side: Side,
    next: Step,
    due: Instant,
    /// A probe was sent and not answered.
    asked: bool,
}

impl Prober {
    /// The link was found silent at `now`: a probe is due.
    fn new(now: Instant, side: Side) -> Self {
        Self { began: now, side, next: Step::Probe, due: now, asked: false }
    }

    /// Whether an answer to a probe counts.
    fn awaits_echo(&self) -> bool {
        self.asked
    }

    /// A probe was answered: QUIC is given some time more.
    fn handle_echo(&mut self, now: Instant) {
        let silent = now.saturating_duration_since(self.began);
        let grace = if silent < LONG { GRACE } else { GRACE_AFTER_LONG };
        let more = if self.side == Side::Client { Duration::ZERO } else { DIALLED };
        (self.next, self.due, self.asked) = (Step::Replace, now + grace + more, false);
    }

    /// When to ask again.
    fn poll_timeout(&self) -> Instant {
        self.due
    }

    /// What is due at `now`.
    fn handle_timeout(&mut self, now: Instant) -> Option<Step> {
        if now < self.due {
            return None;
        }
        let step = self.next;
        let pause = if step == Step::Probe { PROBE_EVERY } else { AGAIN };
        (self.next, self.due, self.asked) = (Step::Probe, now + pause, step == Step::Probe);
        Some(step)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ROUND_TRIP: Duration = Duration::from_millis(50);

    /// Cuts the path for `cut` after the link was found silent. How many probes were sent meanwhile, and how
    /// long after the path's return the successor is dialled.
    fn replaced_after(cut: Duration, side: Side) -> (u32, Duration) {
        let start = Instant::now();
        let mut prober = Prober::new(start, side);
        let mut probes = 0;
        let mut echo = None;
        loop {
            let now = match echo {
                Some(at) if at < prober.poll_timeout() => {
                    echo = None;
                    prober.handle_echo(at);
                    continue;
                }
                _ => prober.poll_timeout(),
            };
            match prober.handle_timeout(now) {
                Some(Step::Probe) => {
                    probes += 1;
                    // One that leaves during the cut is lost.
                    if now >= start + cut && echo.is_none() {
                        echo = Some(now + ROUND_TRIP);
                    }
                }
                Some(Step::Replace) => return (probes, now - (start + cut)),
                None => unreachable!("it is due"),
            }
        }
    }

    #[test]
    fn the_side_that_dialled_replaces_a_link_within_400_ms_of_the_paths_return_the_other_within_600()
     {
        for millis in 3_000..12_000 {
            let cut = Duration::from_millis(millis);
            for (side, bound) in [(Side::Client, 400), (Side::Server, 600)] {
                let (probes, after) = replaced_after(cut, side);
                assert!(after <= Duration::from_millis(bound), "{cut:?}, {side:?}: {after:?}");
                // Four a second, and no more.
                assert!(u64::from(probes) <= millis / 250 + 2, "{cut:?}: {probes}");
            }
        }
    }

    #[test]
    fn a_short_silence_gives_quic_time_to_end_it_itself() {
        let (_, after) = replaced_after(Duration::ZERO, Side::Client);
        assert_eq!(after, ROUND_TRIP + GRACE);
        let (_, after) = replaced_after(Duration::ZERO, Side::Server);
        assert_eq!(after, ROUND_TRIP + GRACE + DIALLED);
    }

    #[test]
    fn a_successor_that_does_not_come_about_is_dialled_again() {
        let start = Instant::now();
        let mut prober = Prober::new(start, Side::Client);
        assert!(!prober.awaits_echo(), "nothing was asked");
        assert_eq!(prober.handle_timeout(start), Some(Step::Probe));
        assert!(prober.awaits_echo());
        prober.handle_echo(start + ROUND_TRIP);
        let replaced = prober.poll_timeout();
        assert_eq!(prober.handle_timeout(replaced - Duration::from_millis(1)), None);
        assert_eq!(prober.handle_timeout(replaced), Some(Step::Replace));
        assert_eq!(prober.poll_timeout(), replaced + AGAIN);
        assert!(!prober.awaits_echo(), "an answer that comes twice dials no other one");
        assert_eq!(prober.handle_timeout(replaced + AGAIN), Some(Step::Probe));
    }
}
