//! The topics in the daemon's status.
//!
//! The daemon reads the counters of publishers and readers through the descriptors of their sessions' segments. It
//! maps no session's memory.

use std::{
    cmp::Reverse,
    collections::{BTreeMap, HashMap},
    os::fd::{AsFd, BorrowedFd},
    sync::Arc,
    time::{Duration, SystemTime},
};

use axon_shm::{
    internal::{
        Location,
        descriptors::PassedFd,
        inspect::{self, LaneCounts, RingCounts},
    },
    qos::{History, Qos},
};
use axon_transport::{
    graph::{Endpoint, EndpointKind},
    internal::{
        registry::{LocalEndpoint, Registry, SessionEntry},
        wire::session::{Attach, EndpointRole},
    },
    status::{OutOfRangeStatus, ReaderStatus, RefusedRouteStatus, TopicStatus, WriterStatus},
};

use super::waiting::waiting;
use crate::{bridge::RefusedRoute, control::losses::ByTopic};

/// Maximum number of publishers, of readers, and of endpoints with refused routes that the status lists for a topic.
const LISTED: usize = 64;
/// Maximum number of readers that are read for one status: few enough that it takes a fraction of a second.
const LOOKED_AT: usize = 1 << 16;
/// Maximum number of pairs out of range that the status lists, over all topics.
const KEPT_APART: usize = 64;

type Sessions = Registry<Arc<PassedFd>>;
type ShmSession = SessionEntry<Arc<PassedFd>>;

/// Returns all topics that have an endpoint on any host.
pub(super) fn topics(
    registry: &Sessions,
    lost: &ByTopic,
    refused: &[(&str, &[RefusedRoute])],
) -> Vec<TopicStatus> {
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
                    add(&mut topic.published, published);
                } else {
                    add(&mut topic.arrived, published);
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
    for attach in registry.attached().take(LOOKED_AT) {
        let Some(local) = locals.get(&attach.reader) else { continue };
        let Some(session) = registry.session(&attach.session) else { continue };
        let stopped = *processes.entry(session.pid).or_insert_with(|| is_stopped(session.pid));
        let mut reader = reader(session, local, attach, rings.get(&attach.writer));
        reader.stopped = stopped;
        entry(&mut topics, &local.endpoint).readers.push(reader);
    }
    for apart in registry.kept_apart(KEPT_APART, LOOKED_AT) {
        if let Some(topic) = topics.get_mut(&(apart.topic, apart.type_name)) {
            let mut pair = OutOfRangeStatus::default();
            pair.writer = apart.pair.writer.to_string();
            pair.reader = apart.pair.reader.to_string();
            pair.reason = apart.why.to_string();
            topic.out_of_range.push(pair);
        }
    }
    show_refused(registry, &mut topics, refused);
    let mut topics: Vec<_> = topics.into_values().map(summed_up).collect();
    for (name, causes) in lost {
        let known = topics.iter().position(|topic| topic.topic == *name);
        let index = known.unwrap_or_else(|| {
            let mut topic = TopicStatus::default();
            topic.topic = name.clone();
            topics.push(topic);
            topics.len() - 1
        });
        for (cause, samples) in causes {
            add(topics[index].dropped.entry((*cause).to_owned()).or_default(), *samples);
        }
    }
    topics
}

/// Adds the endpoints that wait for routes which peers, or this host, refused.
fn show_refused(
    registry: &Sessions,
    topics: &mut BTreeMap<(String, String), TopicStatus>,
    refused: &[(&str, &[RefusedRoute])],
) {
    for (host, routes) in refused {
        for (local, route) in waiting(registry, routes) {
            let reason = route.reason.clone();
            show_at(entry(topics, &local.endpoint), &local.endpoint, (*host).to_owned(), reason);
        }
    }
    // Adds the endpoints that this daemon refused.
    for (_, session) in registry.sessions() {
        for (endpoint, why) in session.refused_endpoints() {
            show_at(entry(topics, endpoint), endpoint, String::new(), why.to_owned());
        }
    }
}

fn show_at(topic: &mut TopicStatus, endpoint: &Endpoint, host: String, reason: String) {
    if topic.refused.len() < LISTED {
        let mut route = RefusedRouteStatus::default();
        (route.endpoint, route.host, route.reason) = (endpoint.gid.to_string(), host, reason);
        topic.refused.push(route);
    }
}

fn entry<'a>(
    topics: &'a mut BTreeMap<(String, String), TopicStatus>,
    endpoint: &Endpoint,
) -> &'a mut TopicStatus {
    let (name, type_name) = (endpoint.topic.clone(), endpoint.type_name.clone());
    topics.entry((name.clone(), type_name.clone())).or_insert_with(|| {
        let mut topic = TopicStatus::default();
        (topic.topic, topic.type_name) = (name, type_name);
        topic
    })
}

fn writer(session: &ShmSession, local: &LocalEndpoint, counts: &RingCounts) -> WriterStatus {
    let gid = local.endpoint.gid;
    let own = session.segments.iter().filter(|s| s.segment.publisher == Some(gid));
    let own = own.map(|segment| inspect::committed(segment.descriptor.as_fd()));
    let own = own.fold(0, u64::saturating_add);
    let mut writer = WriterStatus::default();
    writer.pid = session.pid;
    writer.writer = gid.to_string();
    writer.stand_in = local.role == EndpointRole::StandIn;
    writer.depth = depth(&local.endpoint.qos);
    writer.window = counts.window;
    writer.bytes_committed = own.saturating_add(counts.bytes);
    writer.published = counts.published;
    writer.blocked = counts.blocked;
    writer.no_memory = counts.no_memory;
    writer.pinned = counts.pinned;
    writer
}

fn reader(
    session: &ShmSession,
    local: &LocalEndpoint,
    attach: &Attach,
    ring: Option<&(&ShmSession, RingCounts)>,
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
    let mut reader = ReaderStatus::default();
    reader.pid = session.pid;
    reader.reader = attach.reader.to_string();
    reader.writer = attach.writer.to_string();
    reader.relay = local.role == EndpointRole::Relay;
    reader.depth = depth;
    reader.unread = unread.min(depth.map_or(u64::MAX, u64::from));
    reader.received = lane.received;
    reader.lost = lane.lost;
    reader.skipped = lane.skipped;
    reader.waiting = waiting;
    reader
}

/// Returns the number of kept samples that the reader has not taken.
fn unread(counts: &RingCounts, lane: &LaneCounts) -> u64 {
    let (tail, head) = counts.standing;
    head.saturating_sub(lane.cursor.max(tail))
}

/// Returns the publication time of the oldest sample that the reader has not taken. If that sample is not kept any
/// more, returns the time of the one before it, which the reader has taken: it is hardly older on such a busy topic.
fn oldest_unread(writer: &ShmSession, counts: &RingCounts, lane: &LaneCounts) -> Option<i64> {
    let (tail, _) = counts.standing;
    if let (true, Some(taken)) = (lane.cursor < tail, lane.taken) {
        return Some(taken);
    }
    let position = lane.cursor.max(tail);
    let at = counts.descriptor(position)?;
    inspect::timestamp(memory(writer, at)?, at, position)
}

fn summed_up(mut topic: TopicStatus) -> TopicStatus {
    for writer in &topic.writers {
        add(&mut topic.bytes_committed, writer.bytes_committed);
    }
    let mut drop = |cause: &str, count: u64| {
        if count > 0 {
            add(topic.dropped.entry(cause.to_owned()).or_default(), count);
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
    let worst_first = |reader: &ReaderStatus| Reverse((reader.waiting, reader.lost));
    topic.readers.sort_by_key(worst_first);
    topic.more_readers = topic.readers.len().saturating_sub(LISTED);
    topic.readers.truncate(LISTED);
    let largest_first = |writer: &WriterStatus| Reverse(writer.bytes_committed);
    topic.writers.sort_by_key(largest_first);
    topic.more_writers = topic.writers.len().saturating_sub(LISTED);
    topic.writers.truncate(LISTED);
    topic
}

/// Adds a count of another process, which may be any number.
fn add(sum: &mut u64, count: u64) {
    *sum = sum.saturating_add(count);
}

/// Returns the depth; `None` for KEEP_ALL.
fn depth(qos: &Qos) -> Option<u32> {
    (qos.history == History::KeepLast).then_some(qos.depth)
}

/// Returns a publisher's session and its counters.
fn ring<'a>(registry: &'a Sessions, local: &LocalEndpoint) -> Option<(&'a ShmSession, RingCounts)> {
    let (session, at) = (registry.session(&local.session)?, local.ring?);
    Some((session, RingCounts::read(memory(session, at)?, at)?))
}

/// Returns the segment that contains an object of a session.
fn memory(session: &ShmSession, at: Location) -> Option<BorrowedFd<'_>> {
    match (at.segment, &session.descriptors) {
        (0, Some([first, ..])) => Some(first.as_fd()),
        (number, _) => session.segments.get(number).map(|segment| segment.descriptor.as_fd()),
    }
}

/// Returns whether a process is stopped, by a signal or a debugger.
fn is_stopped(pid: u32) -> bool {
    let Ok(stat) = std::fs::read(format!("/proc/{pid}/stat")) else { return false };
    // The name in front of it may contain any characters.
    let state = stat.iter().rposition(|byte| *byte == b')').and_then(|end| stat.get(end + 2));
    matches!(state, Some(b'T' | b't'))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn topic_sums_saturate_and_list_the_worst_endpoints() {
        let mut topic = TopicStatus::default();
        for number in 0..100 {
            let mut reader = ReaderStatus::default();
            reader.lost = u64::MAX;
            reader.waiting = (number % 2 == 0).then(|| Duration::from_millis(number));
            topic.readers.push(reader);
            let mut writer = WriterStatus::default();
            writer.bytes_committed = u64::MAX - number;
            writer.blocked = u64::MAX;
            topic.writers.push(writer);
        }
        let topic = summed_up(topic);
        assert_eq!(topic.bytes_committed, u64::MAX);
        assert!(topic.dropped.values().all(|count| *count == u64::MAX));
        assert_eq!((topic.readers.len(), topic.more_readers), (LISTED, 36));
        assert_eq!((topic.writers.len(), topic.more_writers), (LISTED, 36));
        assert_eq!(topic.readers[0].waiting, Some(Duration::from_millis(98)));
        assert!(topic.readers[..50].iter().all(|reader| reader.waiting.is_some()));
        assert_eq!(topic.writers[0].bytes_committed, u64::MAX);
    }
}
