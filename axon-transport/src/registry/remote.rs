//! The endpoints on other hosts, as their daemons reported them.

use std::collections::BTreeMap;

use crate::{
    graph::{Endpoint, LIMITS, RemoteEndpoint},
    ids::{DaemonId, Gid},
};

/// The endpoints of other hosts, limited per host. Each GID belongs to one host only.
#[derive(Debug, Default)]
pub(super) struct RemoteEndpoints(BTreeMap<DaemonId, BTreeMap<Gid, RemoteEndpoint>>);

/// The change of an endpoint that another host reports.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum RemoteChange {
    /// The endpoint is new.
    New,
    /// The discovery range of the endpoint changed.
    Range,
    /// Nothing changed that matching depends on.
    Known,
}

impl RemoteEndpoints {
    pub(super) fn iter(&self) -> impl Iterator<Item = (&DaemonId, &RemoteEndpoint)> {
        self.0.iter().flat_map(|(daemon, all)| all.values().map(move |remote| (daemon, remote)))
    }

    pub(super) fn get(&self, daemon: &DaemonId, gid: &Gid) -> Option<&RemoteEndpoint> {
        self.0.get(daemon)?.get(gid)
    }

    /// Finds an endpoint on any host.
    pub(super) fn find(&self, gid: &Gid) -> Option<(&DaemonId, &RemoteEndpoint)> {
        self.0.iter().find_map(|(daemon, all)| Some((daemon, all.get(gid)?)))
    }

    /// Adds an endpoint of a host. Refuses it with `None` if it is out of bounds, if the host has the maximum number,
    /// or if another host has it.
    pub(super) fn insert(
        &mut self,
        daemon: DaemonId,
        remote: &RemoteEndpoint,
    ) -> Option<RemoteChange> {
        let Endpoint { gid, .. } = *remote.endpoint;
        let elsewhere =
            self.0.iter().any(|(other, all)| *other != daemon && all.contains_key(&gid));
        let all = self.0.entry(daemon).or_default();
        if elsewhere || !remote.endpoint.is_sane() || all.len() >= LIMITS.endpoints {
            return None;
        }
        Some(match all.insert(gid, remote.clone()) {
            None => RemoteChange::New,
            Some(before) if before.toward != remote.toward => RemoteChange::Range,
            Some(_) => RemoteChange::Known,
        })
    }

    /// Removes an endpoint that a host no longer has.
    pub(super) fn remove(&mut self, daemon: &DaemonId, gid: &Gid) -> Option<RemoteEndpoint> {
        self.0.get_mut(daemon)?.remove(gid)
    }

    /// Removes a host that is gone. Returns its GIDs.
    pub(super) fn remove_host(&mut self, daemon: &DaemonId) -> impl Iterator<Item = Gid> {
        self.0.remove(daemon).unwrap_or_default().into_keys()
    }

    /// Removes an endpoint from all hosts, whatever their daemons report. Returns whether a host had it.
    pub(super) fn disown(&mut self, gid: &Gid) -> bool {
        let removed = self.0.values_mut().filter_map(|all| all.remove(gid));
        removed.count() > 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::graph::EndpointKind;

    const HOST: DaemonId = DaemonId([1; 16]);
    const OTHER: DaemonId = DaemonId([2; 16]);

    fn remote(number: u32) -> RemoteEndpoint {
        let mut gid = [9; 16];
        gid[12..].copy_from_slice(&number.to_be_bytes());
        Endpoint::example(Gid(gid), EndpointKind::Publisher).into()
    }

    #[test]
    fn a_gid_is_of_the_host_that_told_of_it_first() {
        let mut all = RemoteEndpoints::default();
        assert_eq!(all.insert(HOST, &remote(1)), Some(RemoteChange::New));
        assert_eq!(all.insert(OTHER, &remote(1)), None);
        assert_eq!(all.insert(HOST, &remote(1)), Some(RemoteChange::Known));
        let gid = remote(1).endpoint.gid;
        assert_eq!(all.find(&gid).unwrap().0, &HOST);
        assert!(all.remove(&OTHER, &gid).is_none() && all.remove(&HOST, &gid).is_some());
        assert_eq!(all.insert(OTHER, &remote(1)), Some(RemoteChange::New));
        assert!(all.disown(&gid) && !all.disown(&gid));
        assert!(all.find(&gid).is_none());
    }

    #[test]
    fn a_host_has_as_many_endpoints_as_it_may() {
        let mut all = RemoteEndpoints::default();
        let most = u32::try_from(LIMITS.endpoints).unwrap();
        for number in 0..most {
            assert_eq!(all.insert(HOST, &remote(number)), Some(RemoteChange::New));
        }
        assert_eq!(all.insert(HOST, &remote(most)), None);
        assert_eq!(all.insert(OTHER, &remote(most)), Some(RemoteChange::New));
        let gone: Vec<Gid> = all.remove_host(&HOST).collect();
        assert_eq!(gone.len(), LIMITS.endpoints);
        assert_eq!(all.iter().count(), 1);
    }

    #[test]
    fn an_endpoint_out_of_bounds_is_refused() {
        let mut endpoint = Endpoint::example(Gid([9; 16]), EndpointKind::Publisher);
        endpoint.topic = "t".repeat(1 << 20);
        assert_eq!(RemoteEndpoints::default().insert(HOST, &endpoint.into()), None);
    }
}
