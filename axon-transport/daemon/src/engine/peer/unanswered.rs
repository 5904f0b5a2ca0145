//! Services of which a peer does not take the responses. Its requests are not taken for a while either: each would be
//! answered, and servers here would wait for room in the ring of its client.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use axon_envelope::Kind;

use super::{
    Peer, Surroundings,
    routes::{RouteKey, Wanted},
};

/// Between two looks at responses that the peer does not ask for.
const LOOK: Duration = Duration::from_secs(1);

/// The requests that a peer is not asked for, since it does not take what answers them.
#[derive(Default)]
pub(super) struct Unanswered {
    /// Until when it is not asked for them.
    closed: BTreeMap<RouteKey, Duration>,
    /// Since when responses to them wait that the peer has not asked for.
    awaited: BTreeMap<RouteKey, Duration>,
    /// When that is looked at.
    look: Option<Duration>,
}

impl Unanswered {
    /// When something is due.
    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        self.closed.values().copied().chain(self.look).min()
    }
}

impl Peer {
    /// Takes out of what is wanted the requests whose responses the peer did not take lately. Returns them.
    pub(super) fn leave_out_unanswered(
        &mut self,
        wanted: &mut BTreeMap<RouteKey, Wanted>,
        with: &Surroundings<'_>,
        now: Duration,
    ) -> BTreeSet<RouteKey> {
        let stalls = with.stalls.borrow();
        let left = |key: &RouteKey| {
            stalls.left(&self.identity, &key.other_way(), with.instant(now)).map(|left| now + left)
        };
        let requests = wanted.keys().filter(|key| key.kind == Kind::Request);
        let closed: BTreeMap<_, _> =
            requests.filter_map(|key| Some((key.clone(), left(key)?))).collect();
        wanted.retain(|key, _| !closed.contains_key(key));
        let keys = closed.keys().cloned().collect();
        self.unanswered.closed = closed;
        if self.unanswered.look.is_none() && self.has_unasked_responses() {
            self.unanswered.look = Some(now + LOOK);
        }
        keys
    }

    /// Whether this host asked for requests of a service whose responses the peer has not asked for.
    fn has_unasked_responses(&self) -> bool {
        let requests = self.asked.keys().filter(|key| key.kind == Kind::Request);
        requests.map(RouteKey::other_way).any(|key| self.served.number_of(&key).is_none())
    }

    /// Looks for responses that the peer does not ask for, and asks again for requests whose time is over.
    pub(super) fn look_at_unanswered(&mut self, with: &Surroundings<'_>, now: Duration) {
        let closed = self.unanswered.closed.len();
        self.unanswered.closed.retain(|_, until| *until > now);
        let is_over = self.unanswered.closed.len() < closed;
        let looks = self.unanswered.look.is_some_and(|look| look <= now);
        let mut stalled = false;
        if looks {
            self.unanswered.look = self.has_unasked_responses().then(|| now + LOOK);
            stalled = self.find_unasked_responses(with, now);
        }
        if is_over || stalled {
            self.update(with, now);
        }
    }

    /// Whether responses have waited for the limit that the peer does not ask for. It counts as one that does not read
    /// them.
    fn find_unasked_responses(&mut self, with: &Surroundings<'_>, now: Duration) -> bool {
        let waiting = self.asked.iter().filter(|(key, asked)| {
            key.kind == Kind::Request
                && self.served.number_of(&key.other_way()).is_none()
                && asked.stand_ins.values().any(|client| client.ring().calls_of(&client.gid()) > 0)
        });
        let before = std::mem::take(&mut self.unanswered.awaited);
        let since = |key: &RouteKey| before.get(key).copied().unwrap_or(now);
        let awaited: BTreeMap<_, _> = waiting.map(|(key, _)| (key.clone(), since(key))).collect();
        let limit = with.config.link.stalled;
        let (stalled, awaited): (BTreeMap<_, _>, _) =
            awaited.into_iter().partition(|(_, since)| now.saturating_sub(*since) >= limit);
        self.unanswered.awaited = awaited;
        for key in stalled.keys() {
            let (who, instant) = (&self.identity, with.instant(now));
            with.stalls.borrow_mut().add(who, &key.other_way(), limit, instant);
        }
        !stalled.is_empty()
    }
}
