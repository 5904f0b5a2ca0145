//! Puts the status together.
//!
//! Counters of samples are read from the descriptors of sessions' segments, at the offsets of
//! `docs/formats.md`, section 9: the daemon maps no session's memory.

use std::{collections::BTreeMap, os::fd::AsFd, sync::Arc};

use super::{
    control::Control,
    registry::{LocalEndpoint, Registry, SessionEntry},
    status::{ReaderStatus, SessionStatus, Status, TopicStatus},
};
use crate::{
    config::{KeyMode, Security},
    graph::{Endpoint, EndpointKind},
    passed::PassedFd,
    session::message::{EndpointRole, PROTOCOL, SessionRole},
    shm::Location,
};

const RING_PUBLISHED: u64 = 136;
const LANE_RECEIVED: u64 = 16;
const LANE_LOST: u64 = 24;

pub(super) fn status(control: &Control) -> Status {
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
    });
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
        sessions: sessions.collect(),
        topics: topics(&control.registry),
        links: control.links.values().cloned().collect(),
        keys: control.keys.clone(),
        refusals: control.refusals.iter().cloned().collect(),
        settings,
    }
}

fn topics(registry: &Registry<Arc<PassedFd>>) -> Vec<TopicStatus> {
    let mut topics: BTreeMap<(String, String), TopicStatus> = BTreeMap::new();
    for local in registry.endpoints().filter(|e| e.endpoint.kind != EndpointKind::Node) {
        let topic = entry(&mut topics, &local.endpoint);
        match (local.endpoint.kind, local.role) {
            (EndpointKind::Publisher, EndpointRole::Application) => {
                topic.publishers += 1;
                topic.published += published(registry, local);
            }
            (EndpointKind::Publisher, _) => topic.arrived += published(registry, local),
            (EndpointKind::Subscription, EndpointRole::Application) => topic.subscriptions += 1,
            _ => {}
        }
    }
    for (_, endpoint) in registry.remote_endpoints().filter(|(_, e)| e.kind != EndpointKind::Node) {
        let topic = entry(&mut topics, endpoint);
        match endpoint.kind {
            EndpointKind::Publisher => topic.remote_publishers += 1,
            EndpointKind::Subscription => topic.remote_subscriptions += 1,
            EndpointKind::Server | EndpointKind::Client | EndpointKind::Node => {}
        }
    }
    let locals: BTreeMap<_, _> = registry.endpoints().map(|e| (e.endpoint.gid, e)).collect();
    for attach in registry.attached() {
        let Some(reader) = locals.get(&attach.reader) else { continue };
        let Some(session) = registry.session(&attach.session) else { continue };
        entry(&mut topics, &reader.endpoint).readers.push(ReaderStatus {
            pid: session.pid,
            reader: attach.reader.to_string(),
            writer: attach.writer.to_string(),
            relay: reader.role == EndpointRole::Relay,
            received: word(session, attach.lane, LANE_RECEIVED),
            lost: word(session, attach.lane, LANE_LOST),
        });
    }
    topics.into_values().collect()
}

fn entry<'a>(
    topics: &'a mut BTreeMap<(String, String), TopicStatus>,
    endpoint: &Endpoint,
) -> &'a mut TopicStatus {
    let (topic, type_name) = (endpoint.topic.clone(), endpoint.type_name.clone());
    topics.entry((topic.clone(), type_name.clone())).or_insert_with(|| TopicStatus {
        topic,
        type_name,
        ..TopicStatus::default()
    })
}

/// What a publisher has published.
fn published(registry: &Registry<Arc<PassedFd>>, local: &LocalEndpoint) -> u64 {
    match (registry.session(&local.session), local.ring) {
        (Some(session), Some(ring)) => word(session, ring, RING_PUBLISHED),
        _ => 0,
    }
}

/// A word of an object in a session's memory; 0 when it is not there.
fn word(session: &SessionEntry<Arc<PassedFd>>, at: Location, offset: u64) -> u64 {
    let memory = match (at.segment, &session.descriptors) {
        (0, Some([first, ..])) => Some(first),
        (number, _) => session.segments.get(&number).map(|segment| &segment.descriptor),
    };
    let (Some(memory), Some(offset)) = (memory, at.offset.checked_add(offset)) else { return 0 };
    let mut bytes = [0; 8];
    match rustix::io::pread(memory.as_fd(), &mut bytes, offset) {
        Ok(8) => u64::from_ne_bytes(bytes),
        _ => 0,
    }
}
