//! Builds the daemon's [`Status`] from the state of the control plane.

mod decisions;
pub(super) mod questions;
mod topics;
pub(super) mod waiting;

use std::collections::BTreeMap;

use axon_shm::{
    ids::{Gid, SessionId},
    internal::descriptors,
};
use axon_transport::{
    config::{KeyMode, Security},
    internal::wire::session::{PROTOCOL, SessionRole},
    status::{DescriptorStatus, DiscoveryStatus, SessionStatus, Status},
};

use self::topics::topics;
use super::plane::ControlPlane;
use crate::discovery::DiscoveryNeeds;

/// Number of hexadecimal characters of a GID that its session determines.
const GID_PREFIX: usize = 24;

/// Answers a session that asks for the status. A session that asks again before it has taken the answer gets the same
/// answer from its beginning.
pub(super) fn send_status(control: &mut ControlPlane, id: &SessionId) {
    // Another user may have begun to read a status before there were access rules.
    let user = control.registry.session(id).and_then(|entry| entry.user);
    let limited = user.is_some() && !control.config.access.is_empty();
    if !limited && control.registry.repeat_status(id) {
        return;
    }
    // The whole status shows all topics, sessions and peers.
    let status = if limited { without_details(control) } else { status(control) };
    let text = match serde_json::to_vec(&status) {
        Ok(text) => text,
        Err(error) => {
            tracing::error!(%error, "the status cannot be written");
            Vec::new()
        }
    };
    control.registry.tell_status(id, text.into());
}

fn status(control: &ControlPlane) -> Status {
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
    let sessions = sessions.map(|(id, s)| {
        let mut session = SessionStatus::default();
        session.user = s.user;
        session.gids = Gid::new(*id, 0).to_string()[..GID_PREFIX].to_owned();
        session.pid = s.pid;
        session.name = s.name.clone();
        session.role =
            if s.role == SessionRole::Gateway { "gateway" } else { "application" }.into();
        session.endpoints = s.endpoints.len();
        session.queued = s.queued();
        session.range = s.scope.as_ref().map(|scope| scope.range.name().to_owned());
        session.range_stated = s.scope.as_ref().is_some_and(|scope| scope.stated);
        session.static_peers =
            s.scope.as_ref().map_or_else(Vec::new, |scope| scope.static_peers.clone());
        session.lists = s.lists.iter().map(ToString::to_string).collect();
        session.relay =
            s.relay.as_deref().map(axon_transport::internal::registry::RelayCounters::show);
        session
    });
    let refused = control.refused_routes.iter().filter_map(|(peer, routes)| {
        let link = control.links.get(peer)?;
        Some((link.host.as_str(), routes.as_slice()))
    });
    let refused: Vec<_> = refused.collect();
    let mut status = of_daemon(control);
    status.mode = mode.into();
    status.key_mode = key_mode;
    status.kex = setting("AXON_QKD_KEX");
    status.cipher = setting("AXON_QUIC_CIPHER").unwrap_or_default();
    status.sae = sae;
    status.socket = control.address.to_string();
    status.runtime_dir = config.runtime_dir.as_ref().map(|dir| dir.display().to_string());
    status.port = control.port;
    status.discovery = discovery(&control.wanted.borrow());
    status.traffic = control.traffic;
    status.descriptors = Some(descriptors(control));
    status.sessions = sessions.collect();
    status.topics = topics(&control.registry, &control.lost.all(), &refused);
    status.links = control.links.values().cloned().collect();
    status.keys = control.keys.clone();
    status.refusals = control.refusals.iter().cloned().collect();
    status.settings = settings;
    status.access_digest = config.access.digest();
    status
}

/// Returns the part of the status that another user of the host may see if the daemon has access rules.
fn without_details(control: &ControlPlane) -> Status {
    let mut status = of_daemon(control);
    status.withheld = true;
    status
}

/// Returns the part of the status about the daemon itself.
fn of_daemon(control: &ControlPlane) -> Status {
    let mut status = Status::default();
    status.daemon = control.id.to_string();
    status.pid = std::process::id();
    status.uptime = control.started.elapsed();
    status.protocol = PROTOCOL;
    status.version = env!("CARGO_PKG_VERSION").into();
    status.domain = control.config.domain;
    status.gateway = control.gateway.clone();
    status
}

fn descriptors(control: &ControlPlane) -> DescriptorStatus {
    let mut shown = DescriptorStatus::default();
    shown.open = descriptors::open();
    shown.limit = descriptors::limit();
    shown.sessions_refused = control.crowded_out;
    shown
}

fn discovery(wanted: &DiscoveryNeeds) -> DiscoveryStatus {
    let host = |(host, port): &(String, Option<u16>)| match port {
        Some(port) if host.contains(':') => format!("[{host}]:{port}"),
        Some(port) => format!("{host}:{port}"),
        None => host.clone(),
    };
    let mut discovery = DiscoveryStatus::default();
    discovery.range = wanted.range.name().to_owned();
    discovery.hosts = wanted.hosts.iter().map(host).collect();
    discovery
}
