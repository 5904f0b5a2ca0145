//! The links by number, and of each peer the link in use and the link that stands by.

use std::{collections::HashMap, time::Duration};

use axon_shm::ids::DaemonId;

use super::{
    identity::PeerIdentity,
    link::{Link, LinkPeer, LinkPhase},
};
use crate::engine::link::opening::Opening;

/// All links.
#[derive(Default)]
pub(super) struct LinkTable {
    links: HashMap<u64, Link>,
    current: HashMap<DaemonId, u64>,
    /// The link of a peer that stands by.
    standby: HashMap<DaemonId, u64>,
}

impl LinkTable {
    /// Adds a link.
    pub(super) fn insert(&mut self, number: u64, link: Link) {
        self.links.insert(number, link);
    }

    /// Removes a link. The caller has to call [`let_go`](Self::let_go) afterwards if the link was in use.
    pub(super) fn remove(&mut self, number: u64) -> Option<Link> {
        self.links.remove(&number)
    }

    /// Returns whether there is such a link.
    pub(super) fn contains(&self, number: u64) -> bool {
        self.links.contains_key(&number)
    }

    /// Returns whether there are no links.
    pub(super) fn is_empty(&self) -> bool {
        self.links.is_empty()
    }

    /// Returns a link.
    pub(super) fn get(&self, number: u64) -> Option<&Link> {
        self.links.get(&number)
    }

    /// Returns a link.
    pub(super) fn get_mut(&mut self, number: u64) -> Option<&mut Link> {
        self.links.get_mut(&number)
    }

    /// Returns the peer of a link, once its name was proven.
    pub(super) fn peer(&self, number: u64) -> Option<&LinkPeer> {
        self.links.get(&number)?.peer.as_ref()
    }

    /// Returns the peer of a link, once its name was proven.
    pub(super) fn peer_mut(&mut self, number: u64) -> Option<&mut LinkPeer> {
        self.links.get_mut(&number)?.peer.as_mut()
    }

    /// Returns the daemon at the other end of a link, once its name was proven.
    pub(super) fn daemon(&self, number: u64) -> Option<DaemonId> {
        Some(self.peer(number)?.summary.hello.daemon)
    }

    /// Returns the opening of a link, while it has one.
    pub(super) fn opening_mut(&mut self, number: u64) -> Option<&mut Opening> {
        match &mut self.links.get_mut(&number)?.phase {
            LinkPhase::Opening(opening) => Some(opening),
            _ => None,
        }
    }

    /// Returns the links.
    pub(super) fn iter(&self) -> impl Iterator<Item = (u64, &Link)> {
        self.links.iter().map(|(number, link)| (*number, link))
    }

    /// Returns the links.
    pub(super) fn iter_mut(&mut self) -> impl Iterator<Item = (u64, &mut Link)> {
        self.links.iter_mut().map(|(number, link)| (*number, link))
    }

    /// Returns the number of links that do not stand by.
    pub(super) fn in_use_count(&self) -> usize {
        self.beside_standby().count()
    }

    /// Returns the number of links of one identity that do not stand by.
    pub(super) fn of_identity(&self, who: &PeerIdentity) -> usize {
        self.beside_standby().filter(|(_, peer)| peer.summary.who.is(who)).count()
    }

    /// Returns the links that do not stand by, with their peers.
    pub(super) fn beside_standby(&self) -> impl Iterator<Item = (u64, &LinkPeer)> {
        let links = self.iter().filter(|(_, link)| !matches!(link.phase, LinkPhase::Standby));
        links.filter_map(|(number, link)| Some((number, link.peer.as_ref()?)))
    }

    /// Returns the links that carry samples.
    pub(super) fn open(&self) -> Vec<u64> {
        self.iter().filter(|(_, link)| link.is_open()).map(|(number, _)| number).collect()
    }

    /// Returns the links that a successor took over from.
    pub(super) fn leaving(&self) -> impl Iterator<Item = (u64, &LinkPeer)> {
        self.iter()
            .filter(|(_, link)| matches!(link.phase, LinkPhase::Leaving(_)))
            .filter_map(|(number, link)| Some((number, link.peer.as_ref()?)))
    }

    /// Returns the link in use of a peer.
    pub(super) fn current(&self, daemon: DaemonId) -> Option<u64> {
        self.current.get(&daemon).copied()
    }

    /// Returns the other end of the link in use of a peer.
    pub(super) fn current_peer(&self, daemon: DaemonId) -> Option<&LinkPeer> {
        self.peer(self.current(daemon)?)
    }

    /// Puts a link in use.
    pub(super) fn put_in_use(&mut self, daemon: DaemonId, number: u64) {
        self.current.insert(daemon, number);
    }

    /// Takes a peer's link out of use, if it was in use. Returns whether it was.
    pub(super) fn let_go(&mut self, daemon: DaemonId, number: u64) -> bool {
        let was = self.current(daemon) == Some(number);
        if was {
            self.current.remove(&daemon);
        }
        was
    }

    /// Returns the link of a peer that stands by.
    pub(super) fn standby(&self, daemon: DaemonId) -> Option<u64> {
        self.standby.get(&daemon).copied()
    }

    /// Returns the links that stand by, with their daemons.
    pub(super) fn all_standby(&self) -> impl Iterator<Item = (DaemonId, u64)> {
        self.standby.iter().map(|(daemon, number)| (*daemon, *number))
    }

    /// Returns the number of links that stand by.
    pub(super) fn standby_count(&self) -> usize {
        self.standby.len()
    }

    /// Sets the link of a peer that stands by. Returns the earlier one.
    pub(super) fn set_standby(&mut self, daemon: DaemonId, number: u64) -> Option<u64> {
        self.standby.insert(daemon, number)
    }

    /// Takes the link of a peer that stands by out of this role.
    pub(super) fn take_standby(&mut self, daemon: DaemonId) -> Option<u64> {
        self.standby.remove(&daemon)
    }

    /// Returns when the first link has an action due.
    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        self.links.values().filter_map(Link::poll_timeout).min()
    }

    /// Returns the links that have an action due.
    pub(super) fn due(&self, now: Duration) -> Vec<u64> {
        let due = self.iter().filter(|(_, link)| link.poll_timeout().is_some_and(|t| t <= now));
        due.map(|(number, _)| number).collect()
    }
}
