//! What the status says of topics.
//!
//! What publishers and readers count is read from the descriptors of their sessions' segments: the
//! daemon maps no session's memory.

use std::{
    collections::{BTreeMap, HashMap},
    os::fd::{AsFd, BorrowedFd},
    sync::Arc,
    time::{Duration, SystemTime},
};

use super::{
    registry::{LocalEndpoint, Registry, SessionEntry},
    status::{ReaderStatus, TopicStatus, WriterStatus},
};
use crate::{
    graph::{Endpoint, EndpointKind},
    passed::PassedFd,
    qos::{History, Qos},
    session::message::{Attach, EndpointRole},
    shm::{
        Location,
        inspect::{self, LaneCounts, RingCounts},
    },
};

type Sessions = Registry<Arc<PassedFd>>;
type Session = SessionEntry<Arc<PassedFd>>;

/// All topics with an endpoint somewhere.
pub(super) fn topics(registry: &Sessions) -> Vec<TopicStatus> {
    let mut topics: BTreeMap<(String, String), TopicStatus> = BTreeMap::new();
    let mut rings = HashMap::new();
    for local in registry.endpoints().filter(|e| e.endpoint.kind != EndpointKind::Node) {
        let topic = entry(&mut topics, &local.endpoint);
        match local.endpoint.kind {
            EndpointKind::Publisher => {
                let ring = ring(registry, local);
                let published = ring.as_ref().map_or(0, |(_, counts)| counts.published);
                if local.role == EndpointRole::Application {
                    topic.publishers += 1;
                    topic.published += published;
                } else {
                    topic.arrived += published;
                }
                if let Some((session, counts)) = ring {
                    topic.writers.push(writer(session, local, &counts));
                    rings.insert(local.endpoint.gid, (session, counts));
                }
            }
            EndpointKind::Subscription if local.role == EndpointRole::Application => {
                topic.subscriptions += 1;
            }
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
    let locals: HashMap<_, _> = registry.endpoints().map(|e| (e.endpoint.gid, e)).collect();
    let mut processes = HashMap::new();
    for attach in registry.attached() {
        let Some(local) = locals.get(&attach.reader) else { continue };
        let Some(session) = registry.session(&attach.session) else { continue };
        let stopped = *processes.entry(session.pid).or_insert_with(|| is_stopped(session.pid));
        let mut reader = reader(session, local, attach, rings.get(&attach.writer));
        reader.stopped = stopped;
        entry(&mut topics, &local.endpoint).readers.push(reader);
    }
    topics.into_values().map(summed_up).collect()
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

fn writer(session: &Session, local: &LocalEndpoint, counts: &RingCounts) -> WriterStatus {
    let gid = local.endpoint.gid;
    let own = session.segments.values().filter(|s| s.segment.publisher == Some(gid));
    let own: u64 = own.map(|segment| inspect::committed(segment.descriptor.as_fd())).sum();
    WriterStatus {
        pid: session.pid,
        writer: gid.to_string(),
        stand_in: local.role == EndpointRole::StandIn,
        depth: depth(&local.endpoint.qos),
        window: counts.window,
        bytes_committed: own.saturating_add(counts.bytes),
        published: counts.published,
        blocked: counts.blocked,
        no_memory: counts.no_memory,
        pinned: counts.pinned,
    }
}

fn reader(
    session: &Session,
    local: &LocalEndpoint,
    attach: &Attach,
    ring: Option<&(&Session, RingCounts)>,
) -> ReaderStatus {
    let lane = memory(session, attach.lane).and_then(|m| LaneCounts::read(m, attach.lane));
    let lane = lane.unwrap_or_default();
    let unread = ring.map_or(0, |(_, counts)| unread(counts, &lane));
    let waiting = ring.filter(|_| unread > 0).and_then(|(writer, counts)| {
        let since = oldest_unread(writer, counts, &lane)?;
        let since = SystemTime::UNIX_EPOCH + Duration::from_nanos(u64::try_from(since).ok()?);
        Some(SystemTime::now().duration_since(since).unwrap_or_default())
    });
    let depth = depth(&local.endpoint.qos);
    ReaderStatus {
        pid: session.pid,
        reader: attach.reader.to_string(),
        writer: attach.writer.to_string(),
        relay: local.role == EndpointRole::Relay,
        depth,
        unread: unread.min(depth.map_or(u64::MAX, u64::from)),
        received: lane.received,
        lost: lane.lost,
        skipped: lane.skipped,
        waiting_ms: waiting.map(|age| u64::try_from(age.as_millis()).unwrap_or(u64::MAX)),
        stopped: false,
    }
}

/// Samples that stand and that the reader has not taken.
fn unread(counts: &RingCounts, lane: &LaneCounts) -> u64 {
    let (tail, head) = counts.standing;
    head.saturating_sub(lane.cursor.max(tail))
}

/// When the oldest sample was published that the reader has not taken. Where that does not stand
/// any more, the one before it, which the reader has taken: hardly older on a topic so busy.
fn oldest_unread(writer: &Session, counts: &RingCounts, lane: &LaneCounts) -> Option<i64> {
    let (tail, _) = counts.standing;
    if let (true, Some(taken)) = (lane.cursor < tail, lane.taken) {
        return Some(taken);
    }
    let position = lane.cursor.max(tail);
    let at = counts.descriptor(position)?;
    inspect::timestamp(memory(writer, at)?, at, position)
}

fn summed_up(mut topic: TopicStatus) -> TopicStatus {
    topic.bytes_committed = topic.writers.iter().map(|writer| writer.bytes_committed).sum();
    let mut drop = |cause: &str, count: u64| {
        if count > 0 {
            *topic.dropped.entry(cause.to_owned()).or_default() += count;
        }
    };
    for reader in &topic.readers {
        drop("overwritten", reader.lost);
    }
    for writer in &topic.writers {
        drop("blocked", writer.blocked);
        drop("no_memory", writer.no_memory);
        drop("pinned", writer.pinned);
    }
    topic
}

/// `None` for KEEP_ALL.
fn depth(qos: &Qos) -> Option<u32> {
    (qos.history == History::KeepLast).then_some(qos.depth)
}

/// What a publisher counts, and its session.
fn ring<'a>(registry: &'a Sessions, local: &LocalEndpoint) -> Option<(&'a Session, RingCounts)> {
    let (session, at) = (registry.session(&local.session)?, local.ring?);
    Some((session, RingCounts::read(memory(session, at)?, at)?))
}

/// The segment that an object of a session is in.
fn memory(session: &Session, at: Location) -> Option<BorrowedFd<'_>> {
    match (at.segment, &session.descriptors) {
        (0, Some([first, ..])) => Some(first.as_fd()),
        (number, _) => session.segments.get(&number).map(|segment| segment.descriptor.as_fd()),
    }
}

/// Whether a process is stopped, by a signal or a debugger.
fn is_stopped(pid: u32) -> bool {
    let Ok(stat) = std::fs::read(format!("/proc/{pid}/stat")) else { return false };
    // The name before it may hold anything.
    let state = stat.iter().rposition(|byte| *byte == b')').and_then(|end| stat.get(end + 2));
    matches!(state, Some(b'T' | b't'))
}
