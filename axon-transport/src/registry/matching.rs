//! Decides which endpoints match, and stores the pairs.

use super::{LocalEndpoint, Members, PairProgress, Registry, Topic};
use crate::{
    graph::{Endpoint, EndpointKind, Pairing, pairing, reads, writes},
    ids::{Gid, SessionId},
    wire::session::{EndpointRole, Message, Pair, Unmatch},
};

impl<F: Clone> Registry<F> {
    pub(super) fn index(&mut self, local: &LocalEndpoint) {
        let members = self.topics.entry(topic(&local.endpoint)).or_default();
        if writes(local.endpoint.kind) {
            members.writers.insert(local.endpoint.gid);
        }
        if reads(local.endpoint.kind) {
            members.readers.insert(local.endpoint.gid);
        }
    }

    /// Pairs a new endpoint with what is there.
    pub(super) fn match_endpoint(&mut self, gid: &Gid) {
        let Some(local) = self.endpoints.get(gid) else { return };
        let Some(members) = self.topics.get(&topic(&local.endpoint)) else { return };
        let pairs = members.pairs_of(gid, local.endpoint.kind);
        for pair in pairs {
            let (Some(w), Some(r)) =
                (self.endpoints.get(&pair.writer), self.endpoints.get(&pair.reader))
            else {
                continue;
            };
            let reads = r.only.is_none_or(|only| only == pair.writer);
            if !reads || !roles_match(w.role, r.role) || w.leaving || r.leaving {
                continue;
            }
            // One that has come back.
            if self.pairs.contains_key(&pair) {
                continue;
            }
            if self.apart(w, r).is_some() {
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
                    self.pairs.insert(
                        pair,
                        PairProgress { by, attach: None, stands_for: None, grant: None },
                    );
                    if let Some(entry) = self.sessions.get_mut(&by) {
                        entry.pairs += 1;
                    }
                    self.push(&to_reader, &Message::Match(pair), Vec::new());
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

    /// Forgets an endpoint, which its session's entry no longer lists.
    pub(super) fn remove_endpoint(&mut self, gid: &Gid, reason: &str) {
        let Some(local) = self.endpoints.remove(gid) else { return };
        self.forget_fence(gid);
        let topic = topic(&local.endpoint);
        let mut pairs = Vec::new();
        if let Some(members) = self.topics.get_mut(&topic) {
            members.writers.remove(gid);
            members.readers.remove(gid);
            pairs = members.pairs_of(gid, local.endpoint.kind);
            if members.writers.is_empty() && members.readers.is_empty() {
                self.topics.remove(&topic);
            }
        }
        for pair in pairs {
            if !self.remove_pair(&pair) {
                continue;
            }
            let other = if pair.writer == *gid { pair.reader } else { pair.writer };
            let Some(other) = self.endpoints.get(&other).map(|e| e.session) else { continue };
            let (to_writer, to_reader) =
                if pair.writer == *gid { (local.session, other) } else { (other, local.session) };
            self.forget(&to_writer, &to_reader, &pair);
            self.forget(&to_reader, &to_writer, &pair);
            self.unmatch(&pair, to_writer, to_reader, reason);
        }
        if local.role == EndpointRole::Application {
            self.graph_end(*gid);
        }
    }

    /// How many pairs an endpoint would make at most.
    pub(super) fn prospects(&self, endpoint: &Endpoint) -> usize {
        self.prospective_pairs(endpoint).len()
    }

    /// The pairs that an endpoint would make at most.
    pub(super) fn prospective_pairs(&self, endpoint: &Endpoint) -> Vec<Pair> {
        let members = self.topics.get(&topic(endpoint));
        members.map(|all| all.pairs_of(&endpoint.gid, endpoint.kind)).unwrap_or_default()
    }

    /// Whether there was such a pair.
    pub(super) fn remove_pair(&mut self, pair: &Pair) -> bool {
        let Some(asked) = self.pairs.remove(pair) else { return false };
        if let Some(entry) = self.sessions.get_mut(&asked.by) {
            entry.pairs -= 1;
        }
        true
    }

    pub(super) fn unmatch(
        &mut self,
        pair: &Pair,
        to_writer: SessionId,
        to_reader: SessionId,
        reason: &str,
    ) {
        let Pair { reader, writer } = *pair;
        let message = Message::Unmatch(Unmatch { reader, writer, reason: reason.to_owned() });
        self.push(&to_reader, &message, Vec::new());
        if to_writer != to_reader {
            self.push(&to_writer, &message, Vec::new());
        }
    }
}

impl Members {
    /// The pairs that an endpoint of this kind makes with the others, if they go together.
    fn pairs_of(&self, gid: &Gid, kind: EndpointKind) -> Vec<Pair> {
        let mut pairs = Vec::new();
        if writes(kind) {
            let readers = self.readers.iter().filter(|reader| *reader != gid);
            pairs.extend(readers.map(|&reader| Pair { reader, writer: *gid }));
        }
        if reads(kind) {
            let writers = self.writers.iter().filter(|writer| *writer != gid);
            pairs.extend(writers.map(|&writer| Pair { reader: *gid, writer }));
        }
        pairs
    }
}

/// A relay carries local samples away and a stand-in brings remote ones here, one of a service does
/// both; two of them together would send a sample back to where it came from.
fn roles_match(writer: EndpointRole, reader: EndpointRole) -> bool {
    writer == EndpointRole::Application
        || (writer == EndpointRole::StandIn && reader == EndpointRole::Application)
}

pub(super) fn topic(endpoint: &Endpoint) -> Topic {
    Topic(endpoint.topic.clone(), endpoint.type_name.clone())
}
