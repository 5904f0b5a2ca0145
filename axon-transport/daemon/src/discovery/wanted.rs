//! The union of the ranges and peers that a daemon's sessions need from discovery.

use std::collections::BTreeSet;

use axon_transport::{
    config::{Config, DiscoveryRange},
    internal::graph::Scope,
};

/// Maximum number of hosts that are looked for by address or name.
const MOST_HOSTS: usize = 128;

/// The discovery that the sessions of a daemon need together.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct DiscoveryNeeds {
    /// The widest range of any: multicast in SUBNET alone, silence in OFF.
    pub range: DiscoveryRange,
    /// Hosts to look for, each with a port where one was given.
    pub hosts: BTreeSet<(String, Option<u16>)>,
}

impl DiscoveryNeeds {
    /// Returns the needs of sessions with the given `scopes`. A daemon without a session follows its own settings, so
    /// that a daemon that was started by hand has its links before its first session comes.
    ///
    /// `AXON_DAEMON_PEERS` lists more hosts on which to look for peers of SUBNET sessions; it widens no range.
    pub(crate) fn of<'a>(config: &Config, scopes: impl IntoIterator<Item = &'a Scope>) -> Self {
        let mut range = None;
        let mut hosts: BTreeSet<(String, Option<u16>)> = BTreeSet::new();
        for scope in scopes {
            range = range.max(Some(scope.range));
            hosts.extend(scope.static_peers.iter().map(|host| (host.clone(), None)));
        }
        if range.is_none() {
            hosts.extend(config.static_peers.iter().map(|host| (host.clone(), None)));
        }
        let range = range.unwrap_or(config.range);
        if range == DiscoveryRange::Subnet {
            hosts.extend(config.daemon_peers.iter().map(|peer| (peer.host.clone(), peer.port)));
        }
        if hosts.len() > MOST_HOSTS {
            tracing::warn!(
                hosts = hosts.len(),
                "static peers: {MOST_HOSTS} of them are looked for; have the sessions list fewer"
            );
            hosts = hosts.into_iter().take(MOST_HOSTS).collect();
        }
        Self { range, hosts }
    }
}
