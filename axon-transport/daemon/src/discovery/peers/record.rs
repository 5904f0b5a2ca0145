//! The record of one peer: its addresses, its beacons, and whether it is linked.

use std::{
    net::{IpAddr, SocketAddr},
    time::Duration,
};

use super::probing::ANSWER_WITHIN;
use crate::discovery::AddressConfidence;

/// Most addresses of one standing in a peer's record.
const MOST_SOURCES: usize = 4;
/// A dial without a reported outcome counts as failed after this time.
const DIAL_FORGOTTEN: Duration = Duration::from_secs(30);
/// Minimum time between dials to one address.
const DIAL_SPACING: Duration = Duration::from_secs(1);
/// A goodbye counts if a link goes down or a dial fails at most this long after it.
const GOODBYE_COUNTS: Duration = Duration::from_secs(10);
const BACKOFF_FIRST: Duration = Duration::from_millis(250);
const BACKOFF_MOST: Duration = Duration::from_secs(8);
/// Pause until the next dial, if another host may have the id of a linked peer.
const DOUBT_AGAIN: Duration = Duration::from_secs(30);
/// Most addresses of a peer that does not prove its id.
const MOST_FOUND: usize = 16;

/// An address at which a peer may be, with the contents of beacons from there.
#[derive(Clone, Debug)]
pub(super) struct DialAddress {
    /// The address, with the port to dial.
    pub(super) address: SocketAddr,
    pub(super) sae: Option<String>,
    pub(super) advertised: Vec<SocketAddr>,
    /// True if a link with this peer was up there.
    pub(super) proven: bool,
    /// True if this host lists the address, or another link was up there.
    pub(super) known: bool,
    /// True if the peer answered a probe there.
    pub(super) answered: bool,
    /// True if it was probed since its latest beacon.
    pub(super) asked: bool,
    /// Time of the probe after a goodbye from there.
    pub(super) leaving: Option<Duration>,
}

impl DialAddress {
    pub(super) fn standing(&self) -> AddressConfidence {
        match (self.proven, self.known, self.answered) {
            (true, _, _) => AddressConfidence::Proven,
            (_, true, true) => AddressConfidence::KnownAnswered,
            (_, true, false) => AddressConfidence::Known,
            (_, false, true) => AddressConfidence::Answered,
            (_, false, false) => AddressConfidence::Heard,
        }
    }
}

/// The record of one daemon id.
#[derive(Debug, Default)]
pub(super) struct DaemonRecord {
    /// The sources of beacons: by standing, and the latest first.
    pub(super) sources: Vec<DialAddress>,
    /// The source that was removed last because another daemon is there: its name, if the peer links from there.
    pub(super) removed: Option<DialAddress>,
    /// True if a beacon of it was acceptable; later unacceptable ones may be forged.
    pub(super) compatible: bool,
    /// True if this host lists it.
    pub(super) listed: bool,
    /// True if it is on this host, or sent to this daemon's QUIC port since the range was last reduced.
    pub(super) near: bool,
    /// Source of the latest beacon under its id.
    pub(super) from: Option<IpAddr>,
    pub(super) last_seen: Duration,
    pub(super) last_answered: Option<Duration>,
    /// True if its mismatch was reported.
    pub(super) reported: bool,
    /// True if a beacon that contradicts the accepted one was logged.
    pub(super) contradicted: bool,
    /// Time of its goodbye while linked or dialled, or of the probe after a goodbye.
    pub(super) leaving: Option<Duration>,
    /// Time at which it answered a probe after a goodbye in its name.
    pub(super) stayed: Option<Duration>,
    pub(super) linked: bool,
    /// Time at which its latest link came up.
    pub(super) linked_at: Duration,
    /// True if the path of its link is cut: the peer may have other addresses.
    pub(super) cut: bool,
    /// Set if the peer of the link did not prove that the id is its own: another host may have the id.
    pub(super) unproven: Option<UnprovenAddresses>,
    /// One entry per standing: a dial to an unused address delays no better one.
    pub(super) dials: [DialTime; AddressConfidence::COUNT],
    pub(super) reported_addresses: ReportedAddresses,
}

/// The address of a linked peer that did not prove its id, and the other addresses where it was found.
#[derive(Debug, Default)]
pub(super) struct UnprovenAddresses(Vec<SocketAddr>);

/// The addresses that the gateway was told of one linked peer.
#[derive(Debug, Default)]
pub(super) struct ReportedAddresses {
    pub(super) addresses: Vec<SocketAddr>,
    pub(super) at: Option<Duration>,
    /// The time of the next report, if the addresses changed too soon after the last one.
    pub(super) due: Option<Duration>,
}

/// The dial schedule of one standing.
#[derive(Debug, Default)]
pub(super) struct DialTime {
    pub(super) due: Option<Duration>,
    /// Time until which the dial's outcome is awaited.
    pub(super) in_flight: Option<Duration>,
    /// The address that was, or is, dialled first.
    pub(super) first: Option<SocketAddr>,
    last: Option<Duration>,
    failures: u32,
}

impl DaemonRecord {
    /// Records a beacon from an address, or the peer's answer from there.
    pub(super) fn saw(&mut self, mut source: DialAddress) {
        let mut place = 0;
        if let Some(at) = self.sources.iter().position(|s| s.address == source.address) {
            let known = self.sources.remove(at);
            place = if self.cut { at } else { 0 };
            source.answered |= known.answered;
            source.known |= known.known;
            if known.proven {
                // A linked peer has proven its name; a beacon proves nothing.
                source = DialAddress { proven: true, sae: known.sae, ..source };
            }
        }
        // While a path is cut, the address with the most beacons is not dialled before the others.
        self.sources.insert(place, source);
        self.order();
    }

    /// Records a link at this address. It is dialled first if the link ends.
    pub(super) fn proved(&mut self, address: SocketAddr) {
        for source in &mut self.sources {
            source.proven = source.address == address;
        }
        // A peer that cannot be dialled has no beacon, and none of its sources has a name.
        let first = self.sources.first().or(self.removed.as_ref());
        if let (true, Some(first)) = (self.compatible, first)
            && !self.sources.iter().any(|source| source.proven)
        {
            let source = DialAddress { address, proven: true, known: true, ..first.clone() };
            self.sources.insert(0, source);
        }
        for source in self.sources.iter_mut().filter(|source| source.address.ip() == address.ip()) {
            source.known = true;
        }
        self.order();
    }

    /// Removes an address at which another daemon is. The address of a link stays, because the link's peer proved that
    /// it is there. The dial times stay, too: a beacon that repeats the address does not end the backoff.
    pub(super) fn is_not_at(&mut self, address: SocketAddr) {
        let linked = self.linked;
        let gone = |s: &mut DialAddress| s.address == address && !(linked && s.proven);
        self.removed = self.sources.extract_if(.., gone).last().or(self.removed.take());
        for source in &mut self.sources {
            source.advertised.retain(|advertised| *advertised != address);
        }
    }

    /// Sorts the sources again. The sources of one standing displace no sources of another.
    pub(super) fn order(&mut self) {
        self.sources.sort_by_key(DialAddress::standing);
        let mut kept = [0; AddressConfidence::COUNT];
        self.sources.retain(|source| {
            let kept = &mut kept[source.standing() as usize];
            *kept += 1;
            *kept <= MOST_SOURCES
        });
    }

    /// Removes addresses whose goodbye was not contradicted by an answer in time, if they are known by beacons alone.
    pub(super) fn forget_unanswered(&mut self, now: Duration) {
        let left =
            |source: &DialAddress| source.leaving.is_some_and(|at| at + ANSWER_WITHIN <= now);
        self.sources
            .retain(|source| !left(source) || source.standing() != AddressConfidence::Heard);
    }

    /// Returns the addresses of this standing, the latest first.
    pub(super) fn of(&self, standing: AddressConfidence) -> impl Iterator<Item = &DialAddress> {
        self.sources.iter().filter(move |source| source.standing() == standing)
    }

    /// Returns the addresses of this standing that may be dialled. While a link is up, these are the addresses where
    /// another host with the same id may be, if the address is known or a daemon answered there. If the link's path is
    /// cut, they also include the addresses where the peer answered since.
    pub(super) fn to_dial(
        &self,
        standing: AddressConfidence,
    ) -> impl Iterator<Item = &DialAddress> {
        self.of(standing).filter(move |source| match self.linked {
            false => true,
            true => {
                let moved = self.cut && source.answered && !source.proven;
                standing != AddressConfidence::Heard
                    && (moved || self.unproven_addresses(source.address))
            }
        })
    }

    /// Returns whether another host with the id, or the linked peer itself, may be at this address in addition to the
    /// link's.
    pub(super) fn may_be_at(&self, source: &DialAddress) -> bool {
        (self.cut && !source.proven) || self.unproven_addresses(source.address)
    }

    /// Returns whether another host than the linked one may have the id, at this address.
    pub(super) fn unproven_addresses(&self, address: SocketAddr) -> bool {
        self.unproven.as_ref().is_some_and(|unproven| !unproven.0.contains(&address))
    }

    /// Records that a link with a peer at this address is up. `proven`: the peer proved its id.
    pub(super) fn found(&mut self, address: SocketAddr, proven: bool) {
        let mut unproven = self.unproven.take().unwrap_or_default();
        if !proven {
            unproven.0.retain(|other| *other != address);
            unproven.0.insert(0, address);
            unproven.0.truncate(MOST_FOUND);
            self.unproven = Some(unproven);
        }
    }

    /// Returns the peer's probable host: that of its best address, or else the source of its latest beacon.
    pub(super) fn host(&self) -> Option<IpAddr> {
        self.sources.first().map(|source| source.address.ip()).or(self.from)
    }

    /// Returns whether the peer answered, or was linked, at one of its addresses. A forged source does not answer.
    pub(super) fn has_answered(&self) -> bool {
        self.sources.iter().any(|source| source.proven || source.answered)
    }

    /// Returns the best standing of its addresses.
    pub(super) fn standing(&self) -> AddressConfidence {
        self.sources.first().map_or(AddressConfidence::Heard, DialAddress::standing)
    }

    /// Returns whether a dial to addresses of this standing makes sense now.
    pub(super) fn wants_dial(&self, standing: AddressConfidence) -> bool {
        let Some(source) = self.to_dial(standing).next() else { return false };
        let elsewhere =
            |dial: &DialTime| dial.in_flight.is_none() || dial.first != Some(source.address);
        // While a link's path is cut, dials run one after the other: each would succeed the link.
        let alone = !self.cut || self.in_flight().next().is_none();
        self.compatible
            && alone
            && self.leaving.is_none()
            && self.dials[standing as usize].in_flight.is_none()
            && self.dials.iter().all(elsewhere)
    }

    pub(super) fn in_flight(&self) -> impl Iterator<Item = (AddressConfidence, &DialTime)> {
        let dials = AddressConfidence::ALL.into_iter().zip(&self.dials);
        dials.filter(|(_, dial)| dial.in_flight.is_some())
    }

    /// Schedules a dial to addresses of this standing unless one is scheduled.
    pub(super) fn schedule(&mut self, standing: AddressConfidence, at: Duration) {
        if self.dials[standing as usize].due.is_none() {
            self.dials[standing as usize].due = Some(self.spaced(standing, at));
        }
    }

    /// Handles a failed dial; `jitter` is between 0.5 and 1.5.
    pub(super) fn failed(&mut self, standing: AddressConfidence, now: Duration, jitter: f64) {
        let dial = &mut self.dials[standing as usize];
        dial.in_flight = None;
        let doubled = BACKOFF_FIRST.saturating_mul(1 << dial.failures.min(16));
        dial.failures = dial.failures.saturating_add(1);
        let first = dial.first;
        if self.cut {
            self.put_last(first);
        }
        let stands = self.linked && !self.cut;
        let pause = if stands { DOUBT_AGAIN } else { doubled.min(BACKOFF_MOST) };
        let at = now + pause.mul_f64(jitter);
        self.dials[standing as usize].due = Some(self.spaced(standing, at));
    }

    fn spaced(&self, standing: AddressConfidence, at: Duration) -> Duration {
        let own = self.dials[standing as usize].last;
        let address = self.of(standing).next().map(|source| source.address);
        let same = self.dials.iter().filter(|dial| dial.first.is_some() && dial.first == address);
        let last = same.filter_map(|dial| dial.last).chain(own).max();
        last.map_or(at, |last| at.max(last + DIAL_SPACING))
    }

    /// Moves an address behind the others of its standing. A host that answers there in the peer's name blocks none of
    /// the others.
    fn put_last(&mut self, address: Option<SocketAddr>) {
        if let Some(at) = self.sources.iter().position(|source| Some(source.address) == address) {
            let source = self.sources.remove(at);
            self.sources.push(source);
            self.order();
        }
    }

    /// Discards earlier answers, because the path of the link is cut and they prove nothing any more.
    pub(super) fn ask_anew(&mut self) {
        for source in self.sources.iter_mut().filter(|source| !source.proven) {
            (source.answered, source.asked) = (false, false);
        }
        self.order();
        // The pause before other addresses are tried is for working links.
        self.dials.iter_mut().for_each(|dial| dial.due = None);
    }

    /// Resets the dials, because the peer is, or was, linked: none is in flight.
    pub(super) fn done(&mut self) {
        for dial in &mut self.dials {
            dial.reset();
            dial.in_flight = None;
        }
    }

    /// Returns whether the peer said goodbye recently, and clears the goodbye.
    pub(super) fn left(&mut self, now: Duration) -> bool {
        self.leaving.take().is_some_and(|at| at + GOODBYE_COUNTS >= now)
    }

    /// Returns whether the peer answered just now after a goodbye in its name. If so, further goodbyes are ignored.
    pub(super) fn stays(&self, now: Duration) -> bool {
        self.stayed.is_some_and(|at| at + GOODBYE_COUNTS > now)
    }

    /// Returns when the peer counts as gone, unless a datagram of it arrives before.
    pub(super) fn gone_at(&self, lifetime: Duration) -> Duration {
        let silent = self.last_seen + lifetime;
        self.leaving.map_or(silent, |at| silent.min(at + ANSWER_WITHIN))
    }

    /// Returns whether the next beacon would restore the whole record.
    pub(super) fn may_be_forgotten(&self) -> bool {
        !self.linked && self.in_flight().next().is_none()
    }
}

impl DialTime {
    pub(super) fn start(&mut self, now: Duration, first: Option<SocketAddr>) {
        self.due = None;
        self.last = Some(now);
        self.first = first;
        self.in_flight = Some(now + DIAL_FORGOTTEN);
    }

    /// Clears the failures, because a dial may succeed now. A dial in flight stays.
    pub(super) fn reset(&mut self) {
        self.failures = 0;
        self.due = None;
    }
}
