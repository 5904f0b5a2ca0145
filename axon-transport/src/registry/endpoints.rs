//! The endpoints of this host's sessions, and their possible pairs.

use std::collections::{BTreeSet, HashMap};

use axon_shm::internal::Location;

use crate::{
    graph::{Endpoint, EndpointKind, reads, writes},
    ids::{Gid, SessionId},
    wire::session::{EndpointRole, Pair},
};

/// An endpoint of a session of this host.
#[derive(Debug)]
pub struct LocalEndpoint {
    /// The session that owns it.
    pub session: SessionId,
    /// The endpoint.
    pub endpoint: Endpoint,
    /// The role: an application's endpoint, or one that stands in for others.
    pub role: EndpointRole,
    /// The remote subscriptions that a relay stands for.
    pub stands_for: Vec<Gid>,
    /// The only writer that a relay reads; `None` if it reads all.
    pub only: Option<Gid>,
    /// The location of a writer's ring.
    pub ring: Option<Location>,
    /// True if access rules deny it to the user of its session. Then it has no pair with other sessions, and is in no
    /// graph.
    pub denied: bool,
    /// True if it has ended, but not all of its messages are in its ring yet.
    pub leaving: bool,
}

impl LocalEndpoint {
    /// Returns whether it is an application's endpoint that is in the graph.
    pub(super) fn is_shown(&self) -> bool {
        self.role == EndpointRole::Application && !self.leaving && !self.denied
    }

    /// Returns whether this writer and `reader` may be a pair, regardless of their ranges, types and QoS.
    pub(super) fn may_be_read_by(&self, reader: &Self) -> bool {
        let reads = reader.only.is_none_or(|only| only == self.endpoint.gid);
        reads && roles_match(self.role, reader.role) && !self.leaving && !reader.leaving
    }
}

/// Returns whether endpoints of these roles may be a pair. A relay carries local samples away, and a stand-in brings
/// remote ones here; a stand-in of a service does both. A pair of two of them would send a sample back to its origin.
fn roles_match(writer: EndpointRole, reader: EndpointRole) -> bool {
    writer == EndpointRole::Application
        || (writer == EndpointRole::StandIn && reader == EndpointRole::Application)
}

/// The name and type of a topic or service.
#[derive(Clone, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(super) struct Topic(String, String);

impl Topic {
    pub(super) fn of(endpoint: &Endpoint) -> Self {
        Self(endpoint.topic.clone(), endpoint.type_name.clone())
    }
}

/// The writers and readers of one topic. A client or server is both.
#[derive(Debug, Default)]
pub(super) struct Members {
    pub(super) writers: BTreeSet<Gid>,
    pub(super) readers: BTreeSet<Gid>,
}

impl Members {
    /// Returns the pairs that an endpoint of this kind makes with the members, if they match.
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

/// The endpoints of this host's sessions. Each is a member of its topic. A topic without members is removed.
#[derive(Debug, Default)]
pub(super) struct Endpoints {
    all: HashMap<Gid, LocalEndpoint>,
    topics: HashMap<Topic, Members>,
}

impl Endpoints {
    pub(super) fn iter(&self) -> impl Iterator<Item = &LocalEndpoint> {
        self.all.values()
    }

    pub(super) fn get(&self, gid: &Gid) -> Option<&LocalEndpoint> {
        self.all.get(gid)
    }

    /// Sets whether access rules deny an endpoint. Returns whether that changed.
    pub(super) fn set_denied(&mut self, gid: &Gid, denied: bool) -> bool {
        let local = self.all.get_mut(gid);
        local.is_some_and(|local| std::mem::replace(&mut local.denied, denied) != denied)
    }

    /// Returns the session of an endpoint.
    pub(super) fn session_of(&self, gid: &Gid) -> Option<SessionId> {
        self.all.get(gid).map(|local| local.session)
    }

    /// Returns whether an endpoint exists and belongs to another session.
    pub(super) fn is_of_another(&self, gid: &Gid, session: &SessionId) -> bool {
        self.all.get(gid).is_some_and(|local| local.session != *session)
    }

    /// Returns the endpoints of applications that are in the graph.
    pub(super) fn shown(&self) -> impl Iterator<Item = &LocalEndpoint> {
        self.all.values().filter(|local| local.is_shown())
    }

    pub(super) fn members(&self, topic: &Topic) -> Option<&Members> {
        self.topics.get(topic)
    }

    pub(super) fn topics(&self) -> impl Iterator<Item = &Members> {
        self.topics.values()
    }

    /// Adds an endpoint; its GID must be new.
    pub(super) fn insert(&mut self, local: LocalEndpoint) {
        let gid = local.endpoint.gid;
        let members = self.topics.entry(Topic::of(&local.endpoint)).or_default();
        if writes(local.endpoint.kind) {
            members.writers.insert(gid);
        }
        if reads(local.endpoint.kind) {
            members.readers.insert(gid);
        }
        self.all.insert(gid, local);
    }

    /// Removes an endpoint. Returns it, with its possible pairs.
    pub(super) fn remove(&mut self, gid: &Gid) -> Option<(LocalEndpoint, Vec<Pair>)> {
        let local = self.all.remove(gid)?;
        let topic = Topic::of(&local.endpoint);
        let mut pairs = Vec::new();
        if let Some(members) = self.topics.get_mut(&topic) {
            members.writers.remove(gid);
            members.readers.remove(gid);
            pairs = members.pairs_of(gid, local.endpoint.kind);
            if members.writers.is_empty() && members.readers.is_empty() {
                self.topics.remove(&topic);
            }
        }
        Some((local, pairs))
    }

    /// Sets the remote endpoints that an endpoint stands for. Returns whether they changed.
    pub(super) fn set_stands_for(&mut self, gid: &Gid, stands_for: Vec<Gid>) -> bool {
        let Some(local) = self.all.get_mut(gid) else { return false };
        let changed = local.stands_for != stands_for;
        local.stands_for = stands_for;
        changed
    }

    /// Sets whether an endpoint has ended while some of its messages are still to come. Returns whether that changed.
    pub(super) fn set_leaving(&mut self, gid: &Gid, leaving: bool) -> bool {
        let local = self.all.get_mut(gid);
        local.is_some_and(|local| std::mem::replace(&mut local.leaving, leaving) != leaving)
    }

    /// Returns the possible pairs of an endpoint, which need not be added yet.
    pub(super) fn prospective_pairs(&self, endpoint: &Endpoint) -> Vec<Pair> {
        let members = self.topics.get(&Topic::of(endpoint));
        members.map(|all| all.pairs_of(&endpoint.gid, endpoint.kind)).unwrap_or_default()
    }

    /// Returns a hash of the applications' endpoints. It most likely differs when they change.
    pub(super) fn digest(&self) -> u64 {
        self.shown().fold(0, |digest, local| {
            // GIDs are mostly random; FNV-1a mixes the other bytes.
            let hash = local.endpoint.gid.0.iter().fold(0xcbf2_9ce4_8422_2325_u64, |hash, byte| {
                (hash ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3)
            });
            digest ^ hash
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn local(number: u32, kind: EndpointKind, role: EndpointRole) -> LocalEndpoint {
        let session = SessionId([1; 16]);
        let endpoint = Endpoint::example(Gid::new(session, number), kind);
        let (stands_for, only, ring) = (Vec::new(), None, None);
        let (denied, leaving) = (false, false);
        LocalEndpoint { session, endpoint, role, stands_for, only, ring, denied, leaving }
    }

    fn application(number: u32, kind: EndpointKind) -> LocalEndpoint {
        local(number, kind, EndpointRole::Application)
    }

    #[test]
    fn each_writer_of_a_topic_goes_with_each_reader_but_not_with_itself() {
        let mut endpoints = Endpoints::default();
        for (number, kind) in [
            (1, EndpointKind::Publisher),
            (2, EndpointKind::Subscription),
            (3, EndpointKind::Subscription),
        ] {
            endpoints.insert(application(number, kind));
        }
        let mut elsewhere = application(4, EndpointKind::Subscription);
        elsewhere.endpoint.topic = "/other".to_owned();
        endpoints.insert(elsewhere);
        let gid = |number| Gid::new(SessionId([1; 16]), number);
        let pair = |reader| Pair { reader: gid(reader), writer: gid(1) };
        let publisher = endpoints.get(&gid(1)).unwrap().endpoint.clone();
        assert_eq!(endpoints.prospective_pairs(&publisher), [pair(2), pair(3)]);
        let (_, pairs) = endpoints.remove(&gid(3)).unwrap();
        assert_eq!(pairs, [pair(3)]);
        assert_eq!(endpoints.prospective_pairs(&publisher), [pair(2)]);
        assert!(endpoints.remove(&gid(3)).is_none());

        // A client and a server of a service read and write each other.
        let mut service = Endpoints::default();
        service.insert(application(1, EndpointKind::Client));
        service.insert(application(2, EndpointKind::Server));
        let (client, pairs) = service.remove(&gid(1)).unwrap();
        assert_eq!(client.endpoint.kind, EndpointKind::Client);
        assert_eq!(pairs.len(), 2);
    }

    #[test]
    fn a_topic_without_endpoints_is_forgotten() {
        let mut endpoints = Endpoints::default();
        endpoints.insert(application(1, EndpointKind::Publisher));
        endpoints.insert(application(2, EndpointKind::Subscription));
        let gids: Vec<Gid> = endpoints.iter().map(|local| local.endpoint.gid).collect();
        assert_eq!(endpoints.topics().count(), 1);
        gids.iter().for_each(|gid| drop(endpoints.remove(gid)));
        assert_eq!((endpoints.iter().count(), endpoints.topics().count()), (0, 0));
    }

    #[test]
    fn stand_ins_and_relays_go_with_applications_alone() {
        let [application, stand_in, relay] =
            [EndpointRole::Application, EndpointRole::StandIn, EndpointRole::Relay]
                .map(|role| local(1, EndpointKind::Publisher, role));
        assert!(application.may_be_read_by(&application) && application.may_be_read_by(&relay));
        assert!(stand_in.may_be_read_by(&application));
        assert!(!stand_in.may_be_read_by(&relay) && !relay.may_be_read_by(&application));
        let other = LocalEndpoint {
            only: Some(Gid([9; 16])),
            ..local(2, EndpointKind::Subscription, EndpointRole::Relay)
        };
        assert!(!application.may_be_read_by(&other), "it reads another publisher alone");
    }

    #[test]
    fn a_leaving_writer_is_in_no_graph_and_in_no_new_pair() {
        let mut endpoints = Endpoints::default();
        endpoints.insert(application(1, EndpointKind::Publisher));
        let gid = Gid::new(SessionId([1; 16]), 1);
        let before = endpoints.digest();
        assert!(endpoints.set_leaving(&gid, true) && !endpoints.set_leaving(&gid, true));
        assert_eq!(endpoints.shown().count(), 0);
        assert_ne!(endpoints.digest(), before);
        let reader = application(2, EndpointKind::Subscription);
        assert!(!endpoints.get(&gid).unwrap().may_be_read_by(&reader));
        assert!(endpoints.set_leaving(&gid, false));
        assert_eq!(endpoints.digest(), before);
        assert!(!endpoints.set_leaving(&Gid([9; 16]), true), "it may have been refused");
    }
}
