//! Who goes with whom.

use super::{Asked, LocalEndpoint, Registry, Topic};
use crate::{
    graph::Endpoint,
    ids::{Gid, SessionId},
    qos::compatible,
    session::message::{EndpointRole, Message, Pair, Unmatch, reads, writes},
};

impl<F: Clone> Registry<F> {
    pub(super) fn index(&mut self, local: &LocalEndpoint) {
        let members = self.topics.entry(topic(&local.endpoint)).or_default();
        if writes(local.endpoint.kind) {
            members.writers.insert(local.endpoint.gid);
        } else if reads(local.endpoint.kind) {
            members.readers.insert(local.endpoint.gid);
        }
    }

    /// Pairs a new endpoint with what is there.
    pub(super) fn match_endpoint(&mut self, gid: &Gid) {
        let Some(local) = self.endpoints.get(gid) else { return };
        let kind = local.endpoint.kind;
        let Some(members) = self.topics.get(&topic(&local.endpoint)) else { return };
        let pairs: Vec<Pair> = if writes(kind) {
            members.readers.iter().map(|&reader| Pair { reader, writer: *gid }).collect()
        } else if reads(kind) {
            members.writers.iter().map(|&writer| Pair { reader: *gid, writer }).collect()
        } else {
            return;
        };
        for pair in pairs {
            let (Some(w), Some(r)) =
                (self.endpoints.get(&pair.writer), self.endpoints.get(&pair.reader))
            else {
                continue;
            };
            if !roles_match(w.role, r.role) {
                continue;
            }
            let (to_writer, to_reader) = (w.session, r.session);
            match compatible(&w.endpoint.qos, &r.endpoint.qos) {
                Ok(()) => {
                    let by = if writes(kind) { to_writer } else { to_reader };
                    self.pairs.insert(pair, Asked { by, attach: None, grant: None });
                    if let Some(entry) = self.sessions.get_mut(&by) {
                        entry.pairs += 1;
                    }
                    self.push(&to_reader, &Message::Match(pair), Vec::new());
                }
                Err(policy) => {
                    self.unmatch(&pair, to_writer, to_reader, &format!("incompatible {policy}"));
                }
            }
        }
    }

    /// Forgets an endpoint, which its session's entry no longer lists.
    pub(super) fn remove_endpoint(&mut self, gid: &Gid, reason: &str) {
        let Some(local) = self.endpoints.remove(gid) else { return };
        let topic = topic(&local.endpoint);
        let mut pairs = Vec::new();
        if let Some(members) = self.topics.get_mut(&topic) {
            members.writers.remove(gid);
            members.readers.remove(gid);
            if writes(local.endpoint.kind) {
                pairs.extend(members.readers.iter().map(|&reader| Pair { reader, writer: *gid }));
            } else {
                pairs.extend(members.writers.iter().map(|&writer| Pair { reader: *gid, writer }));
            }
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
        self.topics.get(&topic(endpoint)).map_or(0, |members| {
            if writes(endpoint.kind) {
                members.readers.len()
            } else if reads(endpoint.kind) {
                members.writers.len()
            } else {
                0
            }
        })
    }

    /// Whether there was such a pair.
    pub(super) fn remove_pair(&mut self, pair: &Pair) -> bool {
        let Some(asked) = self.pairs.remove(pair) else { return false };
        if let Some(entry) = self.sessions.get_mut(&asked.by) {
            entry.pairs -= 1;
        }
        true
    }

    fn unmatch(&mut self, pair: &Pair, to_writer: SessionId, to_reader: SessionId, reason: &str) {
        let Pair { reader, writer } = *pair;
        let message = Message::Unmatch(Unmatch { reader, writer, reason: reason.to_owned() });
        self.push(&to_reader, &message, Vec::new());
        if to_writer != to_reader {
            self.push(&to_writer, &message, Vec::new());
        }
    }
}

/// A relay carries local samples away and a stand-in brings remote ones here; the two together
/// would send a sample back to where it came from.
fn roles_match(writer: EndpointRole, reader: EndpointRole) -> bool {
    matches!(
        (writer, reader),
        (EndpointRole::Application | EndpointRole::StandIn, EndpointRole::Application)
            | (EndpointRole::Application, EndpointRole::Relay)
    )
}

fn topic(endpoint: &Endpoint) -> Topic {
    Topic(endpoint.topic.clone(), endpoint.type_name.clone())
}
