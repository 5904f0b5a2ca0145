//! The discovery range of each session, and the pairs and parts of the graph that follow from it.
//!
//! The range and the static peers belong to each session, independent of the process that started the daemon. The
//! daemon knows from the addresses of its links which linked peers a session lists ([`Registry::relist`]).

#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, BTreeSet, HashSet};

use super::{LocalEndpoint, Registry, SessionEntry, matching::topic};
use crate::{
    config::DiscoveryRange,
    graph::{
        Endpoint, EndpointRange, OutOfRange, Pairing, RangeToHost, RemoteEndpoint, Scope,
        out_of_range, pairing,
    },
    ids::{DaemonId, Gid, SessionId},
    wire::session::{EndpointRole, GraphItem, Pair, SessionRole},
};

/// Which parts of the graph a session is shown. Sessions of one view are told the same.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct GraphFilter {
    /// Present where ranges apply: those of this host's registry, not those within a process.
    scope: Option<(DiscoveryRange, Vec<DaemonId>)>,
    /// A session that sees no other.
    alone: Option<SessionId>,
    gateway: bool,
}

/// A pair that would be matched but for the ranges of its sessions.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct OutOfRangePair {
    /// The topic or service.
    pub topic: String,
    /// Its type.
    pub type_name: String,
    /// The pair.
    pub pair: Pair,
    /// Why.
    pub why: OutOfRange,
}

impl GraphFilter {
    pub(super) fn is_gateway(&self) -> bool {
        self.gateway
    }
}

impl<F> SessionEntry<F> {
    /// Its range, and the daemons of linked peers that it lists; `None` where ranges do not apply.
    fn reach(&self) -> Option<EndpointRange> {
        let scope = self.scope.as_ref()?;
        Some(EndpointRange { range: scope.range, lists: self.lists.iter().copied().collect() })
    }

    fn toward(&self, peer: &DaemonId) -> Option<RangeToHost> {
        let scope = self.scope.as_ref()?;
        Some(RangeToHost { range: scope.range, lists: self.lists.contains(peer) })
    }

    fn is_off(&self) -> bool {
        self.scope.as_ref().is_some_and(|scope| scope.range == DiscoveryRange::Off)
    }
}

impl<F: Clone> Registry<F> {
    /// Whether applications' sessions came or went since the last call.
    pub fn take_rescoped(&mut self) -> bool {
        std::mem::take(&mut self.rescoped)
    }

    /// The scopes of applications' sessions.
    pub fn scopes(&self) -> impl Iterator<Item = &Scope> {
        let applications = self.sessions.values().filter(|s| s.role == SessionRole::Application);
        applications.filter_map(|entry| entry.scope.as_ref())
    }

    /// Links, or the addresses of static peers, changed: `listed` tells which linked peers a list of
    /// static peers names. Pairs that are out of range now end, and those that are in range are made.
    pub fn relist(&mut self, listed: impl Fn(&[String]) -> BTreeSet<DaemonId>) {
        let mut changed = Vec::new();
        for (id, entry) in &mut self.sessions {
            let Some(scope) = &entry.scope else { continue };
            let now = if scope.static_peers.is_empty() {
                BTreeSet::new()
            } else {
                listed(&scope.static_peers)
            };
            if entry.lists != now {
                entry.lists = now;
                // What it is shown of the graph is another part.
                entry.resync = true;
                self.ready.insert(*id);
                changed.push(*id);
            }
        }
        for id in changed {
            let own = self.sessions.get(&id).map(|entry| entry.endpoints.clone());
            for gid in own.unwrap_or_default() {
                self.regraded.insert(gid);
                self.rematch(&gid);
            }
        }
    }

    /// Endpoints of another host came, or their range changed: what stands for them is matched anew.
    pub(super) fn rematch_remote(&mut self, endpoints: &[RemoteEndpoint]) {
        let gids: HashSet<Gid> = endpoints.iter().map(|remote| remote.endpoint.gid).collect();
        let topics: BTreeSet<_> = endpoints.iter().map(|remote| topic(&remote.endpoint)).collect();
        let stands = |local: &LocalEndpoint| match local.role {
            EndpointRole::StandIn => gids.contains(&local.endpoint.gid),
            EndpointRole::Relay => local.stands_for.iter().any(|gid| gids.contains(gid)),
            EndpointRole::Application => false,
        };
        let members = topics.iter().filter_map(|topic| self.topics.get(topic));
        let members = members.flat_map(|m| m.writers.iter().chain(&m.readers));
        let touched: BTreeSet<Gid> =
            members.filter(|gid| self.endpoints.get(*gid).is_some_and(stands)).copied().collect();
        touched.iter().for_each(|gid| self.rematch(gid));
    }

    /// Ends the pairs of an endpoint that are out of range now, and makes those that are in range.
    pub(super) fn rematch(&mut self, gid: &Gid) {
        let Some(local) = self.endpoints.get(gid) else { return };
        let pairs = self.prospective_pairs(&local.endpoint).into_iter();
        let pairs: Vec<Pair> = pairs.filter(|pair| self.pairs.contains_key(pair)).collect();
        for pair in pairs {
            let (Some(w), Some(r)) =
                (self.endpoints.get(&pair.writer), self.endpoints.get(&pair.reader))
            else {
                continue;
            };
            let (to_writer, to_reader) = (w.session, r.session);
            match self.apart(w, r) {
                // A host that is silent is not in the graph. The gateway ends its endpoints here when it is gone.
                Some(OutOfRange::Unknown) => {}
                Some(why) => {
                    self.remove_pair(&pair);
                    self.forget(&to_writer, &to_reader, &pair);
                    self.forget(&to_reader, &to_writer, &pair);
                    self.unmatch(&pair, to_writer, to_reader, &why.to_string());
                }
                None => self.retell_stands_for(&pair),
            }
        }
        self.match_endpoint(gid);
    }

    /// Tells a writer which subscriptions its relay stands for, if they changed.
    fn retell_stands_for(&mut self, pair: &Pair) {
        let Some(asked) = self.pairs.get(pair) else { return };
        let told = asked.stands_for.clone();
        if asked.attach.is_some() && self.stands_for(pair) != told {
            self.forward_attach(pair);
        }
    }

    /// The subscriptions that a pair's reader stands for and that the writer's session may see.
    pub(super) fn stands_for(&self, pair: &Pair) -> Option<Vec<Gid>> {
        let all = self.pairs.get(pair)?.attach.as_ref()?.stands_for.clone()?;
        let Some(writer) = self.endpoints.get(&pair.writer) else { return Some(Vec::new()) };
        let meets = |gid: &Gid| self.apart_from(&writer.session, gid).is_none();
        Some(all.into_iter().filter(meets).collect())
    }

    /// Why the ranges of their sessions keep two endpoints apart, if they do.
    pub(super) fn apart(&self, w: &LocalEndpoint, r: &LocalEndpoint) -> Option<OutOfRange> {
        if w.session == r.session {
            return None;
        }
        match (w.role, r.role) {
            (EndpointRole::Application, EndpointRole::Application) => {
                let off = |id| self.sessions.get(id).is_none_or(SessionEntry::is_off);
                (off(&w.session) || off(&r.session)).then_some(OutOfRange::Off)
            }
            (EndpointRole::StandIn, _) => self.apart_from(&r.session, &w.endpoint.gid),
            (_, EndpointRole::StandIn) => self.apart_from(&w.session, &r.endpoint.gid),
            (_, EndpointRole::Relay) => {
                let scoped = self.sessions.get(&w.session).is_some_and(|s| s.scope.is_some());
                let mut why = scoped.then_some(OutOfRange::Unknown);
                for gid in &r.stands_for {
                    why = Some(self.apart_from(&w.session, gid)?);
                }
                why
            }
            (EndpointRole::Relay, _) => None,
        }
    }

    /// Why a session does not meet an endpoint of another host, if it does not.
    fn apart_from(&self, session: &SessionId, remote: &Gid) -> Option<OutOfRange> {
        let Some(entry) = self.sessions.get(session) else { return Some(OutOfRange::Unknown) };
        entry.scope.as_ref()?;
        let found = self.remote.iter().find_map(|(daemon, all)| Some((daemon, all.get(remote)?)));
        let Some((daemon, remote)) = found else { return Some(OutOfRange::Unknown) };
        out_of_range(entry.toward(daemon)?, remote.toward)
    }

    pub(super) fn view(&self, id: &SessionId) -> GraphFilter {
        let entry = self.sessions.get(id);
        let reach = entry.and_then(SessionEntry::reach);
        GraphFilter {
            alone: entry.is_some_and(SessionEntry::is_off).then_some(*id),
            scope: reach.map(|reach| (reach.range, reach.lists)),
            gateway: entry.is_some_and(|entry| entry.role == SessionRole::Gateway),
        }
    }

    /// An endpoint, of another host's `daemon` if there is one, as a view shows it, if it does. The
    /// gateway is shown those of this host alone: it told of the others itself.
    pub(super) fn shown_in(
        &self,
        view: &GraphFilter,
        endpoint: &Endpoint,
        daemon: Option<DaemonId>,
    ) -> Option<GraphItem> {
        let gid = &endpoint.gid;
        let Some(daemon) = daemon else {
            let owner = self.endpoints.get(gid)?.session;
            let entry = self.sessions.get(&owner)?;
            let hidden = view.alone.is_some() || entry.is_off();
            if hidden && view.alone != Some(owner) {
                return None;
            }
            let reach = if view.gateway { entry.reach() } else { None };
            return Some(GraphItem { endpoint: endpoint.clone(), daemon: None, reach });
        };
        if view.gateway {
            return None;
        }
        if let Some((range, lists)) = &view.scope {
            let own = RangeToHost { range: *range, lists: lists.contains(&daemon) };
            let remote = self.remote.get(&daemon)?.get(gid)?;
            if out_of_range(own, remote.toward).is_some() {
                return None;
            }
        }
        Some(GraphItem { endpoint: endpoint.clone(), daemon: Some(daemon), reach: None })
    }

    /// The sessions that are told of the graph, by what they are shown of it.
    pub(super) fn views(&self) -> BTreeMap<GraphFilter, Vec<SessionId>> {
        let mut views: BTreeMap<GraphFilter, Vec<SessionId>> = BTreeMap::new();
        for (id, entry) in &self.sessions {
            if entry.role != SessionRole::Tool && !entry.behind {
                views.entry(self.view(id)).or_default().push(*id);
            }
        }
        views
    }

    /// Pairs that would be matched but for the ranges of their sessions: at most `most`, of at most
    /// `looked_at` that are looked at.
    pub fn kept_apart(&self, most: usize, looked_at: usize) -> Vec<OutOfRangePair> {
        let limited = self.scopes().any(|scope| scope.range != DiscoveryRange::Subnet);
        let own =
            |gid: &Gid| self.endpoints.get(gid).filter(|e| e.role == EndpointRole::Application);
        let here = self.topics.values().filter(|_| limited).flat_map(|members| {
            members.writers.iter().filter_map(own).flat_map(move |w| {
                let readers = members.readers.iter().filter_map(own);
                readers.map(move |r| (&w.endpoint, &r.endpoint, self.apart(w, r)))
            })
        });
        let remote = self.remote.iter().flat_map(|(d, all)| all.values().map(move |r| (d, r)));
        let remote = remote.filter(|(_, r)| limited || r.toward.range != DiscoveryRange::Subnet);
        let there = remote.flat_map(|(daemon, remote)| {
            let members = self.topics.get(&topic(&remote.endpoint)).into_iter();
            let local = members.flat_map(|m| m.writers.union(&m.readers)).filter_map(own);
            local.map(move |local| {
                let session = self.sessions.get(&local.session);
                let toward = session.and_then(|session| session.toward(daemon));
                let why = toward.and_then(|own| out_of_range(own, remote.toward));
                // Of a service one direction says it all.
                let remote: &Endpoint = &remote.endpoint;
                if pairing(&local.endpoint, remote) == Pairing::Match {
                    (&local.endpoint, remote, why)
                } else {
                    (remote, &local.endpoint, why)
                }
            })
        });
        let all = here.chain(there).take(looked_at);
        let apart = all.filter_map(|(writer, reader, why)| {
            let why = why.filter(|_| pairing(writer, reader) == Pairing::Match)?;
            let pair = Pair { reader: reader.gid, writer: writer.gid };
            let (topic, type_name) = (writer.topic.clone(), writer.type_name.clone());
            Some(OutOfRangePair { topic, type_name, pair, why })
        });
        apart.take(most).collect()
    }
}
