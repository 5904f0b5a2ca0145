//! The record of one peer: its addresses, its beacons, and whether it is linked.

use std::{
    net::{IpAddr, SocketAddr},
    time::Duration,
};

use super::probing::ANSWER_WITHIN;
use crate::discovery::AddressConfidence;

/// Most addresses of one standing that are kept of a peer.
const MOST_SOURCES: usize = 4;
/// A dial that nobody answered for is taken as failed after this.
const DIAL_FORGOTTEN: Duration = Duration::from_secs(30);
/// Dials to one address are at least this far apart.
const DIAL_SPACING: Duration = Duration::from_secs(1);
/// A goodbye this shortly before a link goes down or a dial fails was meant.
const GOODBYE_COUNTS: Duration = Duration::from_secs(10);
const BACKOFF_FIRST: Duration = Duration::from_millis(250);
const BACKOFF_MOST: Duration = Duration::from_secs(8);
/// Where another host may have the id of a linked one, it is dialled again after this.
const DOUBT_AGAIN: Duration = Duration::from_secs(30);
/// Most addresses at which a peer was found that proves nothing.
const MOST_FOUND: usize = 16;

/// An address at which a peer may be, and what was said of it from there.
#[derive(Clone, Debug)]
pub(super) struct DialAddress {
    /// With the port to dial.
    pub(super) address: SocketAddr,
    pub(super) sae: Option<String>,
    pub(super) advertised: Vec<SocketAddr>,
    /// A link with this peer stood there.
    pub(super) proven: bool,
    /// It is at an address that we list, or where another link stood.
    pub(super) known: bool,
    /// The peer answered a probe there.
    pub(super) answered: bool,
    /// It was probed since its latest beacon.
    pub(super) asked: bool,
    /// When it was asked, after a goodbye from there, whether the peer is still there.
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

/// One daemon, by its id.
#[derive(Debug, Default)]
pub(super) struct DaemonRecord {
    /// Where beacons came from: by standing, and the latest first.
    pub(super) sources: Vec<DialAddress>,
    /// A beacon of it was acceptable; later ones that are not may be forged.
    pub(super) compatible: bool,
    /// We list it.
    pub(super) listed: bool,
    /// It is on this host, or spoke to our QUIC port since this daemon looks no further than that.
    pub(super) near: bool,
    /// Where the latest beacon under its id came from.
    pub(super) from: Option<IpAddr>,
    pub(super) last_seen: Duration,
    pub(super) last_answered: Option<Duration>,
    /// Its mismatch was reported.
    pub(super) reported: bool,
    /// A beacon that contradicts what stands was logged.
    pub(super) contradicted: bool,
    /// When it said goodbye while linked or dialled, or was asked whether it is still there.
    pub(super) leaving: Option<Duration>,
    /// When it was still there after a goodbye in its name.
    pub(super) stayed: Option<Duration>,
    pub(super) linked: bool,
    /// The path of its link does not work: it may have other addresses.
    pub(super) cut: bool,
    /// The peer of the link did not prove that the id is its own: another one may have the id.
    pub(super) unproven: Option<UnprovenAddresses>,
    /// One for each standing: a dial to an address where nobody is holds up no better one.
    pub(super) dials: [DialTime; AddressConfidence::COUNT],
}

/// Where the peer of a link is that did not prove its id, and the other addresses where it was found.
#[derive(Debug, Default)]
pub(super) struct UnprovenAddresses(Vec<SocketAddr>);

/// When to dial.
#[derive(Debug, Default)]
pub(super) struct DialTime {
    pub(super) due: Option<Duration>,
    /// Until when an outcome is awaited.
    pub(super) in_flight: Option<Duration>,
    /// The address that was, or is, dialled first.
    pub(super) first: Option<SocketAddr>,
    last: Option<Duration>,
    failures: u32,
}

impl DaemonRecord {
    /// A beacon came from there; or the peer answered there.
    pub(super) fn saw(&mut self, mut source: DialAddress) {
        let mut place = 0;
        if let Some(at) = self.sources.iter().position(|s| s.address == source.address) {
            let known = self.sources.remove(at);
            place = if self.cut { at } else { 0 };
            source.answered |= known.answered;
            source.known |= known.known;
            if known.proven {
                // Who was linked has proven its name; a beacon proves nothing.
                source = DialAddress { proven: true, sae: known.sae, ..source };
            }
        }
        // Who beacons most often is not dialled before the others while a path is cut.
        self.sources.insert(place, source);
        self.order();
    }

    /// A link stands there. It is dialled there first, should the link end.
    pub(super) fn proved(&mut self, address: SocketAddr) {
        for source in &mut self.sources {
            source.proven = source.address == address;
        }
        // One that cannot be dialled has no beacon, and none of its sources a name.
        if let (true, Some(first)) = (self.compatible, self.sources.first())
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

    /// Puts the sources in order again. Those of one standing push out no others.
    pub(super) fn order(&mut self) {
        self.sources.sort_by_key(DialAddress::standing);
        let mut kept = [0; AddressConfidence::COUNT];
        self.sources.retain(|source| {
            let kept = &mut kept[source.standing() as usize];
            *kept += 1;
            *kept <= MOST_SOURCES
        });
    }

    /// Those that were left, as a goodbye said and nobody there denied in time.
    pub(super) fn forget_unanswered(&mut self, now: Duration) {
        let left =
            |source: &DialAddress| source.leaving.is_some_and(|at| at + ANSWER_WITHIN <= now);
        self.sources
            .retain(|source| !left(source) || source.standing() != AddressConfidence::Heard);
    }

    /// The addresses of this standing, the latest first.
    pub(super) fn of(&self, standing: AddressConfidence) -> impl Iterator<Item = &DialAddress> {
        self.sources.iter().filter(move |source| source.standing() == standing)
    }

    /// The addresses of this standing that may be dialled. While a link stands: those where another host may be that has
    /// the id, if its address is known or it answered there; where the link's path is cut, those where the peer answered
    /// since.
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

    /// Whether, besides the linked host, another one that has the id may be at this address, or the linked one itself.
    pub(super) fn may_be_at(&self, source: &DialAddress) -> bool {
        (self.cut && !source.proven) || self.unproven_addresses(source.address)
    }

    /// Whether another host than the linked one may have the id, at this address.
    pub(super) fn unproven_addresses(&self, address: SocketAddr) -> bool {
        self.unproven.as_ref().is_some_and(|unproven| !unproven.0.contains(&address))
    }

    /// A link stands with a peer at this address. `proven`: the id is its own.
    pub(super) fn found(&mut self, address: SocketAddr, proven: bool) {
        let mut unproven = self.unproven.take().unwrap_or_default();
        if !proven {
            unproven.0.retain(|other| *other != address);
            unproven.0.insert(0, address);
            unproven.0.truncate(MOST_FOUND);
            self.unproven = Some(unproven);
        }
    }

    /// Where it is, as far as is known: the best of its addresses.
    pub(super) fn host(&self) -> Option<IpAddr> {
        self.sources.first().map(|source| source.address.ip()).or(self.from)
    }

    /// Whether somebody answered there: what a forged source does not do.
    pub(super) fn has_answered(&self) -> bool {
        self.sources.iter().any(|source| source.proven || source.answered)
    }

    /// The best standing of any of its addresses.
    pub(super) fn standing(&self) -> AddressConfidence {
        self.sources.first().map_or(AddressConfidence::Heard, DialAddress::standing)
    }

    /// Whether a dial to addresses of this standing would make sense.
    pub(super) fn wants_dial(&self, standing: AddressConfidence) -> bool {
        let Some(source) = self.to_dial(standing).next() else { return false };
        let elsewhere =
            |dial: &DialTime| dial.in_flight.is_none() || dial.first != Some(source.address);
        // While a link's path is cut one dial after the other: each would succeed the link.
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

    /// The dial failed; `jitter` is between 0.5 and 1.5.
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

    /// Puts an address behind the others of its standing. Somebody who answers there in the peer's name keeps none of
    /// them out.
    fn put_last(&mut self, address: Option<SocketAddr>) {
        if let Some(at) = self.sources.iter().position(|source| Some(source.address) == address) {
            let source = self.sources.remove(at);
            self.sources.push(source);
            self.order();
        }
    }

    /// The path of its link is cut: where it answered before says nothing any more.
    pub(super) fn ask_anew(&mut self) {
        for source in self.sources.iter_mut().filter(|source| !source.proven) {
            (source.answered, source.asked) = (false, false);
        }
        self.order();
        // The pause before other addresses are tried is for links that stand.
        self.dials.iter_mut().for_each(|dial| dial.due = None);
    }

    /// The peer is linked, or was: nothing is under way.
    pub(super) fn done(&mut self) {
        for dial in &mut self.dials {
            dial.reset();
            dial.in_flight = None;
        }
    }

    /// Whether it said goodbye just now; forgets that it did.
    pub(super) fn left(&mut self, now: Duration) -> bool {
        self.leaving.take().is_some_and(|at| at + GOODBYE_COUNTS >= now)
    }

    /// Whether it was there just now after a goodbye in its name: further ones say nothing.
    pub(super) fn stays(&self, now: Duration) -> bool {
        self.stayed.is_some_and(|at| at + GOODBYE_COUNTS > now)
    }

    /// When it is gone, if it is not heard before.
    pub(super) fn gone_at(&self, lifetime: Duration) -> Duration {
        let silent = self.last_seen + lifetime;
        self.leaving.map_or(silent, |at| silent.min(at + ANSWER_WITHIN))
    }

    /// Nothing would be lost that the next beacon does not bring back.
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

    /// Forgets failures, for a reason to hope; what is in flight stays.
    pub(super) fn reset(&mut self) {
        self.failures = 0;
        self.due = None;
    }
}
