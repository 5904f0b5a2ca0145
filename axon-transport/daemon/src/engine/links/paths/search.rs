//! Looks for a second path to a linked peer: probes the peer's other addresses, and selects one that answers.

use std::{net::SocketAddr, time::Duration};

use crate::engine::links::silence::Nonce;

/// Maximum number of addresses that are tried.
const MAX_ADDRESSES: usize = 8;
/// Interval between two rounds of probes, by the time that has passed without a second path: a path that was just lost
/// may return soon.
const INTERVALS: [(Duration, Duration); 2] = [
    (Duration::from_secs(10), Duration::from_millis(250)),
    (Duration::from_secs(60), Duration::from_secs(1)),
];
const LAST_INTERVAL: Duration = Duration::from_secs(5);
/// Pause after the first probe of an address from which no answer ever came. It doubles with each probe: the address may
/// be that of a host that has nothing to do with this one.
const FIRST_PROBE_PAUSE: Duration = Duration::from_millis(250);
const MAX_PROBE_DOUBLINGS: u32 = 10;
/// Pause after the first dial. It doubles with each dial that brings no second path.
const FIRST_DIAL_PAUSE: Duration = Duration::from_secs(2);
const MAX_DIAL_DOUBLINGS: u32 = 6;
/// Additional time before the first round of the side that does not elect: the other side's search is enough.
const SECOND_SIDE: Duration = Duration::from_secs(1);

/// The search for a second path to one peer. A state machine as `docs/architecture.md` describes them.
///
/// Any host can send the beacons from which the addresses are known. So an address costs a probe, a datagram of a few
/// bytes, until the peer's daemon answers there. All dials to the peer together have one budget: an answer proves
/// nothing.
#[derive(Debug)]
pub(in crate::engine::links) struct PathSearch {
    addresses: Vec<PathAddress>,
    /// The address at which a second link stood by last.
    found: Option<SocketAddr>,
    /// The time before the first round of this side.
    head_start: Duration,
    /// The time since which there is no second path.
    since: Duration,
    /// The time of the next round of probes.
    next: Duration,
    /// Number of dials since the last one that brought a second path.
    dials: u32,
    /// The address that answered, over the local address that the link in use has.
    second_choice: Option<SocketAddr>,
}

#[derive(Debug)]
struct PathAddress {
    address: SocketAddr,
    /// The bytes of the latest probe, until it is answered.
    nonce: Option<Nonce>,
    /// True if an answer came from there.
    answered: bool,
    /// Number of probes.
    probes: u32,
    /// The time of the next probe, if no answer ever came.
    next: Duration,
}

impl PathAddress {
    fn new(address: SocketAddr) -> Self {
        Self { address, nonce: None, answered: false, probes: 0, next: Duration::ZERO }
    }
}

/// The work of a round.
#[derive(Debug, Default, PartialEq, Eq)]
pub(in crate::engine::links) struct SearchRound {
    /// The probes to send.
    pub(in crate::engine::links) probes: Vec<(SocketAddr, Nonce)>,
    /// The address to dial.
    pub(in crate::engine::links) dial: Option<SocketAddr>,
}

impl PathSearch {
    /// Creates a search without addresses. `elects`: this side elects links.
    pub(in crate::engine::links) fn new(elects: bool, now: Duration) -> Self {
        let head_start = if elects { Duration::ZERO } else { SECOND_SIDE };
        Self {
            addresses: Vec::new(),
            found: None,
            head_start,
            since: now,
            next: now + head_start,
            dials: 0,
            second_choice: None,
        }
    }

    /// Replaces the addresses, best first. What is known of an address stays, and so does the address at which a second
    /// link stood by last.
    pub(in crate::engine::links) fn set_addresses(&mut self, addresses: &[SocketAddr]) {
        let mut known = std::mem::take(&mut self.addresses);
        let all = self.found.iter().chain(addresses.iter().filter(|a| Some(**a) != self.found));
        self.addresses = all
            .take(MAX_ADDRESSES)
            .map(|address| match known.iter().position(|known| known.address == *address) {
                Some(at) => known.swap_remove(at),
                None => PathAddress::new(*address),
            })
            .collect();
    }

    /// Returns when [`handle_timeout`](Self::handle_timeout) is due while there is no second path.
    pub(in crate::engine::links) fn poll_timeout(&self) -> Option<Duration> {
        (!self.addresses.is_empty()).then_some(self.next)
    }

    /// Begins the next round if it is due: with probes to each address but that of the link in use.
    pub(in crate::engine::links) fn handle_timeout(
        &mut self,
        now: Duration,
        in_use: SocketAddr,
        mut nonce: impl FnMut() -> Nonce,
    ) -> SearchRound {
        if self.poll_timeout().is_none_or(|due| now < due) {
            return SearchRound::default();
        }
        if let Some(address) = self.second_choice.take() {
            return SearchRound { dial: Some(self.dial(now, address)), ..SearchRound::default() };
        }
        let without = now.saturating_sub(self.since);
        let interval = INTERVALS.iter().find(|(until, _)| without < *until);
        self.next = now + interval.map_or(LAST_INTERVAL, |(_, interval)| *interval);
        let due = |a: &&mut PathAddress| is_other(a.address, in_use) && a.next <= now;
        let probes = self.addresses.iter_mut().filter(due).map(|address| {
            if !address.answered {
                let doublings = address.probes.min(MAX_PROBE_DOUBLINGS);
                address.next = now + FIRST_PROBE_PAUSE * 2u32.pow(doublings);
            }
            address.probes += 1;
            let nonce = nonce();
            address.nonce = Some(nonce);
            (address.address, nonce)
        });
        SearchRound { probes: probes.collect(), dial: None }
    }

    /// Handles the answer of the peer's daemon to a probe. Returns the address if it is to be dialled now. An answer
    /// that `is_apart` came to another local address than that of the link in use, so that the paths share no interface
    /// of this host; another answer has to wait for such a one until the next round.
    pub(in crate::engine::links) fn handle_echo(
        &mut self,
        now: Duration,
        from: SocketAddr,
        nonce: Nonce,
        is_apart: bool,
    ) -> Option<SocketAddr> {
        let awaited = |address: &&mut PathAddress| address.nonce == Some(nonce);
        let address = self.addresses.iter_mut().find(awaited)?;
        if !is_same(address.address, from) {
            return None;
        }
        (address.nonce, address.answered, address.next) = (None, true, Duration::ZERO);
        let answered = address.address;
        if !is_apart {
            self.second_choice.get_or_insert(answered);
            return None;
        }
        Some(self.dial(now, answered))
    }

    /// Begins a dial: the next round follows its pause, and answers that are still awaited do not count.
    fn dial(&mut self, now: Duration, address: SocketAddr) -> SocketAddr {
        self.next = now + FIRST_DIAL_PAUSE * 2u32.pow(self.dials.min(MAX_DIAL_DOUBLINGS));
        self.dials += 1;
        self.second_choice = None;
        self.addresses.iter_mut().for_each(|address| address.nonce = None);
        address
    }

    /// Records that a second link stands by at this address.
    pub(in crate::engine::links) fn handle_found(&mut self, address: SocketAddr) {
        (self.dials, self.second_choice) = (0, None);
        let known = self.addresses.iter().find(|a| is_same(a.address, address));
        self.found = known.map(|known| known.address).or(self.found);
    }

    /// Records that there is no second path any more, or that another path is in use.
    pub(in crate::engine::links) fn handle_lost(&mut self, now: Duration) {
        let pause = FIRST_DIAL_PAUSE * 2u32.pow(self.dials.min(MAX_DIAL_DOUBLINGS));
        let soon = now + INTERVALS[0].1 + self.head_start;
        // Dials that bring a second path for a moment only are no way around their pause.
        self.next = if self.dials == 0 { soon } else { soon.max(self.next.min(now + pause)) };
        self.since = now;
    }
}

/// Returns whether two addresses have different hosts or interfaces: their ports do not count.
pub(in crate::engine::links) fn is_other(one: SocketAddr, other: SocketAddr) -> bool {
    one.ip().to_canonical() != other.ip().to_canonical()
}

fn is_same(one: SocketAddr, other: SocketAddr) -> bool {
    !is_other(one, other) && one.port() == other.port()
}

#[cfg(test)]
mod tests {
    use super::*;

    const NOW: Duration = Duration::from_secs(100);

    fn address(last: u8) -> SocketAddr {
        SocketAddr::from(([10, 0, 0, last], 61300))
    }

    fn search(addresses: &[u8]) -> PathSearch {
        let mut search = PathSearch::new(true, NOW);
        let addresses: Vec<_> = addresses.iter().map(|last| address(*last)).collect();
        search.set_addresses(&addresses);
        search
    }

    /// One round. Returns the last bytes of the probed addresses; the first probe has the nonce 1.
    fn round(search: &mut PathSearch, now: Duration, in_use: u8) -> Vec<u8> {
        let mut number = 0;
        let round = search.handle_timeout(now, address(in_use), || {
            number += 1;
            [number; 8]
        });
        assert_eq!(round.dial, None);
        let last = |to: &SocketAddr| to.ip().to_string().rsplit('.').next().unwrap().parse();
        round.probes.iter().map(|(to, _)| last(to).unwrap()).collect()
    }

    #[test]
    fn addresses_other_than_that_in_use_are_probed_and_the_one_that_answers_is_dialled() {
        let mut search = search(&[1, 2, 3]);
        assert_eq!(search.poll_timeout(), Some(NOW));
        assert_eq!(round(&mut search, NOW, 1), [2, 3]);
        assert_eq!(search.handle_echo(NOW, address(3), [1; 8], true), None, "another's nonce");
        assert_eq!(search.handle_echo(NOW, address(3), [9; 8], true), None, "no nonce");
        assert_eq!(search.handle_echo(NOW, address(3), [2; 8], true), Some(address(3)));
        assert_eq!(search.handle_echo(NOW, address(3), [2; 8], true), None, "it comes twice");
        assert_eq!(search.handle_echo(NOW, address(2), [1; 8], true), None, "one dial at a time");
        assert_eq!(search.poll_timeout(), Some(NOW + FIRST_DIAL_PAUSE));
    }

    #[test]
    fn path_over_the_same_local_address_waits_a_round_for_one_over_another() {
        let mut search = search(&[1, 2, 3]);
        round(&mut search, NOW, 1);
        assert_eq!(search.handle_echo(NOW, address(2), [1; 8], false), None);
        assert_eq!(search.handle_echo(NOW, address(3), [2; 8], true), Some(address(3)));
        let due = search.poll_timeout().unwrap();
        round(&mut search, due, 1);
        assert_eq!(search.handle_echo(due, address(2), [1; 8], false), None);
        let due = search.poll_timeout().unwrap();
        let round = search.handle_timeout(due, address(1), || unreachable!());
        assert_eq!(round.dial, Some(address(2)), "there is no other");
    }

    #[test]
    fn address_that_answered_is_probed_in_each_round_and_a_silent_one_ever_less() {
        let mut search = search(&[1, 2, 3]);
        round(&mut search, NOW, 1);
        search.handle_echo(NOW, address(2), [1; 8], true).unwrap();
        search.handle_found(address(2));
        search.handle_lost(NOW + Duration::from_secs(60));
        let mut rounds = [0; 2];
        let mut now = search.poll_timeout().unwrap();
        while now < NOW + Duration::from_secs(180) {
            for probed in round(&mut search, now, 1) {
                rounds[usize::from(probed - 2)] += 1;
            }
            now = search.poll_timeout().unwrap();
        }
        assert!((100..=103).contains(&rounds[0]), "{rounds:?}");
        assert!((5..=10).contains(&rounds[1]), "{rounds:?}");
    }

    #[test]
    fn dials_that_fail_become_rarer_whatever_addresses_answer() {
        let mut search = search(&[1, 2]);
        let mut dials = 0;
        let mut now = NOW;
        for number in 0.. {
            // Each round has another address, which answers at once.
            let other = SocketAddr::from(([10, 0, 9, 9], 1000 + number));
            search.set_addresses(&[address(1), other]);
            let round = search.handle_timeout(now, address(1), || [7; 8]);
            for (to, nonce) in round.probes {
                dials += u32::from(search.handle_echo(now, to, nonce, true).is_some());
            }
            now = search.poll_timeout().unwrap();
            if now > NOW + Duration::from_secs(1000) {
                break;
            }
        }
        assert!((8..=14).contains(&dials), "{dials}");
        search.handle_found(address(2));
        search.handle_lost(now);
        assert_eq!(search.poll_timeout(), Some(now + INTERVALS[0].1), "a dial succeeded");
    }

    #[test]
    fn address_of_the_last_second_path_stays_whatever_beacons_say() {
        let mut search = search(&[1, 2]);
        round(&mut search, NOW, 1);
        search.handle_echo(NOW, address(2), [1; 8], true).unwrap();
        search.handle_found(address(2));
        let forged: Vec<_> = (10..100).map(address).collect();
        search.set_addresses(&forged);
        assert_eq!(search.addresses.len(), MAX_ADDRESSES);
        let due = search.poll_timeout().unwrap();
        assert_eq!(round(&mut search, due, 1)[..2], [2, 10]);
        search.set_addresses(&[]);
        assert_eq!(search.addresses.len(), 1);
    }

    #[test]
    fn side_that_does_not_elect_waits_and_so_it_does_after_each_loss() {
        let mut search = PathSearch::new(false, NOW);
        assert_eq!(search.poll_timeout(), None);
        search.set_addresses(&[address(2)]);
        assert_eq!(search.poll_timeout(), Some(NOW + SECOND_SIDE));
        assert!(round(&mut search, NOW, 1).is_empty());
        search.handle_lost(NOW * 2);
        assert_eq!(search.poll_timeout(), Some(NOW * 2 + INTERVALS[0].1 + SECOND_SIDE));
    }
}
