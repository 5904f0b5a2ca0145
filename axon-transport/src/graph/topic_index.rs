//! Endpoints by topic and kind. An endpoint finds its counterparts without a look at all others.
//!
//! Plain data.

use std::collections::{BTreeSet, HashMap};

use super::{Endpoint, EndpointKind};
use crate::ids::Gid;

/// The GIDs of one topic's or service's endpoints, by kind.
#[derive(Clone, Debug, Default)]
struct Members([BTreeSet<Gid>; 4]);

/// The GIDs of endpoints by topic or service, and by kind. Nodes have no topic and are not in it.
#[derive(Clone, Debug, Default)]
pub(crate) struct TopicIndex(HashMap<String, Members>);

impl TopicIndex {
    /// Adds an endpoint.
    pub(crate) fn insert(&mut self, endpoint: &Endpoint) {
        let Some(place) = place(endpoint.kind) else { return };
        if let Some(members) = self.0.get_mut(&endpoint.topic) {
            members.0[place].insert(endpoint.gid);
            return;
        }
        let members = self.0.entry(endpoint.topic.clone()).or_default();
        members.0[place].insert(endpoint.gid);
    }

    /// Removes an endpoint. A topic without endpoints is forgotten.
    pub(crate) fn remove(&mut self, endpoint: &Endpoint) {
        let Some(place) = place(endpoint.kind) else { return };
        if let Some(members) = self.0.get_mut(&endpoint.topic) {
            members.0[place].remove(&endpoint.gid);
            if members.0.iter().all(BTreeSet::is_empty) {
                self.0.remove(&endpoint.topic);
            }
        }
    }

    /// Returns whether the endpoint is in it.
    pub(crate) fn contains(&self, endpoint: &Endpoint) -> bool {
        let all = place(endpoint.kind).zip(self.0.get(&endpoint.topic));
        all.is_some_and(|(place, members)| members.0[place].contains(&endpoint.gid))
    }

    /// Returns the endpoints of the kind with which `endpoint` communicates, on its topic. They may differ in type
    /// and QoS.
    pub(crate) fn counterparts(&self, endpoint: &Endpoint) -> impl Iterator<Item = &Gid> {
        let all = counterpart(endpoint.kind).and_then(place).zip(self.0.get(&endpoint.topic));
        all.into_iter().flat_map(|(place, members)| &members.0[place])
    }
}

impl<'a> FromIterator<&'a Endpoint> for TopicIndex {
    fn from_iter<I: IntoIterator<Item = &'a Endpoint>>(endpoints: I) -> Self {
        let mut index = Self::default();
        endpoints.into_iter().for_each(|endpoint| index.insert(endpoint));
        index
    }
}

fn place(kind: EndpointKind) -> Option<usize> {
    match kind {
        EndpointKind::Publisher => Some(0),
        EndpointKind::Subscription => Some(1),
        EndpointKind::Server => Some(2),
        EndpointKind::Client => Some(3),
        EndpointKind::Node => None,
    }
}

/// Returns the kind with which a kind communicates.
fn counterpart(kind: EndpointKind) -> Option<EndpointKind> {
    match kind {
        EndpointKind::Publisher => Some(EndpointKind::Subscription),
        EndpointKind::Subscription => Some(EndpointKind::Publisher),
        EndpointKind::Server => Some(EndpointKind::Client),
        EndpointKind::Client => Some(EndpointKind::Server),
        EndpointKind::Node => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::graph::{Pairing, pairing};

    const KINDS: [EndpointKind; 5] = [
        EndpointKind::Publisher,
        EndpointKind::Subscription,
        EndpointKind::Server,
        EndpointKind::Client,
        EndpointKind::Node,
    ];

    fn endpoint(number: u8, kind: EndpointKind, topic: &str) -> Endpoint {
        Endpoint { topic: topic.into(), ..Endpoint::example(Gid([number; 16]), kind) }
    }

    #[test]
    fn counterparts_are_all_endpoints_that_can_be_a_pair_and_no_others() {
        let mut all = Vec::new();
        for (at, topic) in ["/a", "/b"].into_iter().enumerate() {
            for (kind_at, kind) in KINDS.into_iter().enumerate() {
                all.push(endpoint((10 * at + kind_at) as u8, kind, topic));
                all.push(endpoint((100 + 10 * at + kind_at) as u8, kind, topic));
            }
        }
        let index: TopicIndex = all.iter().collect();
        for one in &all {
            let related = |other: &&Endpoint| {
                pairing(one, other) != Pairing::Unrelated
                    || pairing(other, one) != Pairing::Unrelated
            };
            let expected: BTreeSet<Gid> = all.iter().filter(related).map(|e| e.gid).collect();
            assert_eq!(index.counterparts(one).copied().collect::<BTreeSet<_>>(), expected);
            assert_eq!(index.contains(one), one.kind != EndpointKind::Node);
        }
    }

    #[test]
    fn removed_endpoints_leave_nothing() {
        let all: Vec<_> =
            KINDS.into_iter().zip(0..).map(|(kind, at)| endpoint(at, kind, "/a")).collect();
        let mut index: TopicIndex = all.iter().collect();
        all.iter().for_each(|one| index.remove(one));
        all.iter().for_each(|one| index.remove(one));
        assert!(index.0.is_empty());
        assert!(!index.contains(&all[0]));
        assert_eq!(index.counterparts(&all[0]).count(), 0);
    }
}
