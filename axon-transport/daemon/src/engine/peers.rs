//! The peers with an elected link, and the state that all of them use.

use std::{
    cell::RefCell,
    collections::{HashMap, hash_map},
    rc::Rc,
    sync::Arc,
    time::Duration,
};

use axon_shm::ids::{DaemonId, Gid};
use axon_transport::config::{Config, TopicRule};

use super::{
    peer::{
        LocalEndpoints, LocalWriterCounts, Peer, PeerContext, kept_relays::KeptRelays,
        stalls::StallHistory,
    },
    rings::Rings,
    stand_in::StandIns,
};

/// Estimated cost of an update after a change of this host's graph, for each endpoint of both graphs. Samples get nine
/// times this cost as time before the next update.
const ENDPOINT: Duration = Duration::from_nanos(500);
const OTHERS: u32 = 9;
const LONGEST_PAUSE: Duration = Duration::from_millis(200);

/// All peers.
pub(super) struct LinkedPeers {
    all: HashMap<DaemonId, Peer>,
    config: Arc<Config>,
    rings: Rc<dyn Rings>,
    stand_ins: StandIns,
    stalls: RefCell<StallHistory>,
    kept: RefCell<KeptRelays>,
    local: LocalEndpoints,
    writers: LocalWriterCounts,
    waiting_for_room: bool,
    /// Readers with samples to take; the vector is kept for its memory.
    active: Vec<(Gid, Gid)>,
    /// The time of the next update after changes of this host's graph.
    follow_local_at: Duration,
}

impl LinkedPeers {
    /// Creates the collection without peers and without endpoints of this host.
    pub(super) fn new(config: Arc<Config>, rings: Rc<dyn Rings>) -> Self {
        Self {
            all: HashMap::new(),
            config,
            rings,
            stand_ins: StandIns::default(),
            stalls: RefCell::default(),
            kept: RefCell::default(),
            local: LocalEndpoints::new(),
            writers: LocalWriterCounts::default(),
            waiting_for_room: false,
            active: Vec::new(),
            follow_local_at: Duration::ZERO,
        }
    }

    /// Returns the endpoints of this host.
    pub(super) fn local(&self) -> &LocalEndpoints {
        &self.local
    }

    /// Adds a peer.
    pub(super) fn insert(&mut self, daemon: DaemonId, peer: Peer) {
        self.all.insert(daemon, peer);
    }

    /// Removes a peer.
    pub(super) fn remove(&mut self, daemon: DaemonId) -> Option<Peer> {
        self.all.remove(&daemon)
    }

    /// Returns whether there are no peers.
    pub(super) fn is_empty(&self) -> bool {
        self.all.is_empty()
    }

    /// Returns a peer.
    pub(super) fn get(&self, daemon: DaemonId) -> Option<&Peer> {
        self.all.get(&daemon)
    }

    /// Returns a peer.
    pub(super) fn get_mut(&mut self, daemon: DaemonId) -> Option<&mut Peer> {
        self.all.get_mut(&daemon)
    }

    /// Returns all peers.
    pub(super) fn iter(&self) -> impl Iterator<Item = (DaemonId, &Peer)> {
        self.all.iter().map(|(daemon, peer)| (*daemon, peer))
    }

    /// Returns all peers.
    pub(super) fn iter_mut(&mut self) -> impl Iterator<Item = (DaemonId, &mut Peer)> {
        self.all.iter_mut().map(|(daemon, peer)| (*daemon, peer))
    }

    /// Returns all peers.
    pub(super) fn values_mut(&mut self) -> hash_map::ValuesMut<'_, DaemonId, Peer> {
        self.all.values_mut()
    }

    /// Replaces `[[topic]]`. A rate applies once the limits of a peer are [renewed](Peer::set_permissions), and a
    /// priority applies to routes that are served from now on.
    pub(super) fn set_topics(&mut self, topics: Vec<TopicRule>) {
        if self.config.topics != topics {
            Arc::make_mut(&mut self.config).topics = topics;
        }
    }

    /// Calls `act` with a peer and the state that all peers use. Returns `None` if there is no such peer.
    pub(super) fn with<T>(
        &mut self,
        daemon: DaemonId,
        act: impl FnOnce(&mut Peer, &PeerContext<'_>) -> T,
    ) -> Option<T> {
        let Self { all, config, rings, stand_ins, stalls, kept, local, writers, .. } = self;
        let with = peer_context(config, &**rings, stand_ins, (stalls, kept), (local, writers));
        all.get_mut(&daemon).map(|peer| act(peer, &with))
    }

    /// Calls `each` with each peer and the state that all peers use.
    pub(super) fn with_each(&mut self, mut each: impl FnMut(&mut Peer, &PeerContext<'_>)) {
        let Self { all, config, rings, stand_ins, stalls, kept, local, writers, .. } = self;
        let with = peer_context(config, &**rings, stand_ins, (stalls, kept), (local, writers));
        all.values_mut().for_each(|peer| each(peer, &with));
    }

    /// Handles a change of this host's graph.
    pub(super) fn handle_local_graph(&mut self, now: Duration, local: LocalEndpoints) {
        self.writers = LocalWriterCounts::of(local.values().map(|(endpoint, _)| &**endpoint));
        self.local = local;
        let endpoints = self.all.values().map(|peer| peer.remote.len() + self.local.len());
        let took = ENDPOINT * u32::try_from(endpoints.sum::<usize>()).unwrap_or(u32::MAX);
        self.follow_local_at = now + (OTHERS * took).min(LONGEST_PAUSE);
        self.with_each(|peer, with| peer.handle_local_graph(now, with));
    }

    /// Returns when the peers should next be updated to the graph of this host. All changes until then are handled
    /// together.
    pub(super) fn follow_local_at(&self) -> Duration {
        self.follow_local_at
    }

    /// Handles samples that wait in rings, and room that readers made in them.
    pub(super) fn handle_rings(&mut self, now: Duration) {
        let mut active = std::mem::take(&mut self.active);
        self.rings.take_active(&mut active);
        for peer in self.all.values_mut() {
            peer.outbound.handle_active(now, &active);
            peer.inbound.handle_room();
        }
        active.clear();
        self.active = active;
    }

    /// Asks the rings to report room while a peer waits for it.
    pub(super) fn wait_for_room(&mut self) {
        let waiting = self.all.values().any(|peer| peer.inbound.waits_for_room());
        if waiting || self.waiting_for_room {
            self.waiting_for_room = waiting;
            self.rings.set_waiting_for_room(waiting);
        }
    }

    /// Keeps the KEEP_ALL relays of a peer that is gone, for the next daemon of its host.
    pub(super) fn keep_relays(&mut self, peer: &mut Peer, now: Duration) {
        peer.keep_relays(&mut self.kept.borrow_mut(), now);
    }

    /// Returns the number of kept relays.
    #[cfg(test)]
    pub(super) fn kept(&self) -> usize {
        self.kept.borrow().len()
    }

    /// Gives up the samples of kept relays whose time is over. Returns the samples, by topic, that a subscription misses
    /// or may miss.
    pub(super) fn give_up_relays(&mut self, now: Duration) -> Vec<(String, u64)> {
        let have_ended = |identity: &str, subscriptions: &[Gid]| {
            let mut peers = self.all.values().filter(|peer| peer.has_identity(identity)).peekable();
            peers.peek().is_some() && peers.all(|peer| peer.remote.lacks(subscriptions))
        };
        self.kept.borrow_mut().give_up(now, have_ended)
    }

    /// Returns whether samples of ended publishers are still being sent.
    pub(super) fn are_draining(&self) -> bool {
        self.all.values().any(Peer::is_draining)
    }

    /// Returns when a peer or a kept relay has work due.
    pub(super) fn poll_timeout(&self, now: Duration) -> Option<Duration> {
        let due = self.all.values().flat_map(|peer| {
            let turn = peer.stirred.then(|| {
                let account = peer.remote.account();
                now + account.turns.borrow_mut().wait(now)
            });
            let more = peer.inbound.has_work().then_some(now);
            let samples = [peer.inbound.poll_timeout(), peer.outbound.poll_timeout()];
            samples.into_iter().chain([peer.poll_timeout(now), turn, more])
        });
        due.flatten().chain(self.kept.borrow().poll_timeout()).min()
    }

    /// Does the work that is due, except for samples to peers, which need their links.
    pub(super) fn handle_timeout(&mut self, now: Duration) {
        self.with_each(|peer, with| {
            peer.inbound.handle_timeout(now);
            if peer.poll_timeout(now).is_some_and(|due| due <= now) {
                peer.handle_timeout(now, with);
            }
        });
    }
}

fn peer_context<'a>(
    config: &'a Config,
    rings: &'a dyn Rings,
    stand_ins: &'a StandIns,
    (stalls, kept): (&'a RefCell<StallHistory>, &'a RefCell<KeptRelays>),
    (local, writers): (&'a LocalEndpoints, &'a LocalWriterCounts),
) -> PeerContext<'a> {
    PeerContext { rings, stand_ins, local, writers, config, stalls, kept }
}
