//! Looks for a second path to a linked peer: probes the peer's other addresses, and selects one that answers.

use std::{net::SocketAddr, time::Duration};

use super::budget::{Budget, Rate};
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
/// Dials to a peer: 32 at once, then one each five seconds. A second link that stood by and ended again costs a
/// handshake and, in qkd, a key, whatever the reason of its end.
const DIALS: Rate = Rate { pause: Duration::from_secs(5), at_once: 32 };
/// Time for which the side that does not elect leaves the first round, and a dial, to the other side.
const SECOND_SIDE: Duration = Duration::from_secs(1);
/// Time after which a second link counts as a success of its dial.
const SUCCESS: Duration = Duration::from_secs(1);

/// The search for a second path to one peer. A state machine as `docs/architecture.md` describes them.
///
/// Any host can send the beacons from which the addresses are known. So an address costs a probe, a datagram of a few
/// bytes, until the peer's daemon answers there. All dials to the peer together have one budget: an answer proves
/// nothing. A peer whose second links end again and again gets a dial each five seconds.
#[derive(Debug)]
pub(in crate::engine::links) struct PathSearch {
    addresses: Vec<PathAddress>,
    /// The address at which a second link stood by last.
    found: Option<SocketAddr>,
    /// Time that this side leaves to the other one.
    wait: Duration,
    /// The time since which there is no second path.
    since: Duration,
    /// The time of the next round of probes.
    next: Duration,
    /// The time before which no dial begins.
    dial_after: Duration,
    /// Number of dials since the last success.
    dials: u32,
    budget: Budget,
    /// The time since which a second link stands by.
    found_at: Option<Duration>,
    /// An address that answered and is dialled in a round from this time on, unless a better one answers before.
    choice: Option<(SocketAddr, Duration)>,
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
        let wait = if elects { Duration::ZERO } else { SECOND_SIDE };
        Self {
            addresses: Vec::new(),
            found: None,
            wait,
            since: now,
            next: now + wait,
            dial_after: now,
            dials: 0,
            budget: Budget::default(),
            found_at: None,
            choice: None,
        }
    }

    /// Replaces the addresses, best first. What is known of an address stays, and so does the address at which a second
    /// link stood by last. A new address is probed soon.
    pub(in crate::engine::links) fn set_addresses(
        &mut self,
        now: Duration,
        addresses: &[SocketAddr],
    ) {
        let is_known = |address: &SocketAddr| self.addresses.iter().any(|a| a.address == *address);
        if !addresses.iter().all(is_known) {
            self.next = self.next.min((now + self.wait).max(self.dial_after));
        }
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
        if let Some((address, from)) = self.choice
            && from <= now
        {
            self.choice = None;
            if is_other(address, in_use) {
                let dial = Some(self.dial(now, address));
                return SearchRound { dial, ..SearchRound::default() };
            }
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

    /// Handles the answer of the peer's daemon to a probe. Returns the address if the caller is to dial it now.
    ///
    /// `is_apart`: the answer came to another local address than that of the link in use. The two paths then share no
    /// interface of this host, and the address goes first. Any other address waits for such an answer until the next
    /// round. `later`: the caller dials the peer already, so the address waits, too.
    pub(in crate::engine::links) fn handle_echo(
        &mut self,
        now: Duration,
        from: SocketAddr,
        nonce: Nonce,
        is_apart: bool,
        later: bool,
    ) -> Option<SocketAddr> {
        let awaited = |address: &&mut PathAddress| address.nonce == Some(nonce);
        let address = self.addresses.iter_mut().find(awaited)?;
        if !is_same(address.address, from) {
            return None;
        }
        (address.nonce, address.answered, address.next) = (None, true, Duration::ZERO);
        let answered = address.address;
        if is_apart && !later && self.wait.is_zero() && self.dial_after <= now {
            return Some(self.dial(now, answered));
        }
        if is_apart || self.choice.is_none() {
            let from = self.choice.map_or(now + self.wait, |(_, from)| from);
            self.choice = Some((answered, from.max(self.dial_after)));
        }
        None
    }

    /// Returns whether this probe is awaited.
    pub(in crate::engine::links) fn awaits(&self, nonce: Nonce) -> bool {
        self.addresses.iter().any(|address| address.nonce == Some(nonce))
    }

    /// Begins a dial: the next round follows its pause.
    fn dial(&mut self, now: Duration, address: SocketAddr) -> SocketAddr {
        let pause = FIRST_DIAL_PAUSE * 2u32.pow(self.dials.min(MAX_DIAL_DOUBLINGS));
        self.budget.pay(DIALS, now);
        self.dial_after = self.budget.due(DIALS).max(now + pause);
        self.next = self.dial_after;
        self.dials += 1;
        self.forget_answers();
        address
    }

    /// Forgets the answers and the probes that are awaited: they do not count beside another link in use.
    pub(in crate::engine::links) fn forget_answers(&mut self) {
        self.choice = None;
        self.addresses.iter_mut().for_each(|address| address.nonce = None);
    }

    /// Records that a second link stands by at this address.
    pub(in crate::engine::links) fn handle_found(&mut self, now: Duration, address: SocketAddr) {
        self.found_at = Some(now);
        self.forget_answers();
        let known = self.addresses.iter().find(|a| is_same(a.address, address));
        self.found = known.map(|known| known.address).or(self.found);
    }

    /// Records that there is no second path any more, or that another path is in use.
    pub(in crate::engine::links) fn handle_lost(&mut self, now: Duration) {
        self.forget_answers();
        // A dial that brings a second link for a moment only counts as one that brings none.
        if self.found_at.take().is_some_and(|found_at| found_at + SUCCESS <= now) {
            (self.dials, self.dial_after) = (0, self.budget.due(DIALS).max(now));
        }
        self.since = now;
        self.next = (now + INTERVALS[0].1 + self.wait).max(self.dial_after);
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
        search.set_addresses(NOW, &addresses);
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
        assert_eq!(
            search.handle_echo(NOW, address(3), [1; 8], true, false),
            None,
            "another's nonce"
        );
        assert_eq!(search.handle_echo(NOW, address(3), [9; 8], true, false), None, "no nonce");
        assert_eq!(search.handle_echo(NOW, address(3), [2; 8], true, false), Some(address(3)));
        assert_eq!(
            search.handle_echo(NOW, address(3), [2; 8], true, false),
            None,
            "it comes twice"
        );
        assert_eq!(
            search.handle_echo(NOW, address(2), [1; 8], true, false),
            None,
            "one dial at a time"
        );
        assert_eq!(search.poll_timeout(), Some(NOW + FIRST_DIAL_PAUSE));
    }

    #[test]
    fn path_over_the_same_local_address_waits_a_round_for_one_over_another() {
        let mut search = search(&[1, 2, 3]);
        round(&mut search, NOW, 1);
        assert_eq!(search.handle_echo(NOW, address(2), [1; 8], false, false), None);
        assert_eq!(search.handle_echo(NOW, address(3), [2; 8], true, false), Some(address(3)));
        let due = search.poll_timeout().unwrap();
        round(&mut search, due, 1);
        assert_eq!(search.handle_echo(due, address(2), [1; 8], false, false), None);
        let due = search.poll_timeout().unwrap();
        let round = search.handle_timeout(due, address(1), || unreachable!());
        assert_eq!(round.dial, Some(address(2)), "there is no other");
    }

    #[test]
    fn second_links_that_end_again_and_again_are_dialled_each_five_seconds() {
        let mut search = search(&[1, 2]);
        let (mut now, mut dials) = (NOW, Vec::new());
        let end = now + Duration::from_secs(300);
        search.next = now;
        while now < end {
            now = search.poll_timeout().unwrap().max(now);
            round(&mut search, now, 1);
            let Some(found) = search.handle_echo(now, address(2), [1; 8], true, false) else {
                continue;
            };
            dials.push(now);
            search.handle_found(now, found);
            now += SUCCESS;
            search.handle_lost(now);
        }
        let first = dials.iter().filter(|dial| **dial < dials[0] + Duration::from_secs(50)).count();
        assert!((32..=42).contains(&first), "{first} quick dials");
        assert!((90..=96).contains(&dials.len()), "{} dials in 300 s", dials.len());
    }

    #[test]
    fn address_that_answered_is_probed_in_each_round_and_a_silent_one_ever_less() {
        let mut search = search(&[1, 2, 3]);
        round(&mut search, NOW, 1);
        search.handle_echo(NOW, address(2), [1; 8], true, false).unwrap();
        search.handle_found(NOW, address(2));
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
    fn dials_that_fail_become_rarer_though_other_addresses_answer() {
        let mut search = search(&[1, 2]);
        let mut dials = 0;
        let mut now = NOW;
        for number in 0.. {
            // Each round has another address, which answers at once.
            let other = SocketAddr::from(([10, 0, 9, 9], 1000 + number));
            search.set_addresses(now, &[address(1), other]);
            let round = search.handle_timeout(now, address(1), || [7; 8]);
            for (to, nonce) in round.probes {
                dials += u32::from(search.handle_echo(now, to, nonce, true, false).is_some());
            }
            now = search.poll_timeout().unwrap();
            if now > NOW + Duration::from_secs(1000) {
                break;
            }
        }
        assert!((8..=14).contains(&dials), "{dials}");
        search.set_addresses(now, &[address(1), address(2)]);
        assert_eq!(round(&mut search, now, 1), [2]);
        assert_eq!(search.handle_echo(now, address(2), [1; 8], true, false), Some(address(2)));
        search.handle_found(now, address(2));
        search.handle_lost(now + SUCCESS / 2);
        let pause = FIRST_DIAL_PAUSE * 2u32.pow(MAX_DIAL_DOUBLINGS);
        assert_eq!(search.poll_timeout(), Some(now + pause), "it stood for a moment");
        search.handle_found(now, address(2));
        search.handle_lost(now + SUCCESS);
        assert_eq!(search.poll_timeout(), Some(now + SUCCESS + INTERVALS[0].1), "a success");
    }

    #[test]
    fn address_of_the_last_second_path_outlasts_forged_beacons() {
        let mut search = search(&[1, 2]);
        round(&mut search, NOW, 1);
        search.handle_echo(NOW, address(2), [1; 8], true, false).unwrap();
        search.handle_found(NOW, address(2));
        let forged: Vec<_> = (10..100).map(address).collect();
        search.set_addresses(NOW, &forged);
        assert_eq!(search.addresses.len(), MAX_ADDRESSES);
        let due = search.poll_timeout().unwrap();
        assert_eq!(round(&mut search, due, 1)[..2], [2, 10]);
        search.set_addresses(NOW, &[]);
        assert_eq!(search.addresses.len(), 1);
    }

    #[test]
    fn new_address_is_probed_soon_and_an_answer_beside_another_dial_is_kept() {
        let mut search = search(&[1, 2]);
        let late = NOW + Duration::from_secs(100);
        round(&mut search, late, 1);
        assert_eq!(search.poll_timeout(), Some(late + LAST_INTERVAL));
        search.set_addresses(late, &[address(1), address(3)]);
        assert_eq!(search.poll_timeout(), Some(late));
        assert_eq!(round(&mut search, late, 1), [3]);
        assert_eq!(search.handle_echo(late, address(3), [1; 8], true, true), None);
        let due = search.poll_timeout().unwrap();
        let round = search.handle_timeout(due, address(1), || unreachable!());
        assert_eq!(round.dial, Some(address(3)));
    }

    #[test]
    fn answer_at_the_address_that_came_into_use_is_not_dialled() {
        let mut search = search(&[1, 2]);
        round(&mut search, NOW, 1);
        assert_eq!(search.handle_echo(NOW, address(2), [1; 8], false, false), None);
        let due = search.poll_timeout().unwrap();
        assert_eq!(search.handle_timeout(due, address(2), || [9; 8]).dial, None);
    }

    #[test]
    fn side_that_does_not_elect_leaves_the_dial_to_the_other_for_a_second() {
        let mut search = PathSearch::new(false, NOW);
        search.set_addresses(NOW, &[address(2)]);
        let begin = search.poll_timeout().unwrap();
        round(&mut search, begin, 1);
        assert_eq!(search.handle_echo(begin, address(2), [1; 8], true, false), None);
        let (dialled, now) = loop {
            let now = search.poll_timeout().unwrap();
            if let Some(dialled) = search.handle_timeout(now, address(1), || [9; 8]).dial {
                break (dialled, now);
            }
        };
        assert_eq!((dialled, now - begin), (address(2), SECOND_SIDE));
    }

    #[test]
    fn side_that_does_not_elect_waits_and_so_it_does_after_each_loss() {
        let mut search = PathSearch::new(false, NOW);
        assert_eq!(search.poll_timeout(), None);
        search.set_addresses(NOW, &[address(2)]);
        assert_eq!(search.poll_timeout(), Some(NOW + SECOND_SIDE));
        assert!(round(&mut search, NOW, 1).is_empty());
        search.handle_lost(NOW * 2);
        assert_eq!(search.poll_timeout(), Some(NOW * 2 + INTERVALS[0].1 + SECOND_SIDE));
    }
}
