//! The properties of this daemon that discovery uses.

use std::net::IpAddr;

use axon_shm::ids::DaemonId;
use axon_transport::config::{Config, DiscoveryRange, QkdPeers, Security};

use crate::wire::SecurityTerms;

/// This daemon's data for its own beacons and for its checks of other daemons.
#[derive(Clone, Debug)]
pub(crate) struct LocalDaemon {
    /// The daemon id.
    pub daemon: DaemonId,
    /// `ROS_DOMAIN_ID`.
    pub domain: u32,
    /// The security settings.
    pub terms: SecurityTerms,
    /// This daemon's SAE ID and the accepted ones, in qkd.
    pub sae: Option<(String, QkdPeers)>,
    /// The initial discovery range.
    pub range: DiscoveryRange,
    /// `AXON_BIND_ADDRS`.
    pub bind: Vec<IpAddr>,
    /// `AXON_ADVERTISE_ADDRS`.
    pub advertise: Vec<IpAddr>,
    /// True if links may have two paths: `[link] paths`.
    pub has_two_paths: bool,
}

impl LocalDaemon {
    /// Returns the daemon that `config` describes.
    pub(crate) fn of(config: &Config, daemon: DaemonId) -> Self {
        let sae = match &config.security {
            Security::Classic(_) => None,
            Security::Qkd(qkd) => Some((qkd.sae_id.clone(), qkd.peers.clone())),
        };
        Self {
            daemon,
            domain: config.domain,
            terms: SecurityTerms::of(config),
            sae,
            // Sessions may extend the range: `Peers::set_range`.
            range: DiscoveryRange::Off,
            bind: config.bind_addrs.clone(),
            advertise: config.advertise_addrs.clone(),
            has_two_paths: config.link.paths > 1,
        }
    }
}
