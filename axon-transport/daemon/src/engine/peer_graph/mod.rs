//! The graph of a peer as this side holds it: as much of it as fits in the peer's account. The submodules hold the
//! graph that was sent to a peer, and the proofs that sessions belong to their daemons.

pub(super) mod advertised;
pub(super) mod decisions;
mod omitted;
pub(super) mod owners;
mod terms;

use std::{
    collections::{BTreeMap, BTreeSet},
    rc::Rc,
    sync::Arc,
    time::Duration,
};

use axon_shm::ids::{DaemonId, Gid};
use axon_transport::{
    access::Permissions,
    graph::Endpoint,
    internal::graph::{LIMITS, RemoteEndpoint, permits},
};

use self::{decisions::note_look, omitted::OmittedEndpoints, owners::Proven, terms::GraphTerms};
use crate::{
    engine::account::{Account, Charge},
    link::GraphUpdate,
    owner::{ChannelBinding, Proof, SessionPrefix, prefix_of},
};

/// The changes of a peer's graph.
#[derive(Debug)]
pub(crate) struct PeerGraphChange {
    /// True if the changes replace everything that was known of the peer.
    pub(crate) reset: bool,
    /// Endpoints that were added or changed.
    pub(crate) added: Vec<RemoteEndpoint>,
    /// Endpoints that were removed.
    pub(crate) removed: Vec<Gid>,
}

/// The result of a GRAPH message.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum GraphTaken {
    /// The message was applied. `whole`: it was the end of a whole graph.
    Changed { whole: bool },
    /// More parts of the whole graph must follow.
    Part,
    /// A version is missing, so the whole graph must be requested.
    Gap,
}

/// An endpoint of the peer.
#[derive(Clone, Debug)]
struct HeldEndpoint {
    remote: RemoteEndpoint,
    /// True if access rules deny the endpoint: it does not exist for the rest of this host.
    denied: bool,
    /// True if access rules of the peer deny this host the other end: the endpoint is shown, and is in no
    /// pair.
    closed: bool,
    _charge: Rc<Charge>,
}

/// The graph of one peer.
#[derive(Debug)]
pub(crate) struct PeerGraph {
    account: Rc<Account>,
    proven: Proven,
    permissions: Permissions,
    all: BTreeMap<Gid, HeldEndpoint>,
    version: u64,
    /// The part of a whole graph that has arrived so far.
    gathered: Option<BTreeMap<Gid, HeldEndpoint>>,
    /// Endpoints that were added, changed or removed since the last call of [`changes`](Self::changes).
    changed: BTreeSet<Gid>,
    /// True if nothing of the graph was reported yet.
    fresh: bool,
    left_out: OmittedEndpoints,
}

impl PeerGraph {
    /// Creates an empty graph. `proofs`: the peer must prove its sessions. The permissions are the peer's
    /// rights.
    pub(crate) fn new(account: Rc<Account>, proofs: bool, permissions: Permissions) -> Self {
        let proven = Proven::new(proofs, Rc::clone(&account.sessions));
        Self {
            account,
            proven,
            permissions,
            all: BTreeMap::new(),
            version: 0,
            gathered: None,
            changed: BTreeSet::new(),
            fresh: true,
            left_out: OmittedEndpoints::default(),
        }
    }

    /// Takes in a GRAPH message, as far as there is space.
    pub(crate) fn take(&mut self, graph: GraphUpdate) -> GraphTaken {
        let GraphUpdate { version, before, added, removed, more, localhost, listing, denied } =
            graph;
        let terms = GraphTerms::new([localhost, listing, denied]);
        if before == 0 {
            self.gathered = Some(BTreeMap::new());
            self.left_out = OmittedEndpoints::default();
        } else if before != self.version {
            return GraphTaken::Gap;
        }
        self.version = version;
        if let Some(mut gathered) = self.gathered.take() {
            for endpoint in added {
                self.gather(&mut gathered, endpoint, &terms);
            }
            if more {
                self.gathered = Some(gathered);
                return GraphTaken::Part;
            }
            let old = std::mem::replace(&mut self.all, gathered);
            let same = |held: &HeldEndpoint, other: Option<&HeldEndpoint>| {
                other.is_some_and(|other| {
                    let (held, other) = (&held.remote, &other.remote);
                    Arc::ptr_eq(&held.endpoint, &other.endpoint) && held.toward == other.toward
                })
            };
            let came = self.all.iter().filter(|(gid, held)| !same(held, old.get(gid)));
            self.changed.extend(came.map(|(gid, _)| *gid));
            self.changed.extend(old.keys().filter(|gid| !self.all.contains_key(gid)));
            self.proven.settle();
            return GraphTaken::Changed { whole: true };
        }
        for gid in removed {
            if self.all.remove(&gid).is_some() {
                self.changed.insert(gid);
            }
        }
        for endpoint in added {
            let gid = endpoint.gid;
            if !self.proven.owns(&gid) {
                self.left_out.add_unproven(&endpoint);
                continue;
            }
            // The replaced endpoint makes room for the new one.
            let before = self.all.remove(&gid);
            let known = before.is_some();
            drop(before);
            let held = self.hold(endpoint, &terms, self.all.len());
            if known || held.is_some() {
                self.changed.insert(gid);
            }
            self.all.extend(held.map(|held| (gid, held)));
        }
        self.proven.settle();
        GraphTaken::Changed { whole: false }
    }

    /// Adds an endpoint to a whole graph. A known endpoint takes no further memory.
    fn gather(
        &mut self,
        gathered: &mut BTreeMap<Gid, HeldEndpoint>,
        endpoint: Endpoint,
        terms: &GraphTerms,
    ) {
        let gid = endpoint.gid;
        let held = match self.all.get(&gid) {
            _ if !self.proven.owns(&gid) => {
                self.left_out.add_unproven(&endpoint);
                None
            }
            Some(known) if *known.remote.endpoint == endpoint => {
                let remote = RemoteEndpoint { toward: terms.toward(&gid), ..known.remote.clone() };
                Some(HeldEndpoint { remote, closed: terms.denies(&gid), ..known.clone() })
            }
            _ => self.hold(endpoint, terms, gathered.len()),
        };
        gathered.extend(held.map(|held| (gid, held)));
    }

    /// Moves to another connection, on which the peer must prove its sessions again before it describes them.
    pub(crate) fn succeed(&mut self) {
        self.proven.succeed();
    }

    /// Takes in the proofs of the peer's daemon on the connection with this `binding`.
    pub(crate) fn prove(
        &mut self,
        proofs: &[Proof],
        binding: &ChannelBinding,
        from: DaemonId,
        now: Duration,
    ) {
        let all = &self.all;
        let used = |session: &SessionPrefix| {
            let mut first = [0; 16];
            first[..session.len()].copy_from_slice(session);
            let next = all.range(Gid(first)..).next();
            next.is_some_and(|(gid, _)| prefix_of(gid) == *session)
        };
        self.proven.take(proofs, binding, from, used, now);
    }

    /// Returns whether the peer may speak for an endpoint of this GID.
    pub(crate) fn owns(&self, gid: &Gid) -> bool {
        self.proven.owns(gid)
    }

    /// Records a reader in the peer's SUBSCRIBE that is left out.
    pub(crate) fn disown_reader(&mut self, gid: &Gid, topic: &str) {
        self.left_out.add_unproven_reader(gid, topic);
    }

    fn hold(
        &mut self,
        endpoint: Endpoint,
        terms: &GraphTerms,
        beside: usize,
    ) -> Option<HeldEndpoint> {
        let bytes = endpoint.bytes();
        if beside < LIMITS.endpoints
            && let Some(charge) = self.account.graph.charge(bytes)
        {
            let (toward, closed) = (terms.toward(&endpoint.gid), terms.denies(&endpoint.gid));
            let remote = RemoteEndpoint { endpoint: Arc::new(endpoint), toward };
            note_look();
            let denied = !permits(&self.permissions, &remote.endpoint);
            return Some(HeldEndpoint { remote, denied, closed, _charge: Rc::new(charge) });
        }
        if beside < LIMITS.endpoints {
            let most = self.account.graph.most() >> 20;
            let has = || format!("more than {most} MiB ([link] graph_mb here)");
            self.left_out.add_for_room(&endpoint, Some(bytes), has);
        } else {
            let has = || format!("more than {} endpoints", LIMITS.endpoints);
            self.left_out.add_for_room(&endpoint, None, has);
        }
        None
    }

    /// Reports the whole graph from now on.
    pub(crate) fn tell_anew(&mut self) {
        self.fresh = true;
        self.changed.extend(self.all.keys());
    }

    /// Returns the changes since the last call.
    pub(crate) fn changes(&mut self) -> PeerGraphChange {
        let reset = std::mem::replace(&mut self.fresh, false);
        let (mut added, mut removed) = (Vec::new(), Vec::new());
        for gid in std::mem::take(&mut self.changed) {
            match self.all.get(&gid).filter(|held| !held.denied) {
                Some(held) => added.push(held.remote.clone()),
                None => removed.push(gid),
            }
        }
        PeerGraphChange { reset, added, removed }
    }

    /// Returns the first endpoint that was left out of the graph, with the reason; `None` if the graph is complete.
    pub(crate) fn refused(&self) -> Option<&str> {
        self.left_out.first()
    }

    /// Returns the number of endpoints that were left out since the peer last sent its whole graph.
    pub(crate) fn left_out(&self) -> u64 {
        self.left_out.count()
    }

    /// Returns whether the peer sent its whole graph, and none of these endpoints is in it.
    pub(crate) fn lacks(&self, endpoints: &[Gid]) -> bool {
        let is_whole = self.version > 0 && self.gathered.is_none() && self.left_out() == 0;
        is_whole && !endpoints.iter().any(|gid| self.all.contains_key(gid))
    }

    /// Returns whether there is room now for the first left-out endpoint, so that the whole graph is worth
    /// requesting.
    pub(crate) fn has_room_again(&self) -> bool {
        let needed = self.left_out.needed();
        self.gathered.is_none() && needed.is_some_and(|n| self.account.graph.charge(n).is_some())
    }

    /// Returns the version that this side holds.
    pub(crate) fn version(&self) -> u64 {
        self.version
    }

    /// Returns the number of endpoints.
    pub(crate) fn len(&self) -> usize {
        self.all.len()
    }

    /// Returns the peer's account.
    pub(crate) fn account(&self) -> &Rc<Account> {
        &self.account
    }

    /// Returns one endpoint.
    pub(crate) fn get(&self, gid: &Gid) -> Option<&Endpoint> {
        self.all.get(gid).map(|held| &*held.remote.endpoint)
    }

    /// Replaces the access rules, and judges each endpoint by them.
    pub(crate) fn set_permissions(&mut self, permissions: Permissions) {
        self.permissions = permissions;
        for (gid, held) in self.all.iter_mut().chain(self.gathered.iter_mut().flatten()) {
            note_look();
            let denied = !permits(&self.permissions, &held.remote.endpoint);
            if std::mem::replace(&mut held.denied, denied) != denied {
                self.changed.insert(*gid);
            }
        }
    }

    /// Returns the endpoints that access rules deny.
    pub(crate) fn denied(&self) -> impl Iterator<Item = &Endpoint> {
        self.all.values().filter(|held| held.denied).map(|held| &*held.remote.endpoint)
    }

    /// Returns whether the graph has this endpoint, as reported by [`changes`](Self::changes).
    pub(crate) fn has(&self, gid: &Gid) -> bool {
        let held = self.all.get(gid).is_some_and(|held| !held.denied);
        held && !self.changed.contains(gid)
    }

    /// Returns the endpoints that access rules permit.
    pub(crate) fn endpoints(&self) -> impl Iterator<Item = &RemoteEndpoint> {
        self.all.values().filter(|held| !held.denied).map(|held| &held.remote)
    }

    /// Returns the endpoints that the access rules of both hosts allow in pairs with this host's.
    pub(crate) fn usable(&self) -> impl Iterator<Item = &RemoteEndpoint> {
        self.all.values().filter(|held| !held.denied && !held.closed).map(|held| &held.remote)
    }

    /// Removes endpoints that belong to another daemon.
    pub(crate) fn forget(&mut self, gids: &[Gid]) {
        for gid in gids {
            self.all.remove(gid);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use axon_transport::{graph::EndpointKind, internal::SessionKey};

    use crate::{engine::account::Accounts, owner::prove};

    const NOW: Duration = Duration::from_secs(1000);

    fn endpoint(number: u8, name: &str) -> Endpoint {
        Endpoint::new(Gid([number; 16]), EndpointKind::Publisher, name, "T").with_node("n", "/")
    }

    fn graph(before: u64, added: Vec<Endpoint>, removed: Vec<Gid>, more: bool) -> GraphUpdate {
        let version = before + 1;
        GraphUpdate { version, before, added, removed, more, ..GraphUpdate::default() }
    }

    fn one() -> usize {
        endpoint(1, "/t").bytes()
    }

    /// Returns the GIDs of the added and of the removed endpoints.
    fn changes(remote: &mut PeerGraph) -> (Vec<u8>, Vec<u8>) {
        let PeerGraphChange { added, removed, .. } = remote.changes();
        let first = |gid: &Gid| gid.0[0];
        (
            added.iter().map(|e| first(&e.endpoint.gid)).collect(),
            removed.iter().map(first).collect(),
        )
    }

    #[test]
    fn session_proofs_of_one_connection_are_void_on_the_next() {
        let account = Accounts::new(10 * one(), 1 << 20).of_one("a");
        let mut remote = PeerGraph::new(account, true, Permissions::default());
        let key = SessionKey::generate().unwrap();
        let (own, from) = (Gid::new(key.id(), 1), DaemonId([7; 16]));
        let [first, second] = [[1; 32], [2; 32]];
        let all = || {
            graph(
                0,
                vec![{
                    let mut endpoint = endpoint(1, "/t");
                    endpoint.gid = own;
                    endpoint
                }],
                vec![],
                false,
            )
        };
        remote.prove(&[prove(&key, &first, from).unwrap()], &first, from, NOW);
        remote.take(all());
        assert_eq!((remote.left_out(), changes(&mut remote).0.len()), (0, 1));
        remote.succeed();
        assert!(!remote.owns(&own));
        // The old proof is for the other connection.
        remote.prove(&[prove(&key, &first, from).unwrap()], &second, from, NOW);
        remote.take(all());
        assert_eq!((remote.left_out(), changes(&mut remote).1.len()), (1, 1));
        remote.prove(&[prove(&key, &second, from).unwrap()], &second, from, NOW);
        remote.take(all());
        assert_eq!((remote.left_out(), changes(&mut remote).0.len()), (0, 1));
    }

    #[test]
    fn endpoints_beyond_the_quota_are_omitted_by_name_and_the_rest_accepted() {
        let account = Accounts::new(2 * one(), 1 << 20).of_one("a");
        let (mut remote, mut other) = (
            PeerGraph::new(Rc::clone(&account), false, Permissions::default()),
            PeerGraph::new(Rc::clone(&account), false, Permissions::default()),
        );
        assert_eq!(
            remote.take(graph(0, vec![endpoint(1, "/t")], vec![], false)),
            GraphTaken::Changed { whole: true }
        );
        // The same identity under another daemon ID.
        other.take(graph(0, vec![endpoint(2, "/t"), endpoint(3, "/u")], vec![], false));
        assert_eq!(changes(&mut other), (vec![2], vec![]));
        assert!(other.refused().unwrap().contains("the publisher of \"/u\" in node \"n\""));
        assert_eq!((other.left_out(), other.has_room_again()), (1, false));
        assert_eq!(remote.refused(), None);
        // One endpoint goes: there is room for another, and for the left-out one.
        remote.take(graph(1, vec![], vec![Gid([1; 16])], false));
        assert!(other.has_room_again());
        other.take(graph(0, vec![endpoint(2, "/t"), endpoint(3, "/u")], vec![], false));
        assert_eq!((changes(&mut other), other.refused()), ((vec![3], vec![]), None));
        drop(other);
        assert_eq!(account.graph.held(), 0);
    }

    #[test]
    fn a_whole_graph_that_is_said_again_takes_no_more_and_changes_nothing() {
        let account = Accounts::new(3 * one(), 1 << 20).of_one("a");
        let mut remote = PeerGraph::new(Rc::clone(&account), false, Permissions::default());
        let all = || (1..=3).map(|n| endpoint(n, "/t")).collect::<Vec<_>>();
        remote.take(graph(0, all(), vec![], false));
        assert_eq!(changes(&mut remote), (vec![1, 2, 3], vec![]));
        let mut parts = all().into_iter();
        let first = parts.next().into_iter().collect();
        assert_eq!(remote.take(graph(0, first, vec![], true)), GraphTaken::Part);
        assert_eq!(remote.len(), 3, "until all of it is there");
        let rest = vec![parts.next().unwrap(), endpoint(4, "/t")];
        remote.take(graph(1, rest, vec![], false));
        // The removed endpoint had not made room yet when the new one arrived.
        assert_eq!((changes(&mut remote), remote.left_out()), ((vec![], vec![3]), 1));
        assert!(remote.has_room_again());
        assert_eq!(account.graph.held(), 2 * one());
    }

    #[test]
    fn an_endpoint_whose_use_the_peer_denies_is_told_of_and_not_usable() {
        let mut remote = PeerGraph::new(
            Accounts::new(1 << 20, 1 << 30).of_one("a"),
            false,
            Permissions::default(),
        );
        let both = || vec![endpoint(1, "/t"), endpoint(2, "/t")];
        let usable =
            |remote: &PeerGraph| remote.usable().map(|e| e.endpoint.gid.0[0]).collect::<Vec<_>>();
        for (before, denied, left) in [(0, 1, 2), (1, 2, 1), (0, 1, 2)] {
            let denied = Some(vec![Gid([denied; 16])]);
            remote.take(GraphUpdate { denied, ..graph(before, both(), vec![], false) });
            assert_eq!((usable(&remote), remote.endpoints().count()), (vec![left], 2));
        }
        assert_eq!(changes(&mut remote), (vec![1, 2], vec![]));
        remote.take(graph(0, both(), vec![], false));
        assert_eq!((usable(&remote), changes(&mut remote)), (vec![1, 2], (vec![], vec![])));
    }

    #[test]
    fn the_newest_state_of_an_endpoint_counts_once() {
        let mut remote = PeerGraph::new(
            Accounts::new(1 << 20, 1 << 20).of_one("a"),
            false,
            Permissions::default(),
        );
        remote.take(graph(0, vec![endpoint(1, "/t")], vec![], false));
        changes(&mut remote);
        for before in (1..100).step_by(2) {
            remote.take(graph(before, vec![], vec![Gid([1; 16])], false));
            remote.take(graph(
                before + 1,
                vec![endpoint(1, "/u"), endpoint(2, "/t")],
                vec![],
                false,
            ));
        }
        assert_eq!(remote.get(&Gid([1; 16])).unwrap().topic, "/u");
        assert_eq!(changes(&mut remote), (vec![1, 2], vec![]));
        assert_eq!(remote.take(graph(7, vec![], vec![], false)), GraphTaken::Gap);
    }

    #[test]
    fn endpoint_of_an_unproven_session_is_omitted() {
        let (own, others) = (SessionKey::generate().unwrap(), SessionKey::generate().unwrap());
        let (binding, here) = ([7; 32], DaemonId([1; 16]));
        let mut remote = PeerGraph::new(
            Accounts::new(1 << 20, 1 << 20).of_one("a"),
            true,
            Permissions::default(),
        );
        remote.prove(&[prove(&own, &binding, here).unwrap()], &binding, here, NOW);
        // The proof of another host, for another connection.
        remote.prove(&[prove(&others, &[8; 32], here).unwrap()], &binding, here, NOW);
        let of = |key: &SessionKey, topic| {
            let mut endpoint = endpoint(0, topic);
            endpoint.gid = Gid::new(key.id(), 1);
            endpoint
        };
        for before in [0, 1] {
            let added = vec![of(&others, "/squatted"), of(&own, "/t")];
            remote.take(graph(before, added, vec![], false));
            assert_eq!((remote.len(), remote.left_out()), (1, before + 1));
            assert!(remote.owns(&Gid::new(own.id(), 9)) && !remote.owns(&Gid::new(others.id(), 1)));
        }
        assert!(remote.refused().unwrap().contains("\"/squatted\""));
        assert!(!remote.has_room_again());
    }
}
