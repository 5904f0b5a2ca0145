//! The properties of this daemon that discovery uses.

use std::net::IpAddr;

use axon_shm::ids::DaemonId;
use axon_transport::config::{Config, DiscoveryRange, QkdPeers, Security};

use crate::wire::SecurityTerms;

/// This daemon, as others are to see it and as it judges others.
#[derive(Clone, Debug)]
pub(crate) struct LocalDaemon {
    /// Its id.
    pub daemon: DaemonId,
    /// `ROS_DOMAIN_ID`.
    pub domain: u32,
    /// Its security settings.
    pub terms: SecurityTerms,
    /// In qkd its SAE ID and those it accepts.
    pub sae: Option<(String, QkdPeers)>,
    /// How far it looks, at first.
    pub range: DiscoveryRange,
    /// `AXON_BIND_ADDRS`.
    pub bind: Vec<IpAddr>,
    /// `AXON_ADVERTISE_ADDRS`.
    pub advertise: Vec<IpAddr>,
}

impl LocalDaemon {
    /// The daemon that `config` describes.
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
            // Sessions say more: `Peers::set_range`.
            range: DiscoveryRange::Off,
            bind: config.bind_addrs.clone(),
            advertise: config.advertise_addrs.clone(),
        }
    }
}
