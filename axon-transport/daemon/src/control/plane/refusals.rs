//! The recent refusals, for `axon status`, and their lines in the log.

use std::{
    collections::HashMap,
    net::{IpAddr, SocketAddr},
};

use axon_transport::status::RefusalStatus;

use crate::{bridge::RefusalKind, engine::links::place};

/// Maximum number of remembered refusals.
const MAX_REFUSALS: usize = 32;
/// Maximum number of remembered refusals of hosts that prove nothing.
const MOST_UNPROVEN: usize = 8;

/// The last refusals, oldest first.
///
/// Kinds share the room, and so do the addresses of hosts that prove nothing. The kind with the most refusals makes
/// room, and within it the address with the most: its oldest refusal goes. A flood of one kind, or from one address,
/// replaces its own refusals.
#[derive(Debug, Default)]
pub(in crate::control) struct Refusals(Vec<(RefusalKind, RefusalStatus)>);

impl Refusals {
    /// Adds a refusal. It replaces the same earlier one; ports do not count, because a dialler has another port each
    /// time.
    pub(in crate::control) fn add(&mut self, kind: RefusalKind, new: RefusalStatus) {
        let peer = without_ports(&new.peer);
        self.0.retain(|(_, old)| {
            old.what != new.what || old.reason != new.reason || without_ports(&old.peer) != peer
        });
        let share = RefusalShare::of(kind);
        let own = self.0.iter().filter(|(kind, _)| RefusalShare::of(*kind) == share).count();
        if share == RefusalShare::Unproven && own >= MOST_UNPROVEN {
            self.make_room(share, source(&new));
        } else if self.0.len() >= MAX_REFUSALS {
            self.make_room(self.largest(share), source(&new));
        }
        self.0.push((kind, new));
    }

    /// Forgets the refusals of this peer for `what`.
    pub(in crate::control) fn forget(&mut self, peer: &str, what: &str) {
        self.0.retain(|(_, old)| old.peer != peer || old.what != what);
    }

    /// Returns all refusals, oldest first.
    pub(in crate::control) fn iter(&self) -> impl Iterator<Item = &RefusalStatus> {
        self.0.iter().map(|(_, refusal)| refusal)
    }

    /// Returns the share with the most refusals, once `newcomer` has one more.
    fn largest(&self, newcomer: RefusalShare) -> RefusalShare {
        let mut held = HashMap::from([(newcomer, 1)]);
        for (kind, _) in &self.0 {
            *held.entry(RefusalShare::of(*kind)).or_default() += 1;
        }
        let most = held.into_iter().max_by_key(|(share, held)| (*held, *share == newcomer));
        most.map_or(newcomer, |(share, _)| share)
    }

    /// Removes the oldest refusal of the source that has the most in this share, once `newcomer` has one more.
    fn make_room(&mut self, share: RefusalShare, newcomer: Option<IpAddr>) {
        let mut held = HashMap::from([(newcomer, 1)]);
        let all = || {
            self.0.iter().enumerate().filter(move |(_, (kind, _))| RefusalShare::of(*kind) == share)
        };
        for (_, (_, refusal)) in all() {
            *held.entry(source(refusal)).or_default() += 1;
        }
        let oldest =
            all().max_by_key(|(at, (_, refusal))| (held[&source(refusal)], usize::MAX - at));
        if let Some((at, _)) = oldest {
            self.0.remove(at);
        }
    }
}

/// The kinds of refusals that share space.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
enum RefusalShare {
    Unproven,
    Listed,
    Peer,
    Local,
}

impl RefusalShare {
    fn of(kind: RefusalKind) -> Self {
        match kind {
            RefusalKind::Beacon | RefusalKind::Unproven => Self::Unproven,
            RefusalKind::Listed => Self::Listed,
            RefusalKind::Peer => Self::Peer,
            RefusalKind::Local => Self::Local,
        }
    }
}

/// Returns the words of a peer's text. An address is `Ok`.
fn words(peer: &str) -> impl Iterator<Item = Result<IpAddr, &str>> {
    peer.split(' ').map(|word| match word.trim_end_matches(',').parse::<SocketAddr>() {
        Ok(address) => Ok(address.ip().to_canonical()),
        Err(_) => Err(word),
    })
}

/// Returns a peer's text with its addresses without ports.
fn without_ports(peer: &str) -> Vec<Result<IpAddr, &str>> {
    words(peer).collect()
}

/// Returns the address that a refusal comes from. The rest of the text may be chosen by a stranger.
fn source(refusal: &RefusalStatus) -> Option<IpAddr> {
    words(&refusal.peer).filter_map(Result::ok).last().map(place)
}

/// Logs a refusal. Each kind has its own line: the log's rate limit is by line of code.
pub(super) fn warn(kind: RefusalKind, peer: &str, what: &str, reason: &str) {
    match kind {
        RefusalKind::Beacon => {
            tracing::warn!(peer, what, reason, "ignored a peer whose beacon does not match")
        }
        RefusalKind::Unproven => {
            tracing::warn!(peer, what, reason, "link refused: the peer has not proved who it is");
        }
        RefusalKind::Listed => tracing::warn!(peer, what, reason, "link refused: static peer"),
        RefusalKind::Peer => tracing::warn!(peer, what, reason, "peer refused"),
        RefusalKind::Local => tracing::warn!(peer, what, reason, "refused on this host"),
    }
}

#[cfg(test)]
mod tests {
    use std::time::SystemTime;

    use super::*;

    fn add(refusals: &mut Refusals, kind: RefusalKind, peer: &str, reason: &str) {
        let [peer, what, reason] = [peer, "link", reason].map(str::to_owned);
        refusals.add(kind, RefusalStatus::new(SystemTime::UNIX_EPOCH, peer, what, reason));
    }

    /// Returns the reasons of the remembered refusals of peers whose text begins so.
    fn of(refusals: &Refusals, peer: &str) -> Vec<String> {
        let of = refusals.iter().filter(|refusal| refusal.peer.starts_with(peer));
        of.map(|refusal| refusal.reason.clone()).collect()
    }

    #[test]
    fn refusals_of_one_address_are_merged_across_its_ports() {
        let mut refusals = Refusals::default();
        for port in 1..100 {
            add(&mut refusals, RefusalKind::Unproven, &format!("10.0.0.1:{port}"), "no");
            add(&mut refusals, RefusalKind::Beacon, &format!("a at [::1]:{port}, [::2]:1"), "no");
        }
        let peers: Vec<_> = refusals.iter().map(|refusal| &*refusal.peer).collect();
        assert_eq!(peers, ["10.0.0.1:99", "a at [::1]:99, [::2]:1"], "the last ones");
        add(&mut refusals, RefusalKind::Unproven, "10.0.0.2:99", "no");
        add(&mut refusals, RefusalKind::Unproven, "b at 10.0.0.1:99", "no");
        add(&mut refusals, RefusalKind::Unproven, "10.0.0.1:99", "another cause");
        assert_eq!(refusals.iter().count(), 5);
    }

    #[test]
    fn unproven_peers_use_at_most_a_quarter_of_the_refusal_list() {
        let mut refusals = Refusals::default();
        let honest = [RefusalKind::Listed, RefusalKind::Peer, RefusalKind::Local];
        for (kind, peer) in honest.into_iter().zip(["listed", "proven", "local"]) {
            (0..8).for_each(|number| add(&mut refusals, kind, peer, &number.to_string()));
        }
        for number in 0..1000_u16 {
            let [high, low] = number.to_be_bytes();
            let kind = [RefusalKind::Unproven, RefusalKind::Beacon][usize::from(number % 2)];
            add(&mut refusals, kind, &format!("10.0.{high}.{low}:1"), "no");
        }
        assert_eq!(of(&refusals, "10.").len(), MOST_UNPROVEN);
        for peer in ["listed", "proven", "local"] {
            assert_eq!(of(&refusals, peer).len(), 8, "{peer}");
        }
    }

    #[test]
    fn an_address_that_says_something_new_each_time_replaces_its_own() {
        let mut refusals = Refusals::default();
        add(&mut refusals, RefusalKind::Unproven, "10.0.0.1:1", "honest");
        for number in 0..1000 {
            let text = format!("name{number} at [2001:db8::{number}]:{}", 1 + number);
            add(&mut refusals, RefusalKind::Unproven, &text, &number.to_string());
        }
        assert_eq!(of(&refusals, "10.0.0.1"), ["honest"], "one network is one address");
        assert_eq!(refusals.iter().count(), MOST_UNPROVEN);
        assert_eq!(refusals.iter().last().unwrap().reason, "999");
    }

    #[test]
    fn a_flood_of_one_kind_leaves_the_refusals_of_others() {
        let kinds = [RefusalKind::Listed, RefusalKind::Peer, RefusalKind::Local];
        for flood in kinds {
            let mut refusals = Refusals::default();
            for kind in kinds.into_iter().filter(|kind| *kind != flood) {
                (0..5).for_each(|n| add(&mut refusals, kind, "honest", &format!("{kind:?} {n}")));
            }
            (0..1000).for_each(|n| add(&mut refusals, flood, "flood", &n.to_string()));
            assert_eq!(of(&refusals, "honest").len(), 10, "{flood:?}");
            assert_eq!(of(&refusals, "flood").len(), MAX_REFUSALS - 10, "all places are of use");
            // Another kind has its share when it comes late.
            let late = kinds.into_iter().find(|kind| *kind != flood).unwrap();
            (5..11).for_each(|n| add(&mut refusals, late, "honest", &format!("{late:?} {n}")));
            assert_eq!(of(&refusals, "honest").len(), 16, "{flood:?}");
            assert_eq!(refusals.iter().count(), MAX_REFUSALS);
        }
    }

    #[test]
    fn forget_removes_only_the_refusal_of_that_peer_and_operation() {
        let mut refusals = Refusals::default();
        add(&mut refusals, RefusalKind::Local, "session a", "1 of 2");
        add(&mut refusals, RefusalKind::Local, "session b", "1 of 2");
        refusals.forget("session a", "link");
        refusals.forget("session b", "endpoint");
        assert_eq!((of(&refusals, "session a").len(), of(&refusals, "session b").len()), (0, 1));
    }
}
