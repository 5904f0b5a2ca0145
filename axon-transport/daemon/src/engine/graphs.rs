//! The graphs of the peers: changes are followed by turns, and each endpoint has one host.

use std::{rc::Rc, time::Duration};

use axon_shm::ids::{DaemonId, Gid};
use axon_transport::internal::graph::RemoteEndpoint;

use super::{Engine, peer_graph::PeerGraphChange};
use crate::{
    bridge::{ToControl, TrafficRules},
    link::{GraphResync, LinkMessage, Subscribe},
};

/// Estimated cost of following a change, for each endpoint of both graphs: other peers get nine times as long before
/// this peer's next turn.
const ENDPOINT: Duration = Duration::from_nanos(500);

impl Engine {
    /// Follows the changes of the peers' graphs whose turn it is.
    pub(super) fn follow_graphs(&mut self, now: Duration) {
        let stirred = self.peers.iter().filter(|(_, peer)| peer.stirred);
        let stirred: Vec<_> = stirred.map(|(daemon, _)| daemon).collect();
        for daemon in stirred {
            let Some(peer) = self.peers.get_mut(daemon) else { continue };
            let account = Rc::clone(peer.remote.account());
            if !account.turns.borrow_mut().take(now) {
                continue;
            }
            peer.stirred = false;
            let endpoints = self.follow_graph(daemon, now) + self.peers.local().len();
            let took = ENDPOINT * u32::try_from(endpoints).unwrap_or(u32::MAX);
            account.turns.borrow_mut().over(now, now + took);
        }
    }

    /// Replaces the rules. Pairs that they deny end before the engine handles any other input, so that no peer can
    /// delay it.
    pub(super) fn set_rules(&mut self, rules: TrafficRules, now: Duration) {
        self.access = rules.access;
        self.peers.set_topics(rules.topics);
        self.links.set_interface_rules(&self.access);
        let peers: Vec<_> = self.peers.iter().map(|(daemon, peer)| (daemon, peer.link)).collect();
        for (daemon, link) in peers {
            // A link that is gone is about to be reported as down.
            let permissions = self.links.view(link).and_then(|link| link.permissions(&self.access));
            let Some(permissions) = permissions else { continue };
            self.links.limit_egress(link, &permissions);
            self.peers.with(daemon, |peer, with| {
                peer.set_permissions(permissions, with.config, now);
                peer.stirred = false;
            });
            self.follow_graph(daemon, now);
        }
        self.effects.tell_draining(self.peers.are_draining());
    }

    /// Follows the changes of a peer's graph. Returns how many endpoints it has.
    fn follow_graph(&mut self, daemon: DaemonId, now: Duration) -> usize {
        let Some(peer) = self.peers.get_mut(daemon) else { return 0 };
        let number = peer.link;
        if let Some(reason) = peer.newly_refused() {
            let summary = self.links.view(number).and_then(|link| link.summary());
            let who = summary.map(|summary| summary.who.to_string());
            let peer = format!("{} at {}", who.unwrap_or_default(), self.links.peer_text(number));
            let (kind, what) = (self.links.kind(number), "graph".into());
            self.effects.tell(ToControl::Refusal { kind, peer, what, reason });
        }
        let Some(peer) = self.peers.get_mut(daemon) else { return 0 };
        let PeerGraphChange { reset, mut added, removed } = peer.remote.changes();
        // An endpoint belongs to its host: another host may not announce an endpoint of ours, or of the engine.
        let ours: Vec<Gid> = added
            .iter()
            .map(|e| e.endpoint.gid)
            .filter(|gid| self.peers.local().contains_key(gid) || gid.0[..12] == self.session)
            .collect();
        if !ours.is_empty() {
            tracing::warn!(peer = %daemon, endpoints = ours.len(),
                "ignored endpoints announced by a peer: they belong to this host");
            added.retain(|e| !ours.contains(&e.endpoint.gid));
            if let Some(peer) = self.peers.get_mut(daemon) {
                peer.remote.forget(&ours);
            }
        }
        self.freed |= !removed.is_empty();
        let dead = self.taken_over(daemon, &mut added);
        // Before the dead links let go of their stand-ins: rings and readers stay as they are.
        self.peers.with(daemon, |peer, with| peer.handle_remote_graph(now, with));
        self.end_dead(dead, now);
        let Some(peer) = self.peers.get(daemon) else { return 0 };
        let endpoints = peer.remote.len();
        // The control plane gets the whole graph of a silent peer once the peer is back.
        if !peer.silent {
            self.effects.tell(ToControl::RemoteGraph { daemon, reset, added, removed });
        }
        endpoints
    }

    /// Ends dead links. The control plane forgets their endpoints before it learns of the same ones of another link.
    fn end_dead(&mut self, dead: Vec<u64>, now: Duration) {
        for link in dead {
            self.links.replace(link, "its host's daemon was restarted", now);
        }
        while let Some(event) = self.links.poll_event() {
            self.handle_link_event(now, event);
        }
    }

    /// Handles a peer's request for a route. Ends the links of other daemons of the same host whose routes the same
    /// subscriptions requested. Those links are dead, and the new route begins with the samples that they did not
    /// carry.
    pub(super) fn take_over_route(&mut self, daemon: DaemonId, asks: &Subscribe, now: Duration) {
        let identity = |other| self.links.view(self.links.current(other)?)?.identity();
        let (Some(owner), Some(asking)) = (identity(daemon), self.peers.get(daemon)) else {
            return;
        };
        let others = self.peers.iter().filter(|(other, _)| *other != daemon);
        let same_host = others.filter(|(other, _)| identity(*other).as_ref() == Some(&owner));
        // A daemon ends links only for its own subscriptions: it may name subscriptions of other daemons, which it
        // reads in the graph.
        let own = asks.subscribers.iter().map(|reader| reader.gid);
        let own: Vec<_> = own.filter(|gid| asking.remote.owns(gid)).collect();
        let dead = same_host.filter(|(_, peer)| peer.serves_one_of(asks, &own));
        let dead: Vec<_> = dead.map(|(_, peer)| peer.link).collect();
        if !dead.is_empty() {
            self.end_dead(dead, now);
        }
    }

    /// Returns the links of peers whose endpoints a restarted daemon of the same host announces: those links are dead.
    /// The claim of another host is ignored and removed from `added`.
    fn taken_over(&mut self, daemon: DaemonId, added: &mut Vec<RemoteEndpoint>) -> Vec<u64> {
        let mut dead = Vec::new();
        let identity = |engine: &Self, daemon: DaemonId| {
            engine.links.view(engine.links.current(daemon)?)?.identity()
        };
        let Some(owner) = identity(self, daemon) else { return dead };
        let others: Vec<_> =
            self.peers.iter().map(|(other, _)| other).filter(|other| *other != daemon).collect();
        for other in others {
            let same_host = identity(self, other).is_some_and(|i| i == owner);
            let Some(peer) = self.peers.get(other) else { continue };
            let gids = added.iter().map(|e| e.endpoint.gid);
            let moved: Vec<_> = gids.filter(|gid| peer.remote.has(gid)).collect();
            if moved.is_empty() {
                continue;
            }
            if same_host {
                dead.push(peer.link);
                continue;
            }
            tracing::warn!(peer = %daemon, endpoints = moved.len(),
                "ignored endpoints announced by a peer: they belong to another peer");
            if let Some(claimer) = self.peers.get_mut(daemon) {
                claimer.remote.forget(&moved);
                claimer.displaced = true;
            }
            added.retain(|e| !moved.contains(&e.endpoint.gid));
        }
        dead
    }

    /// Asks peers again for the parts of their graphs that were left out and have room now.
    pub(super) fn resync(&mut self) {
        let freed = std::mem::take(&mut self.freed);
        for peer in self.peers.values_mut() {
            let displaced = freed && std::mem::take(&mut peer.displaced);
            if displaced || peer.remote.has_room_again() {
                let version = peer.remote.version();
                peer.say(LinkMessage::GraphResync(GraphResync { version }));
            }
        }
    }
}
