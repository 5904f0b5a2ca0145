//! The discovery range of each session, and the pairs and parts of the graph that follow from it.
//!
//! The range and the static peers belong to each session, independent of the process that started the daemon. The
//! daemon knows from the addresses of its links which linked peers a session lists
//! ([`Registry::relist`](super::Registry::relist)).

#[cfg(test)]
mod tests;

use std::collections::BTreeMap;

use super::{
    endpoints::{Endpoints, LocalEndpoint, Topic},
    remote::RemoteEndpoints,
    sessions::{SessionEntry, Sessions},
};
use crate::{
    config::DiscoveryRange,
    graph::{Endpoint, OutOfRange, Pairing, RangeToHost, Scope, Users, out_of_range, pairing},
    ids::{DaemonId, Gid, SessionId},
    wire::session::{EndpointRole, GraphItem, Pair, SessionRole},
};

/// The view of a session: the parts of the graph that it sees. Sessions with equal views are sent the same.
#[derive(Clone, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct GraphFilter {
    /// Set if ranges apply: in this host's registry, but not in one within a process.
    scope: Option<(DiscoveryRange, Vec<DaemonId>)>,
    /// A session that sees no other session.
    alone: Option<SessionId>,
    gateway: bool,
    /// Another user of this host, if access rules decide what it sees.
    user: Option<u32>,
}

/// A pair that would be matched except for the ranges of its sessions.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct OutOfRangePair {
    /// The topic or service.
    pub topic: String,
    /// The type of the topic or service.
    pub type_name: String,
    /// The pair.
    pub pair: Pair,
    /// The reason.
    pub why: OutOfRange,
}

impl GraphFilter {
    pub(super) fn is_gateway(&self) -> bool {
        self.gateway
    }
}

/// Decides by the ranges of sessions. Borrows the sessions, their endpoints, and the endpoints of other hosts.
pub(super) struct Ranges<'a, F> {
    pub(super) sessions: &'a Sessions<F>,
    pub(super) endpoints: &'a Endpoints,
    pub(super) remote: &'a RemoteEndpoints,
    pub(super) users: &'a Users,
}

impl<F> Ranges<'_, F> {
    /// Returns the scopes of applications' sessions.
    fn scopes(&self) -> impl Iterator<Item = &Scope> {
        let all = self.sessions.iter().map(|(_, entry)| entry);
        let applications = all.filter(|entry| entry.role == SessionRole::Application);
        applications.filter_map(|entry| entry.scope.as_ref())
    }

    /// Returns those of `all`, subscriptions of other hosts, that the writer's session may see.
    pub(super) fn seen_by(&self, writer: &LocalEndpoint, all: Vec<Gid>) -> Vec<Gid> {
        let meets = |gid: &Gid| self.apart_from(&writer.session, gid).is_none();
        all.into_iter().filter(meets).collect()
    }

    /// Returns the reason if ranges or access rules keep two endpoints apart.
    pub(super) fn apart(&self, w: &LocalEndpoint, r: &LocalEndpoint) -> Option<OutOfRange> {
        if w.session == r.session {
            return None;
        }
        if w.denied || r.denied {
            return Some(OutOfRange::Denied);
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

    /// Returns the reason if a session may not meet an endpoint of another host.
    fn apart_from(&self, session: &SessionId, remote: &Gid) -> Option<OutOfRange> {
        let Some(entry) = self.sessions.get(session) else { return Some(OutOfRange::Unknown) };
        entry.scope.as_ref()?;
        let Some((daemon, remote)) = self.remote.find(remote) else {
            return Some(OutOfRange::Unknown);
        };
        out_of_range(entry.toward(daemon)?, remote.toward)
    }

    pub(super) fn view(&self, id: &SessionId) -> GraphFilter {
        let entry = self.sessions.get(id);
        let reach = entry.and_then(SessionEntry::reach);
        GraphFilter {
            alone: entry.is_some_and(SessionEntry::is_off).then_some(*id),
            scope: reach.map(|reach| (reach.range, reach.lists)),
            gateway: entry.is_some_and(|entry| entry.role == SessionRole::Gateway),
            user: entry.and_then(|entry| entry.user).filter(|_| self.users.have_rules()),
        }
    }

    /// Returns an endpoint as a view shows it; `None` if the view does not contain it. `daemon` is set for an endpoint
    /// of another host. The gateway sees only the endpoints of this host, because it reported the others itself.
    pub(super) fn shown_in(
        &self,
        view: &GraphFilter,
        endpoint: &Endpoint,
        daemon: Option<DaemonId>,
    ) -> Option<GraphItem> {
        let gid = &endpoint.gid;
        let Some(daemon) = daemon else {
            let local = self.endpoints.get(gid)?;
            let owner = local.session;
            let entry = self.sessions.get(&owner)?;
            if local.denied || !self.users.shows(view.user, entry.user, endpoint) {
                return None;
            }
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
        if !self.users.shows(view.user, None, endpoint) {
            return None;
        }
        if let Some((range, lists)) = &view.scope {
            let own = RangeToHost { range: *range, lists: lists.contains(&daemon) };
            let remote = self.remote.get(&daemon, gid)?;
            if out_of_range(own, remote.toward).is_some() {
                return None;
            }
        }
        Some(GraphItem { endpoint: endpoint.clone(), daemon: Some(daemon), reach: None })
    }

    /// Returns the sessions that are sent the graph, by view.
    pub(super) fn views(&self) -> BTreeMap<GraphFilter, Vec<SessionId>> {
        let mut views: BTreeMap<GraphFilter, Vec<SessionId>> = BTreeMap::new();
        for (id, entry) in self.sessions.iter() {
            if entry.role != SessionRole::Tool && !entry.outbox.is_behind() {
                views.entry(self.view(id)).or_default().push(*id);
            }
        }
        views
    }

    /// Returns pairs that would be matched except for the ranges of their sessions: at most `most`, from at most
    /// `looked_at` candidates.
    pub(super) fn kept_apart(&self, most: usize, looked_at: usize) -> Vec<OutOfRangePair> {
        let limited = self.scopes().any(|scope| scope.range != DiscoveryRange::Subnet)
            || self.users.have_rules();
        let own =
            |gid: &Gid| self.endpoints.get(gid).filter(|e| e.role == EndpointRole::Application);
        let here = self.endpoints.topics().filter(|_| limited).flat_map(|members| {
            members.writers.iter().filter_map(own).flat_map(move |w| {
                let readers = members.readers.iter().filter_map(own);
                readers.map(move |r| (&w.endpoint, &r.endpoint, self.apart(w, r)))
            })
        });
        let remote = self.remote.iter();
        let remote = remote.filter(|(_, r)| limited || r.toward.range != DiscoveryRange::Subnet);
        let there = remote.flat_map(|(daemon, remote)| {
            let members = self.endpoints.members(&Topic::of(&remote.endpoint)).into_iter();
            let local = members.flat_map(|m| m.writers.union(&m.readers)).filter_map(own);
            local.map(move |local| {
                let session = self.sessions.get(&local.session);
                let toward = session.and_then(|session| session.toward(daemon));
                let why = toward.and_then(|own| out_of_range(own, remote.toward));
                // For a service, one direction suffices.
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
