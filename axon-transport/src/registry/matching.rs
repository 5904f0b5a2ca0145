//! Makes and ends pairs when endpoints come and go or their ranges or the access rules change, and sends the sessions
//! the changes.

use std::collections::{BTreeSet, HashSet};

use super::{
    Registry,
    endpoints::{LocalEndpoint, Topic},
};
use crate::{
    graph::{Endpoint, OutOfRange, Pairing, RemoteEndpoint, pairing},
    ids::{Gid, SessionId},
    wire::session::{EndpointRole, Pair, SessionMessage, SessionRefused, Unmatch},
};

impl<F: Clone> Registry<F> {
    /// Makes the pairs of a new endpoint with the existing ones.
    pub(super) fn match_endpoint(&mut self, gid: &Gid) {
        let Some(local) = self.endpoints.get(gid) else { return };
        for pair in self.endpoints.prospective_pairs(&local.endpoint) {
            let (Some(w), Some(r)) =
                (self.endpoints.get(&pair.writer), self.endpoints.get(&pair.reader))
            else {
                continue;
            };
            // The pairs of an endpoint that has come back still exist.
            if !w.may_be_read_by(r)
                || self.pairs.contains(&pair)
                || self.ranges().apart(w, r).is_some()
            {
                continue;
            }
            let (to_writer, to_reader) = (w.session, r.session);
            let relayed = |id| self.sessions.get(id).is_some_and(|s| s.relay.is_some());
            if to_writer == to_reader && relayed(&to_writer) {
                continue;
            }
            match pairing(&w.endpoint, &r.endpoint) {
                Pairing::Match => {
                    let by = if pair.writer == *gid { to_writer } else { to_reader };
                    self.pairs.insert(pair, by);
                    self.push(&to_reader, &SessionMessage::Match(pair), Vec::new());
                }
                Pairing::IncompatibleQos(policy) => {
                    self.unmatch(&pair, to_writer, to_reader, &format!("incompatible {policy}"));
                }
                Pairing::IncompatibleType => {
                    let reason = "type mismatch: the type names or the type hashes differ";
                    self.unmatch(&pair, to_writer, to_reader, reason);
                }
                Pairing::Unrelated => {}
            }
        }
    }

    /// Judges an endpoint by the current access rules.
    pub(super) fn judge(&mut self, id: &SessionId, gid: &Gid) {
        let Some(local) = self.endpoints.get(gid) else { return };
        let (endpoint, role, was_shown) = (local.endpoint.clone(), local.role, local.is_shown());
        let denial = self.denial(id, role, &endpoint);
        if !self.endpoints.set_denied(gid, denial.is_some()) {
            return;
        }
        if let Some(why) = denial {
            self.note_denied(id, &endpoint, &why);
        }
        match (was_shown, self.endpoints.get(gid).is_some_and(|local| local.is_shown())) {
            (true, false) => self.changes.remove(*gid, true),
            (false, true) => self.graph_add_local(&endpoint),
            _ => {}
        }
        self.rematch(gid);
    }

    /// Returns the reason if access rules deny an endpoint to its user.
    pub(super) fn denial(
        &self,
        id: &SessionId,
        role: EndpointRole,
        endpoint: &Endpoint,
    ) -> Option<String> {
        let user = self.sessions.get(id).and_then(|entry| entry.user);
        self.users.denial(user.filter(|_| role == EndpointRole::Application), endpoint)
    }

    /// Notes for the status and the log that an endpoint is denied, and tells its session. REFUSED does not name the
    /// endpoint: for the session a named refusal is final, and other rules may allow the endpoint later.
    pub(super) fn note_denied(&mut self, id: &SessionId, endpoint: &Endpoint, why: &str) {
        let refused = SessionRefused::of(endpoint, why);
        self.sessions.note_refused(id, &refused.text);
        self.push(id, &SessionMessage::Refused(SessionRefused::because(refused.text)), Vec::new());
    }

    /// Removes an endpoint that its session's entry no longer lists, and ends its pairs.
    pub(super) fn remove_endpoint(&mut self, gid: &Gid, reason: &str) {
        let Some((local, pairs)) = self.endpoints.remove(gid) else { return };
        self.fences.forget(gid);
        for pair in pairs {
            if !self.pairs.remove(&pair) {
                continue;
            }
            let other = if pair.writer == *gid { pair.reader } else { pair.writer };
            let Some(other) = self.endpoints.session_of(&other) else { continue };
            let (to_writer, to_reader) =
                if pair.writer == *gid { (local.session, other) } else { (other, local.session) };
            self.sessions.part(&pair, &to_writer, &to_reader);
            self.unmatch(&pair, to_writer, to_reader, reason);
        }
        if local.role == EndpointRole::Application {
            // Readers that an earlier daemon matched with it may not have come back yet.
            if self.sessions.keeps_left_memory() {
                self.changes.bury(*gid);
            } else {
                self.changes.end(*gid);
            }
        }
    }

    /// Matches again the stand-ins and relays of another host's endpoints that are new or whose range changed.
    pub(super) fn rematch_remote(&mut self, endpoints: &[RemoteEndpoint]) {
        let gids: HashSet<Gid> = endpoints.iter().map(|remote| remote.endpoint.gid).collect();
        let topics: BTreeSet<_> =
            endpoints.iter().map(|remote| Topic::of(&remote.endpoint)).collect();
        let stands = |local: &LocalEndpoint| match local.role {
            EndpointRole::StandIn => gids.contains(&local.endpoint.gid),
            EndpointRole::Relay => local.stands_for.iter().any(|gid| gids.contains(gid)),
            EndpointRole::Application => false,
        };
        let members = topics.iter().filter_map(|topic| self.endpoints.members(topic));
        let members = members.flat_map(|m| m.writers.iter().chain(&m.readers));
        let touched: BTreeSet<Gid> =
            members.filter(|gid| self.endpoints.get(gid).is_some_and(stands)).copied().collect();
        touched.iter().for_each(|gid| self.rematch(gid));
    }

    /// Ends the pairs of an endpoint that are now out of range, and makes the pairs that are now in range.
    pub(super) fn rematch(&mut self, gid: &Gid) {
        let Some(local) = self.endpoints.get(gid) else { return };
        let pairs = self.endpoints.prospective_pairs(&local.endpoint);
        let pairs: Vec<Pair> = self.pairs.existing(pairs).collect();
        for pair in pairs {
            let (Some(w), Some(r)) =
                (self.endpoints.get(&pair.writer), self.endpoints.get(&pair.reader))
            else {
                continue;
            };
            let (to_writer, to_reader) = (w.session, r.session);
            match self.ranges().apart(w, r) {
                // The endpoints of a silent host are not in the graph. The gateway ends its stand-ins here when the
                // host is gone.
                Some(OutOfRange::Unknown) => {}
                Some(why) => {
                    self.pairs.remove(&pair);
                    self.sessions.part(&pair, &to_writer, &to_reader);
                    self.unmatch(&pair, to_writer, to_reader, &why.to_string());
                }
                None => self.retell_stands_for(&pair),
            }
        }
        self.match_endpoint(gid);
    }

    /// Tells a writer which subscriptions its relay stands for, if they changed.
    fn retell_stands_for(&mut self, pair: &Pair) {
        if self.pairs.attach_of(pair).is_some()
            && self.stands_for(pair).as_ref() != self.pairs.told(pair)
        {
            self.forward_attach(pair);
        }
    }

    /// Returns the subscriptions that a pair's reader stands for and that the writer's session may see.
    pub(super) fn stands_for(&self, pair: &Pair) -> Option<Vec<Gid>> {
        let all = self.pairs.attach_of(pair)?.stands_for.clone()?;
        let writer = self.endpoints.get(&pair.writer);
        Some(writer.map(|writer| self.ranges().seen_by(writer, all)).unwrap_or_default())
    }

    fn unmatch(&mut self, pair: &Pair, to_writer: SessionId, to_reader: SessionId, reason: &str) {
        let Pair { reader, writer } = *pair;
        let message =
            SessionMessage::Unmatch(Unmatch { reader, writer, reason: reason.to_owned() });
        self.push(&to_reader, &message, Vec::new());
        if to_writer != to_reader {
            self.push(&to_writer, &message, Vec::new());
        }
    }
}
