//! Limits the handshakes and links that hosts behind one address may take of the daemon.
//!
//! Limits are per source address: QUIC validates the address, while an attacker can create any number of keys.
//! Hosts behind one translated address share it, so the limits apply only where there is scarcity.

use std::{
    cell::RefCell,
    collections::{HashMap, VecDeque},
    net::{IpAddr, Ipv6Addr},
    rc::Rc,
    time::Duration,
};

/// Maximum number of handshakes under way beyond that with listed peers.
const FOR_LISTED: usize = 16;
/// Time after which a refusal at one address is reported again.
const SAID_AGAIN: Duration = Duration::from_secs(10);
/// Maximum number of addresses whose reported refusals are remembered.
const MOST_SAID: usize = 64;

/// Returns the part of an address that counts as one address: for IPv6 the network, because a host may take any address
/// in it.
pub(crate) fn place(address: IpAddr) -> IpAddr {
    match address.to_canonical() {
        IpAddr::V6(v6) => {
            let [a, b, c, d, ..] = v6.segments();
            Ipv6Addr::new(a, b, c, d, 0, 0, 0, 0).into()
        }
        v4 => v4,
    }
}

/// Handshakes under way, by address.
#[derive(Debug)]
pub(crate) struct HandshakeShares {
    most: usize,
    under_way: RefCell<HashMap<IpAddr, usize>>,
}

/// The place of a handshake, which counts until this is dropped.
#[derive(Debug)]
pub(crate) struct HandshakeSlot {
    of: Rc<HandshakeShares>,
    at: IpAddr,
}

impl HandshakeShares {
    pub(crate) fn new(most: usize) -> Rc<Self> {
        Rc::new(Self { most, under_way: RefCell::default() })
    }

    /// Returns a place for one more handshake from this address. An address may have at most as many places as are
    /// free, so another address always finds one. A listed peer has some places that no other peer gets.
    pub(crate) fn enter(self: &Rc<Self>, address: IpAddr, listed: bool) -> Option<HandshakeSlot> {
        let at = place(address);
        let mut under_way = self.under_way.borrow_mut();
        let all: usize = under_way.values().sum();
        let own = under_way.get(&at).copied().unwrap_or_default();
        let free = self.most.saturating_sub(all);
        let reserved = listed && own < FOR_LISTED && all < self.most + FOR_LISTED;
        if own >= free && !reserved {
            return None;
        }
        *under_way.entry(at).or_default() += 1;
        Some(HandshakeSlot { of: Rc::clone(self), at })
    }
}

impl Drop for HandshakeSlot {
    fn drop(&mut self) {
        let mut under_way = self.of.under_way.borrow_mut();
        if let Some(count) = under_way.get_mut(&self.at) {
            *count -= 1;
            if *count == 0 {
                under_way.remove(&self.at);
            }
        }
    }
}

/// Returns the link that has to go so that a link from `newcomer` has a place, given the address and number of each
/// link. Returns `None` if the newcomer is refused, because no other address has more than it would have.
///
/// The address with the most links gives up its newest link. A listed peer has a place even if others have few, and
/// does not give up its own to an unlisted one.
pub(crate) fn gives_way(
    newcomer: IpAddr,
    links: &[(IpAddr, u64)],
    is_listed: impl Fn(IpAddr) -> bool,
) -> Option<u64> {
    let newcomer_place = place(newcomer);
    let mut held: HashMap<IpAddr, usize> = HashMap::new();
    for (address, _) in links {
        *held.entry(place(*address)).or_default() += 1;
    }
    let own = held.get(&newcomer_place).copied().unwrap_or_default();
    let privileged = |address: IpAddr| is_listed(address) && held[&place(address)] <= FOR_LISTED;
    let others = links
        .iter()
        .filter(|(address, _)| place(*address) != newcomer_place && !privileged(*address));
    let (address, newest) =
        others.max_by_key(|(address, number)| (held[&place(*address)], *number))?;
    let reserved = is_listed(newcomer) && own < FOR_LISTED;
    (reserved || held[&place(*address)] > own + 1).then_some(*newest)
}

/// The addresses for which a refusal was reported recently.
#[derive(Debug, Default)]
pub(crate) struct LoggedRefusals(VecDeque<(IpAddr, Duration)>);

impl LoggedRefusals {
    /// Returns whether a refusal should be reported, and counts it as reported then.
    pub(crate) fn is_new(&mut self, address: IpAddr, now: Duration) -> bool {
        self.0.retain(|(_, at)| now.saturating_sub(*at) < SAID_AGAIN);
        let at = place(address);
        if self.0.iter().any(|(said, _)| *said == at) || self.0.len() >= MOST_SAID {
            return false;
        }
        self.0.push_back((at, now));
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NOW: Duration = Duration::from_secs(1000);

    fn at(last: u8) -> IpAddr {
        [10, 0, 0, last].into()
    }

    #[test]
    fn one_address_takes_half_the_free_handshakes_and_listed_peers_have_reserves() {
        let handshakes = HandshakeShares::new(64);
        let take = |host, listed| {
            std::iter::from_fn(|| handshakes.enter(at(host), listed)).collect::<Vec<_>>()
        };
        let greedy = take(1, false);
        assert_eq!(greedy.len(), 32);
        let second = take(2, false);
        assert_eq!(second.len(), 16);
        let many: Vec<_> = (3..200).flat_map(|host| take(host, false)).collect();
        assert_eq!(greedy.len() + second.len() + many.len(), 64, "all places are of use");
        assert!(handshakes.enter(at(250), false).is_none());
        assert_eq!(take(251, true).len(), 16);
        drop((greedy, second, many));
        assert!(handshakes.under_way.borrow().is_empty());
        // A host may take any IPv6 address of its network.
        let in_net = |n: u16| IpAddr::from([0x2001, 0xdb8, 0, 1, 0, 0, 0, n]);
        let places: Vec<_> = (0..100).filter_map(|n| handshakes.enter(in_net(n), false)).collect();
        assert_eq!(places.len(), 32);
    }

    #[test]
    fn the_newest_link_of_the_address_that_has_the_most_gives_way() {
        let mut links: Vec<_> = (0..150).map(|number| (at(1), number)).collect();
        links.extend((150..160).map(|number| (at(2), number)));
        let none = |_: IpAddr| false;
        assert_eq!(gives_way(at(3), &links, none), Some(149));
        assert_eq!(gives_way(at(2), &links, none), Some(149), "it has fewer");
        assert_eq!(gives_way(at(1), &links, none), None);
        let spread: Vec<_> = (0..160).map(|number| (at(number as u8), number)).collect();
        assert_eq!(gives_way(at(200), &spread, none), None, "each has its own");
        assert_eq!(gives_way(at(200), &spread, |a| a == at(200)), Some(159), "a listed peer");
        assert_eq!(gives_way(at(200), &spread, |_| true), None, "all are listed");
        let two = [(at(1), 1), (at(1), 2), (at(2), 3)];
        assert_eq!(gives_way(at(3), &two, |a| a == at(1)), None, "an unlisted one waits");
    }

    #[test]
    fn a_refusal_is_said_once_for_each_address() {
        let (mut said, now) = (LoggedRefusals::default(), NOW);
        assert!(said.is_new(at(1), now) && said.is_new(at(2), now));
        assert!(!said.is_new(at(1), now));
        assert!(said.is_new(at(1), now + SAID_AGAIN));
        assert!((0..=255).filter(|host| said.is_new(at(*host), now)).count() <= MOST_SAID);
    }
}
