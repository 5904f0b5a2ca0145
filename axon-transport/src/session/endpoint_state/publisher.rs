//! The writing side of a publisher, client or server.

use std::{
    collections::BTreeSet,
    sync::{Mutex, MutexGuard, PoisonError},
};

use axon_shm::{
    PublishError, ShmError,
    internal::{Grant, Location, ReaderInfo, Terms, holds, nanoseconds},
};

use super::{
    events::{Changes, EndpointEvents},
    rings::WriterRings,
};
use crate::{
    graph::{Endpoint, EndpointKind},
    ids::{Gid, SessionId},
    qos::{Liveliness, Qos},
    session::{
        clock,
        core::{Outgoing, SessionCore},
    },
    wire::session::{EndpointRole, Fence, Granted},
};

/// The writing side of a publisher, client or server, which the session's control thread shares with
/// the handle.
pub(in crate::session) struct PublisherInner {
    pub(in crate::session) endpoint: Endpoint,
    pub(in crate::session) role: EndpointRole,
    pub(in crate::session) rings: WriterRings,
    pub(in crate::session) events: EndpointEvents,
    /// True if a publication asserts the liveliness, and otherwise only the application does.
    pub(in crate::session) asserts: bool,
    /// True if the samples come from a process of this host that shares no memory.
    pub(in crate::session) relayed: bool,
    /// Readers that have a grant; a relay is listed under its own GID.
    attached: Mutex<BTreeSet<Gid>>,
    sending: Mutex<Sending>,
}

/// Progress of sending readers the memory that they need to find a publisher's samples, by the session's count of
/// [handovers](crate::session::core::MemoryChanges::handovers).
#[derive(Default)]
struct Sending {
    /// The fence that the daemon has not answered yet.
    asked: Option<PendingFence>,
    /// The count of handovers in the daemon's last answer.
    sent: Option<u64>,
    /// The number of the last sample that readers can find with the memory sent until then.
    number: u64,
}

/// A fence that was sent to the daemon.
#[derive(Clone, Copy)]
struct PendingFence {
    /// The connection to a daemon that carried the fence: another connection does not answer it.
    connection: u64,
    handovers: u64,
    /// The last sample that had been handed over when the fence was sent.
    number: u64,
}

impl PublisherInner {
    pub(in crate::session) fn new(
        endpoint: Endpoint,
        role: EndpointRole,
        rings: WriterRings,
    ) -> Self {
        let Qos { liveliness, lease, .. } = endpoint.qos;
        let asserts = liveliness == Liveliness::ManualByTopic && lease.is_some();
        let events = EndpointEvents::of_publisher(&endpoint.qos, clock::monotonic());
        let (relayed, attached, sending) = (false, Mutex::default(), Mutex::default());
        Self { endpoint, role, rings, events, asserts, relayed, attached, sending }
    }

    /// Liveliness is asserted explicitly: the publisher runs in another process.
    pub(in crate::session) fn asserted(mut self) -> Self {
        self.asserts = self.endpoint.qos.lease.is_some();
        self.relayed = self.role == EndpointRole::Application;
        self
    }

    /// Attaches a reader on its terms. Returns the grant, the number in front of the granted samples, and the location
    /// of the ring.
    pub(in crate::session) fn attach(
        &self,
        reader: ReaderInfo,
        terms: Terms,
    ) -> Result<(Grant, u64, Location), ShmError> {
        let gid = reader.gid;
        let granted = self.rings.attach(reader, terms)?;
        self.attached().insert(gid);
        Ok(granted)
    }

    /// Returns whether it has samples for a reader that has not taken up its grant and must not lose one: a daemon that
    /// was killed may not have passed the grant on.
    pub(in crate::session) fn expects_readers(&self) -> bool {
        let WriterRings::Shared(writer) = &self.rings else { return false };
        self.endpoint.kind == EndpointKind::Publisher
            && self.role == EndpointRole::Application
            && holds(&self.endpoint.qos)
            && writer.expects_readers()
    }

    /// Returns the readers of other sessions that have not taken up their grant, and the number of samples for each.
    pub(in crate::session) fn unmet(&self) -> Vec<(Gid, u64)> {
        let WriterRings::Shared(writer) = &self.rings else { return Vec::new() };
        let counted =
            self.endpoint.kind == EndpointKind::Publisher && self.role == EndpointRole::Application;
        if counted { writer.unmet() } else { Vec::new() }
    }

    /// Returns the grants for readers of other sessions that have not taken them up, to send them once more.
    pub(in crate::session) fn untaken_grants(&self, session: SessionId) -> Vec<Granted> {
        let counted = self.endpoint.kind == EndpointKind::Publisher
            && self.role == EndpointRole::Application
            && !self.relayed;
        let Some(writer) = self.rings.shared().filter(|_| counted) else { return Vec::new() };
        let ring = writer.location();
        let granted = |(reader, Grant { generation, first }, after)| Granted {
            reader,
            writer: self.endpoint.gid,
            generation,
            first,
            session,
            ring,
            segments: Vec::new(),
            after: Some(after),
            relayed: None,
        };
        writer.untaken_grants().into_iter().map(granted).collect()
    }

    /// Detaches a reader. Returns whether it was attached.
    pub(in crate::session) fn detach(&self, reader: Gid) -> bool {
        self.attached().remove(&reader);
        self.rings.detach(reader)
    }

    /// Detaches the readers whose process is dead. Returns whether there were any.
    pub(in crate::session) fn drop_dead(&self) -> bool {
        let dead = self.rings.drop_dead();
        let mut attached = self.attached();
        dead.iter().for_each(|gid| {
            attached.remove(gid);
        });
        !dead.is_empty()
    }

    /// Returns the number up to which the samples survive the end of this process. The carriers to other processes and
    /// hosts have these samples. All other readers can read them, since they have received the samples' memory. A
    /// thread that waits for this sleeps on the session's segment, which wakes it.
    pub(in crate::session) fn delivered_up_to(&self, core: &SessionCore) -> u64 {
        let WriterRings::Shared(writer) = &self.rings else { return 0 };
        let (began, number) = (core.memory.connections(), writer.delivered_up_to());
        // Read after the number of the sample: the count then covers the memory that the readers of those samples need.
        let handovers = core.memory.handovers();
        let mut sending = self.sending();
        if sending.sent == Some(handovers) {
            sending.number = sending.number.max(number);
        } else if sending.asked.is_none_or(|asked| asked.connection != began) {
            // One fence at a time: even where there is always more to be sent, each fence is answered.
            sending.asked = Some(PendingFence { connection: began, handovers, number });
            let fence = Fence { writer: self.endpoint.gid, number: handovers };
            core.tell(Outgoing::Fence(fence));
        }
        number.min(sending.number)
    }

    /// Records the daemon's answer: readers were sent the memory that they needed when the session's count was
    /// `handovers`.
    pub(in crate::session) fn was_sent(&self, handovers: u64) {
        let mut sending = self.sending();
        if let Some(asked) = sending.asked.take_if(|asked| asked.handovers == handovers) {
            sending.sent = Some(handovers);
            sending.number = sending.number.max(asked.number);
        }
    }

    fn sending(&self) -> MutexGuard<'_, Sending> {
        self.sending.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns the readers that have a grant.
    pub(in crate::session) fn granted(&self) -> Vec<Gid> {
        self.attached().iter().copied().collect()
    }

    fn attached(&self) -> MutexGuard<'_, BTreeSet<Gid>> {
        self.attached.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Updates the matched readers. Returns the changes since the last call.
    pub(in crate::session) fn rematch(&self) -> Changes {
        self.events.readers(|| self.rings.readers())
    }

    /// Counts the missed deadlines, and asserts or watches the lease. Returns when to look again, and whether an event
    /// occurred.
    pub(in crate::session) fn look_at_time(&self, now: u64) -> (Option<u64>, bool) {
        let qos = &self.endpoint.qos;
        let WriterRings::Shared(writer) = &self.rings else { return (None, false) };
        let times = writer.times();
        let (due, news) = self.events.offered(qos, &times, now);
        let Some(lease) = qos.lease.filter(|_| !self.asserts) else {
            return (due, news);
        };
        let third = nanoseconds(lease / 3).max(1_000_000);
        let mut next = times.asserted.map_or(now, |asserted| asserted.saturating_add(third));
        if next <= now {
            writer.assert(now);
            next = now.saturating_add(third);
        }
        (Some(due.map_or(next, |due| due.min(next))), news)
    }

    /// Records a publication, if a deadline or the liveliness depends on it.
    pub(in crate::session) fn published<T>(
        &self,
        result: Result<T, PublishError>,
    ) -> Result<T, PublishError> {
        let deadline = self.endpoint.qos.deadline.is_some();
        if result.is_ok()
            && (deadline || self.asserts)
            && let WriterRings::Shared(writer) = &self.rings
        {
            let now = clock::monotonic();
            if deadline {
                writer.note_sample(now);
            }
            if self.asserts {
                writer.assert(now);
            }
        }
        result
    }
}
