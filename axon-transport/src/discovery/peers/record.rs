//! What is known of one peer.

use std::{net::SocketAddr, time::Duration};

/// Most observed sources kept of a peer: one that others forge cannot push out the true one at once.
const MOST_SOURCES: usize = 4;
/// A dial that nobody answered for is taken as failed after this.
const DIAL_FORGOTTEN: Duration = Duration::from_secs(30);
/// Dials to one peer are at least this far apart.
const DIAL_SPACING: Duration = Duration::from_secs(1);
/// A goodbye this shortly before a link goes down or a dial fails was meant.
const GOODBYE_COUNTS: Duration = Duration::from_secs(10);
const BACKOFF_FIRST: Duration = Duration::from_millis(250);
const BACKOFF_MOST: Duration = Duration::from_secs(8);

/// One daemon, by its id.
#[derive(Debug, Default)]
pub(super) struct Record {
    /// Where beacons came from, the latest first, with the port to dial.
    pub(super) sources: Vec<SocketAddr>,
    /// What its latest beacon advertises.
    pub(super) advertised: Vec<SocketAddr>,
    pub(super) sae: Option<String>,
    /// A beacon of it was acceptable; later ones that are not may be forged.
    pub(super) compatible: bool,
    /// We list it.
    pub(super) listed: bool,
    /// It is on this host, or spoke to our QUIC port since this daemon looks no further than that.
    pub(super) near: bool,
    pub(super) last_seen: Duration,
    pub(super) last_answered: Option<Duration>,
    /// Its mismatch was reported.
    pub(super) reported: bool,
    /// A beacon that contradicts what stands was logged.
    pub(super) contradicted: bool,
    /// When it said goodbye while linked or dialled.
    pub(super) leaving: Option<Duration>,
    pub(super) linked: bool,
    pub(super) dial: Dial,
}

/// When to dial.
#[derive(Debug, Default)]
pub(super) struct Dial {
    pub(super) due: Option<Duration>,
    /// Until when an outcome is awaited.
    pub(super) in_flight: Option<Duration>,
    last: Option<Duration>,
    failures: u32,
}

impl Record {
    pub(super) fn saw(&mut self, source: SocketAddr) {
        self.sources.retain(|known| *known != source);
        self.sources.insert(0, source);
        self.sources.truncate(MOST_SOURCES);
    }

    /// Whether a dial would make sense.
    pub(super) fn wants_dial(&self) -> bool {
        self.compatible && !self.linked && self.dial.in_flight.is_none()
    }

    /// Whether it said goodbye just now; forgets that it did.
    pub(super) fn left(&mut self, now: Duration) -> bool {
        self.leaving.take().is_some_and(|at| at + GOODBYE_COUNTS >= now)
    }

    /// Nothing would be lost that the next beacon does not bring back.
    pub(super) fn may_be_forgotten(&self) -> bool {
        !self.linked && self.dial.in_flight.is_none()
    }
}

impl Dial {
    /// Schedules a dial unless one is scheduled.
    pub(super) fn schedule(&mut self, at: Duration) {
        if self.due.is_none() {
            self.due = Some(self.spaced(at));
        }
    }

    pub(super) fn start(&mut self, now: Duration) {
        self.due = None;
        self.last = Some(now);
        self.in_flight = Some(now + DIAL_FORGOTTEN);
    }

    /// The dial failed; `jitter` is between 0.5 and 1.5.
    pub(super) fn failed(&mut self, now: Duration, jitter: f64) {
        self.in_flight = None;
        let doubled = BACKOFF_FIRST.saturating_mul(1 << self.failures.min(16));
        self.failures = self.failures.saturating_add(1);
        self.due = Some(self.spaced(now + doubled.min(BACKOFF_MOST).mul_f64(jitter)));
    }

    /// Forgets failures, for a reason to hope; what is in flight stays.
    pub(super) fn reset(&mut self) {
        self.failures = 0;
        self.due = None;
    }

    /// The peer is linked: nothing to dial.
    pub(super) fn done(&mut self) {
        self.reset();
        self.in_flight = None;
    }

    fn spaced(&self, at: Duration) -> Duration {
        self.last.map_or(at, |last| at.max(last + DIAL_SPACING))
    }
}
