//! Proofs that a session belongs to a daemon: the proofs that this daemon sends to a peer, and those that the
//! peer sends.

use std::{
    collections::{BTreeSet, HashMap, HashSet},
    rc::Rc,
    sync::Arc,
    time::Duration,
};

use axon_shm::ids::{DaemonId, Gid};
use axon_transport::internal::SessionKey;

use crate::{
    engine::account::{Charge, Meter},
    link::{LinkMessage, MAX_PROOFS, Owners},
    owner::{ChannelBinding, Proof, SessionKeys, SessionPrefix, prefix, prefix_of, prove},
};

/// Shortest time between two searches for sessions without endpoints, when there are too many sessions.
const SWEEP: Duration = Duration::from_secs(1);

/// Proves to one peer that sessions belong to this daemon.
pub(crate) struct Prover {
    keys: Arc<SessionKeys>,
    daemon: DaemonId,
    /// True if proofs are required: they are if peers authenticate.
    needed: bool,
    binding: Option<ChannelBinding>,
    /// The sessions whose proofs for the current connection the peer has.
    proved: HashSet<SessionPrefix>,
    /// The proofs for the current connection. They stay valid as long as the connection does.
    made: HashMap<SessionPrefix, Proof>,
    /// The keys of sessions that the peer sees. An ended publisher is visible for longer than its session is
    /// connected.
    held: HashMap<SessionPrefix, Arc<SessionKey>>,
}

impl Prover {
    /// Proves sessions of `daemon` on the connection with this binding, if `needed`.
    pub(crate) fn new(
        keys: &Arc<SessionKeys>,
        daemon: DaemonId,
        needed: bool,
        binding: Option<ChannelBinding>,
    ) -> Self {
        let mut prover = Self {
            keys: Arc::clone(keys),
            daemon,
            needed,
            binding: None,
            proved: HashSet::new(),
            made: HashMap::new(),
            held: HashMap::new(),
        };
        prover.succeed(binding);
        prover
    }

    /// Returns whether proofs are required.
    pub(crate) fn is_needed(&self) -> bool {
        self.needed
    }

    /// Moves to another connection, on which all sessions must be proved again.
    pub(crate) fn succeed(&mut self, binding: Option<ChannelBinding>) {
        self.binding = binding.filter(|_| self.needed);
        self.made.clear();
        self.forget();
    }

    /// Makes every proof due again, because the peer asks for everything.
    pub(crate) fn forget(&mut self) {
        self.proved.clear();
    }

    /// Returns the proofs that the peer lacks for endpoints of these GIDs.
    pub(crate) fn owed<'a>(&mut self, gids: impl Iterator<Item = &'a Gid>) -> Vec<LinkMessage> {
        let Some(binding) = self.binding else { return Vec::new() };
        let sessions: BTreeSet<SessionPrefix> = gids.map(prefix_of).collect();
        self.proved.retain(|session| sessions.contains(session));
        self.made.retain(|session, _| sessions.contains(session));
        self.held.retain(|session, _| sessions.contains(session));
        let mut proofs = Vec::new();
        for session in sessions {
            if self.proved.contains(&session) {
                continue;
            }
            if let Some(key) = self.keys.get(&session) {
                self.held.insert(session, key);
            }
            // A signature costs time: one for each session and connection.
            if !self.made.contains_key(&session)
                && let Some(key) = self.held.get(&session)
                && let Some(proof) = prove(key, &binding, self.daemon)
            {
                self.made.insert(session, proof);
            }
            if let Some(proof) = self.made.get(&session) {
                self.proved.insert(session);
                proofs.push(proof.clone());
            }
        }
        let parts = proofs.chunks(MAX_PROOFS);
        parts.map(|part| LinkMessage::Owners(Owners { proofs: part.to_vec() })).collect()
    }
}

/// The sessions that a peer proved to own.
#[derive(Debug)]
pub(crate) struct Proven {
    /// True if proofs are required: they are if peers authenticate.
    needed: bool,
    /// The bound on sessions, over all daemon IDs of the peer's identity.
    room: Rc<Meter>,
    sessions: HashMap<SessionPrefix, Charge>,
    /// Sessions that were proved since the last GRAPH. The next one may contain their endpoints.
    fresh: HashMap<SessionPrefix, Charge>,
    swept: Option<Duration>,
}

impl Proven {
    pub(crate) fn new(needed: bool, room: Rc<Meter>) -> Self {
        Self { needed, room, sessions: HashMap::new(), fresh: HashMap::new(), swept: None }
    }

    /// Takes in proofs of the daemon `from`. `used` returns whether a session has endpoints. If there are too
    /// many sessions, those without endpoints are forgotten.
    pub(crate) fn take(
        &mut self,
        proofs: &[Proof],
        binding: &ChannelBinding,
        from: DaemonId,
        used: impl Fn(&SessionPrefix) -> bool,
        now: Duration,
    ) {
        if !self.needed {
            return;
        }
        for proof in proofs {
            let session = prefix(&proof.claims());
            // A signature takes time to verify, so a known session is not verified again.
            if self.has(&session) {
                continue;
            }
            if self.room.left() == 0
                && self.swept.is_none_or(|swept| now.saturating_sub(swept) >= SWEEP)
            {
                self.swept = Some(now);
                self.sessions.retain(|session, _| used(session));
            }
            if let Some(charge) = self.room.charge(1)
                && proof.session(binding, from).is_some()
            {
                self.fresh.insert(session, charge);
            }
        }
    }

    /// Moves to another connection: proofs of the previous connection do not count any more.
    pub(crate) fn succeed(&mut self) {
        self.sessions.clear();
        self.fresh.clear();
    }

    /// Handles the end of a GRAPH: a session that it does not mention has no endpoint yet.
    pub(crate) fn settle(&mut self) {
        self.sessions.extend(self.fresh.drain());
    }

    /// Returns whether the peer may speak for this endpoint.
    pub(crate) fn owns(&self, gid: &Gid) -> bool {
        !self.needed || self.has(&prefix_of(gid))
    }

    fn has(&self, session: &SessionPrefix) -> bool {
        self.sessions.contains_key(session) || self.fresh.contains_key(session)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::account::MAX_PROVEN;

    const BINDING: ChannelBinding = [7; 32];
    const HERE: DaemonId = DaemonId([1; 16]);

    fn key() -> SessionKey {
        SessionKey::generate().unwrap()
    }

    fn gid(key: &SessionKey) -> Gid {
        Gid::new(key.id(), 3)
    }

    const NOW: Duration = Duration::from_secs(1000);

    fn proof(key: &SessionKey) -> Proof {
        prove(key, &BINDING, HERE).unwrap()
    }

    /// Adds sessions until the bound is reached.
    fn fill(proven: &mut Proven) {
        for number in proven.sessions.len() as u64.. {
            let Some(charge) = proven.room.charge(1) else { break };
            let mut prefix = [0; 12];
            prefix[..8].copy_from_slice(&number.to_be_bytes());
            proven.sessions.insert(prefix, charge);
        }
    }

    fn full_of(sessions: impl IntoIterator<Item = SessionPrefix>) -> Proven {
        let mut proven = Proven::new(true, Meter::new(MAX_PROVEN));
        for session in sessions {
            let charge = proven.room.charge(1).unwrap();
            proven.sessions.insert(session, charge);
        }
        fill(&mut proven);
        proven
    }

    #[test]
    fn sessions_count_over_all_daemon_ids_of_an_identity() {
        let mut one = full_of([]);
        let mut other = Proven::new(true, Rc::clone(&one.room));
        let (first, second) = (key(), key());
        other.take(&[proof(&first)], &BINDING, HERE, |_| true, NOW);
        assert!(!other.owns(&gid(&first)), "the other id has them all");
        one.succeed();
        other.take(&[proof(&second)], &BINDING, HERE, |_| true, NOW);
        assert!(other.owns(&gid(&second)));
        assert_eq!(one.room.held(), 1);
    }

    #[test]
    fn sessions_without_endpoints_make_room_for_others() {
        let (used, new) = (key(), key());
        let mut proven = full_of([prefix(&used.id())]);
        let is_used = |session: &SessionPrefix| *session == prefix(&used.id());
        proven.take(&[proof(&new)], &BINDING, HERE, is_used, NOW);
        assert!(proven.owns(&gid(&used)) && proven.owns(&gid(&new)));
        assert_eq!(proven.sessions.len(), 1);
    }

    #[test]
    fn a_flood_of_proofs_is_discarded_and_used_proofs_are_kept() {
        let (used, new) = (key(), key());
        let mut proven = full_of([prefix(&used.id())]);
        for _ in 0..3 {
            proven.take(&[proof(&new)], &BINDING, HERE, |_| true, NOW);
        }
        assert!(proven.owns(&gid(&used)) && !proven.owns(&gid(&new)));
        assert_eq!(proven.sessions.len() + proven.fresh.len(), MAX_PROVEN);
    }

    #[test]
    fn fresh_proofs_are_not_swept_before_their_endpoints_arrive() {
        let (first, second) = (key(), key());
        let mut proven = full_of([]);
        proven.take(&[proof(&first), proof(&second)], &BINDING, HERE, |_| false, NOW);
        proven.swept = None;
        fill(&mut proven);
        proven.take(&[proof(&key())], &BINDING, HERE, |_| false, NOW);
        assert!(proven.owns(&gid(&first)) && proven.owns(&gid(&second)));
        proven.settle();
        assert!(proven.fresh.is_empty() && proven.owns(&gid(&first)));
    }

    #[test]
    fn where_nothing_is_proved_nothing_is_kept() {
        let mut proven = Proven::new(false, Meter::new(MAX_PROVEN));
        proven.take(&[proof(&key())], &BINDING, HERE, |_| true, NOW);
        assert!(proven.sessions.is_empty() && proven.fresh.is_empty());
        assert!(proven.owns(&gid(&key())));
    }

    fn prover(keys: &Arc<SessionKeys>) -> Prover {
        Prover {
            keys: Arc::clone(keys),
            daemon: HERE,
            needed: true,
            binding: Some(BINDING),
            proved: HashSet::new(),
            made: HashMap::new(),
            held: HashMap::new(),
        }
    }

    fn proved(messages: &[LinkMessage]) -> usize {
        let count = |message: &LinkMessage| match message {
            LinkMessage::Owners(owners) => owners.proofs.len(),
            other => panic!("{other:?}"),
        };
        messages.iter().map(count).sum()
    }

    #[test]
    fn a_session_is_proved_once_on_each_connection_and_again_when_it_came_back() {
        let keys = Arc::new(SessionKeys::default());
        let own = Arc::new(key());
        keys.insert(Arc::clone(&own));
        let (known, other) = (gid(&own), gid(&key()));
        let mut prover = prover(&keys);
        assert_eq!(proved(&prover.owed([&known, &other].into_iter())), 1);
        assert!(prover.owed([&known, &other].into_iter()).is_empty());
        prover.forget();
        // The session ended, and one of its publishers is still visible.
        keys.remove(&own.id());
        assert_eq!(proved(&prover.owed([&known].into_iter())), 1);
        assert!(prover.owed([].into_iter()).is_empty());
        assert!(prover.held.is_empty() && prover.owed([&known].into_iter()).is_empty());
        keys.insert(own);
        assert_eq!(proved(&prover.owed([&known].into_iter())), 1);
    }

    #[test]
    fn many_sessions_take_several_messages() {
        let keys = Arc::new(SessionKeys::default());
        let mut gids = Vec::new();
        for _ in 0..=MAX_PROOFS {
            let key = Arc::new(key());
            gids.push(gid(&key));
            keys.insert(key);
        }
        let said = prover(&keys).owed(gids.iter());
        assert_eq!((said.len(), proved(&said)), (2, MAX_PROOFS + 1));
    }
}
