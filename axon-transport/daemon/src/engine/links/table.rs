//! The links by number, and the link in use of each peer.

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
}

impl LinkTable {
    /// Adds a link.
    pub(super) fn insert(&mut self, number: u64, link: Link) {
        self.links.insert(number, link);
    }

    /// Removes a link. [`let_go`](Self::let_go) has to follow if it was in use.
    pub(super) fn remove(&mut self, number: u64) -> Option<Link> {
        self.links.remove(&number)
    }

    /// Whether there is such a link.
    pub(super) fn contains(&self, number: u64) -> bool {
        self.links.contains_key(&number)
    }

    /// Whether there are no links.
    pub(super) fn is_empty(&self) -> bool {
        self.links.is_empty()
    }

    /// A link.
    pub(super) fn get(&self, number: u64) -> Option<&Link> {
        self.links.get(&number)
    }

    /// A link.
    pub(super) fn get_mut(&mut self, number: u64) -> Option<&mut Link> {
        self.links.get_mut(&number)
    }

    /// The peer of a link, once its name was proven.
    pub(super) fn peer(&self, number: u64) -> Option<&LinkPeer> {
        self.links.get(&number)?.peer.as_ref()
    }

    /// The peer of a link, once its name was proven.
    pub(super) fn peer_mut(&mut self, number: u64) -> Option<&mut LinkPeer> {
        self.links.get_mut(&number)?.peer.as_mut()
    }

    /// The daemon at the other end of a link, once its name was proven.
    pub(super) fn daemon(&self, number: u64) -> Option<DaemonId> {
        Some(self.peer(number)?.summary.hello.daemon)
    }

    /// The opening of a link, while it has one.
    pub(super) fn opening_mut(&mut self, number: u64) -> Option<&mut Opening> {
        match &mut self.links.get_mut(&number)?.phase {
            LinkPhase::Opening(opening) => Some(opening),
            _ => None,
        }
    }

    /// The links.
    pub(super) fn iter(&self) -> impl Iterator<Item = (u64, &Link)> {
        self.links.iter().map(|(number, link)| (*number, link))
    }

    /// The links.
    pub(super) fn iter_mut(&mut self) -> impl Iterator<Item = (u64, &mut Link)> {
        self.links.iter_mut().map(|(number, link)| (*number, link))
    }

    /// The links whose peers proved their names, with those.
    pub(super) fn peers(&self) -> impl Iterator<Item = (u64, &LinkPeer)> {
        self.iter().filter_map(|(number, link)| Some((number, link.peer.as_ref()?)))
    }

    /// How many links one identity has.
    pub(super) fn of_identity(&self, who: &PeerIdentity) -> usize {
        self.peers().filter(|(_, peer)| peer.summary.who.is(who)).count()
    }

    /// The links that carry samples.
    pub(super) fn open(&self) -> Vec<u64> {
        self.iter().filter(|(_, link)| link.is_open()).map(|(number, _)| number).collect()
    }

    /// The links that a successor took over from.
    pub(super) fn leaving(&self) -> impl Iterator<Item = (u64, &LinkPeer)> {
        self.iter()
            .filter(|(_, link)| matches!(link.phase, LinkPhase::Leaving(_)))
            .filter_map(|(number, link)| Some((number, link.peer.as_ref()?)))
    }

    /// The link in use of a peer.
    pub(super) fn current(&self, daemon: DaemonId) -> Option<u64> {
        self.current.get(&daemon).copied()
    }

    /// The other end of the link in use of a peer.
    pub(super) fn current_peer(&self, daemon: DaemonId) -> Option<&LinkPeer> {
        self.peer(self.current(daemon)?)
    }

    /// Uses a link from now on.
    pub(super) fn put_in_use(&mut self, daemon: DaemonId, number: u64) {
        self.current.insert(daemon, number);
    }

    /// Uses no link of a peer any more, if this one was in use. Returns whether it was.
    pub(super) fn let_go(&mut self, daemon: DaemonId, number: u64) -> bool {
        let was = self.current(daemon) == Some(number);
        if was {
            self.current.remove(&daemon);
        }
        was
    }

    /// When the first of them has something due.
    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        self.links.values().filter_map(Link::poll_timeout).min()
    }

    /// Those that have something due.
    pub(super) fn due(&self, now: Duration) -> Vec<u64> {
        let due = self.iter().filter(|(_, link)| link.poll_timeout().is_some_and(|t| t <= now));
        due.map(|(number, _)| number).collect()
    }
}
