//! The graph across links: what peers are told, and the routes that follow from what they tell.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use axon_shm::ids::{DaemonId, Gid};
use axon_transport::internal::graph::{RemoteEndpoint, reach_of};

use super::{Event, Hub};
use crate::{
    gateway::{
        bridge::ToControl,
        establish::close,
        keyring::lock,
        peer::{GraphChange, Peer},
    },
    link::{CloseCode, GraphResync, Message},
};

impl Hub {
    /// The local graph changed: peers are told, and routes follow.
    pub(super) async fn local_graph(&mut self) {
        let view = self.shared.session.graph();
        self.local = view
            .endpoints
            .values()
            .filter(|e| e.daemon.is_none())
            // One of which nothing is known goes nowhere.
            .filter_map(|e| {
                Some((e.endpoint.gid, (Arc::clone(&e.endpoint), reach_of(e).cloned()?)))
            })
            .collect();
        for peer in self.peers.values_mut() {
            peer.keep_ending(&self.local);
            peer.send_graph(&self.local, false);
            peer.update(&self.local, &self.shared);
        }
        self.tell_draining().await;
    }

    /// Nothing is left of what a publisher here left for a peer.
    pub(super) async fn drained(&mut self, daemon: DaemonId, publisher: Gid) {
        if let Some(peer) = self.peers.get_mut(&daemon) {
            peer.drained(&publisher, &self.local);
        }
        self.tell_draining().await;
    }

    /// A peer does not read what it asked for: it is served no more, for a while.
    pub(super) async fn stalled(&mut self, daemon: DaemonId, route: u32) {
        let Some(peer) = self.peers.get_mut(&daemon) else { return };
        let Some(stalled) = peer.stalled(route, &self.shared) else { return };
        peer.update_services(&self.local, &self.shared);
        let (number, counters) = (peer.link, peer.counters.counting());
        let Some(link) = self.links.get(&number) else { return };
        let (who, events) = (self.peer_of(link), self.events.clone());
        let (topic, reason) = (stalled.topic, stalled.reason);
        let what = format!("topic {topic}");
        self.tell(ToControl::Refusal { peer: who, what, reason }).await;
        tokio::spawn(async move {
            // The code that ends it counts the samples in flight.
            let samples = stalled.samples.await.unwrap_or(0);
            counters.dropped("stalled", samples);
            tracing::warn!(topic, samples, "samples are lost: a peer does not read the topic");
            // An error: the hub is gone.
            let _ =
                events.send(Event::Lost { topic: topic.into(), cause: "stalled", samples }).await;
        });
    }

    /// The daemon does not end while something is on its way.
    pub(super) async fn tell_draining(&mut self) {
        let draining = self.peers.values().any(Peer::is_draining);
        if std::mem::replace(&mut self.draining, draining) != draining {
            self.tell(ToControl::Draining(draining)).await;
        }
    }

    /// How long it is until what changed in a peer's graph is to be followed up.
    pub(super) fn turn_in(&self, now: Instant) -> Option<Duration> {
        let stirred = self.peers.values().filter(|peer| peer.stirred);
        stirred.map(|peer| lock(&peer.remote.account().turns).wait(now)).min()
    }

    /// Follows up what changed in the graphs of peers whose turn it is.
    pub(super) async fn take_turns(&mut self) {
        let stirred = self.peers.iter().filter(|(_, peer)| peer.stirred);
        let stirred: Vec<_> = stirred.map(|(daemon, _)| *daemon).collect();
        for daemon in stirred {
            self.take_turn(daemon).await;
        }
    }

    /// Follows up what changed in a peer's graph, if it is its turn.
    pub(super) async fn take_turn(&mut self, daemon: DaemonId) {
        let Some(peer) = self.peers.get_mut(&daemon) else { return };
        let (account, began) = (Arc::clone(peer.remote.account()), Instant::now());
        if !lock(&account.turns).take(began) {
            return;
        }
        peer.stirred = false;
        self.remote_graph(daemon).await;
        lock(&account.turns).over(began, Instant::now());
    }

    /// The graph of a peer changed: routes follow, and the control plane is told.
    async fn remote_graph(&mut self, daemon: DaemonId) {
        let Some(peer) = self.peers.get_mut(&daemon) else { return };
        let number = peer.link;
        if let Some(refused) = peer.newly_refused() {
            self.refused_in_part(number, "graph", refused).await;
        }
        let Some(peer) = self.peers.get_mut(&daemon) else { return };
        let GraphChange { reset, mut added, removed } = peer.remote.changes();
        // An endpoint is its host's: nobody elsewhere speaks for one of ours, or for the gateway.
        let own = self.shared.session.id().0;
        let ours: Vec<_> = added
            .iter()
            .map(|e| e.endpoint.gid)
            .filter(|gid| self.local.contains_key(gid) || gid.0[..12] == own[..12])
            .collect();
        if !ours.is_empty() {
            tracing::warn!(peer = %daemon, endpoints = ours.len(),
                "ignored endpoints announced by a peer: they belong to this host");
            added.retain(|e| !ours.contains(&e.endpoint.gid));
            if let Some(peer) = self.peers.get_mut(&daemon) {
                peer.remote.forget(&ours);
            }
        }
        self.freed |= !removed.is_empty();
        let dead = self.taken_over(daemon, &added);
        // Before the dead links let go of their stand-ins: rings and readers stay as they are.
        if let Some(peer) = self.peers.get_mut(&daemon) {
            // Sessions there may list this host now, or no more.
            peer.send_graph(&self.local, false);
            peer.update(&self.local, &self.shared);
        }
        for link in dead {
            let text = "its host's daemon was restarted";
            if let Some(l) = self.links.get(&link) {
                close(&l.connection, CloseCode::Replaced, text);
            }
            self.link_ended(link, text).await;
        }
        self.tell(ToControl::RemoteGraph { daemon, reset, added, removed }).await;
    }

    /// A restarted daemon announces the endpoints of its predecessor, whose link may not have timed
    /// out yet: that link is dead, if both are the same host by what they proved. Somebody else's
    /// claim is ignored.
    fn taken_over(&mut self, daemon: DaemonId, added: &[RemoteEndpoint]) -> Vec<u64> {
        let mut dead = Vec::new();
        let Some(owner) = self.identity_of(daemon) else { return dead };
        let others: Vec<_> = self.peers.keys().filter(|d| **d != daemon).copied().collect();
        for other in others {
            let same_host = self.identity_of(other).is_some_and(|i| i == owner);
            let Some(peer) = self.peers.get_mut(&other) else { continue };
            let has = |gid: &Gid| peer.remote.has(gid);
            let moved: Vec<_> = added.iter().map(|e| e.endpoint.gid).filter(has).collect();
            if moved.is_empty() {
                continue;
            }
            if !same_host {
                tracing::warn!(peer = %daemon, endpoints = moved.len(),
                    "ignored endpoints announced by a peer: they belong to another peer");
                if let Some(claimer) = self.peers.get_mut(&daemon) {
                    claimer.remote.forget(&moved);
                    claimer.displaced = true;
                }
                continue;
            }
            dead.push(peer.link);
        }
        dead
    }

    /// Asks peers for their graph of which something was left out and need not be any more, and sends them
    /// this host's that they asked for.
    pub(super) fn resync(&mut self) {
        let freed = std::mem::take(&mut self.freed);
        for peer in self.peers.values_mut() {
            peer.resync_if_due(&self.local);
            let displaced = freed && std::mem::take(&mut peer.displaced);
            if displaced || peer.remote.has_room_again() {
                let version = peer.remote.version();
                peer.say(Message::GraphResync(GraphResync { version }));
            }
        }
    }

    /// Something of a peer's is refused, and its link stands.
    pub(super) async fn refused_in_part(&self, number: u64, what: &str, reason: String) {
        let Some(link) = self.links.get(&number) else { return };
        let peer = format!("{} at {}", link.established.who, link.connection.remote_address());
        self.tell(ToControl::Refusal { peer, what: what.to_owned(), reason }).await;
    }

    /// What a peer proved to be, beyond its daemon id.
    pub(super) fn identity_of(&self, daemon: DaemonId) -> Option<String> {
        let link = self.links.get(&self.peers.get(&daemon)?.link)?;
        Some(link.established.who.host_identity(link.connection.remote_address()))
    }
}
