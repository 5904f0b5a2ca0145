//! Builds the daemon's [`Status`] from the state of the control plane.

use std::collections::BTreeMap;

use axon_shm::ids::SessionId;
use axon_transport::{
    config::{KeyMode, Security},
    internal::wire::session::{PROTOCOL, SessionRole},
    status::{DiscoveryStatus, SessionStatus, Status},
};

use super::{plane::Control, topics::topics};
use crate::discovery::Wanted;

/// Answers a session that asks for the status. One that asks again before it has taken the
/// answer gets the same one from its beginning.
pub(super) fn send_status(control: &mut Control, id: &SessionId) {
    if control.registry.repeat_status(id) {
        return;
    }
    let text = match serde_json::to_vec(&status(control)) {
        Ok(text) => text,
        Err(error) => {
            tracing::error!(%error, "the status cannot be written");
            Vec::new()
        }
    };
    control.registry.tell_status(id, text.into());
}

fn status(control: &Control) -> Status {
    let config = &control.config;
    let settings: BTreeMap<String, String> = control.admission.settings().iter().cloned().collect();
    let setting = |name: &str| settings.get(name).cloned();
    let (mode, key_mode, sae) = match &config.security {
        Security::Classic(_) => ("classic", None, None),
        Security::Qkd(qkd) => {
            let key_mode = match qkd.key_mode {
                KeyMode::Session => "session",
                KeyMode::Messages10 => "messages10",
            };
            ("qkd", Some(key_mode.to_owned()), Some(qkd.sae_id.clone()))
        }
    };
    let sessions = control.registry.sessions().filter(|(_, s)| s.role != SessionRole::Tool);
    let sessions = sessions.map(|(_, s)| SessionStatus {
        pid: s.pid,
        name: s.name.clone(),
        role: if s.role == SessionRole::Gateway { "gateway" } else { "application" }.into(),
        endpoints: s.endpoints.len(),
        queued: s.queued(),
        range: s.scope.as_ref().map(|scope| scope.range.name().to_owned()),
        range_stated: s.scope.as_ref().is_some_and(|scope| scope.stated),
        static_peers: s.scope.as_ref().map_or_else(Vec::new, |scope| scope.static_peers.clone()),
        lists: s.lists.iter().map(ToString::to_string).collect(),
        relay: s.relay.as_deref().map(axon_transport::internal::registry::RelayCounters::show),
    });
    let refused = control.refused_routes.iter().filter_map(|(peer, routes)| {
        let link = control.links.get(peer)?;
        Some((link.host.as_str(), routes.as_slice()))
    });
    let refused: Vec<_> = refused.collect();
    Status {
        daemon: control.id.to_string(),
        pid: std::process::id(),
        uptime_s: control.started.elapsed().as_secs(),
        protocol: PROTOCOL,
        version: env!("CARGO_PKG_VERSION").into(),
        domain: config.domain,
        mode: mode.into(),
        key_mode,
        kex: setting("AXON_QKD_KEX"),
        cipher: setting("AXON_QUIC_CIPHER").unwrap_or_default(),
        sae,
        socket: control.address.to_string(),
        runtime_dir: config.runtime_dir.as_ref().map(|dir| dir.display().to_string()),
        port: control.port,
        gateway: control.gateway.clone(),
        discovery: discovery(&control.wanted.borrow()),
        traffic: control.traffic,
        sessions: sessions.collect(),
        topics: topics(&control.registry, &control.lost.all(), &refused),
        links: control.links.values().cloned().collect(),
        keys: control.keys.clone(),
        refusals: control.refusals.iter().cloned().collect(),
        settings,
    }
}

fn discovery(wanted: &Wanted) -> DiscoveryStatus {
    let host = |(host, port): &(String, Option<u16>)| match port {
        Some(port) if host.contains(':') => format!("[{host}]:{port}"),
        Some(port) => format!("{host}:{port}"),
        None => host.clone(),
    };
    DiscoveryStatus {
        range: wanted.range.name().to_owned(),
        hosts: wanted.hosts.iter().map(host).collect(),
    }
}
