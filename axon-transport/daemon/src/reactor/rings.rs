//! The rings of this host as shared memory: relay subscriptions and stand-ins of the gateway's session.

use std::{
    cell::{Cell, RefCell},
    collections::HashMap,
    ops::Range,
    rc::Rc,
    sync::Arc,
    time::Duration,
};

use axon_shm::{ExternalLeader, Meta, PublishError, ShmError, ids::Gid, internal::MemoryBudget};
use axon_transport::{
    EndpointSpec, MessageInfo, Session, Subscription,
    graph::Endpoint,
    internal::session::{RemoteWriter, TakeLimit, Written},
};
use bytes::Bytes;

use crate::engine::rings::{RingError, RingReader, RingWriter, Rings};

/// The rings, and the doorbell that rings for samples and for room in them.
pub(super) struct ShmRings {
    session: Session,
    doorbell: ExternalLeader,
    /// Whether the engine waits for room in a ring.
    waits_for_room: Cell<bool>,
    /// Whether the doorbell is armed for room, too.
    armed_for_room: Cell<bool>,
}

impl ShmRings {
    /// Opens the rings of `session`.
    ///
    /// # Errors
    /// The session's doorbell is taken.
    pub(super) fn new(session: Session) -> Result<Rc<Self>, ShmError> {
        // This precedes the first reader: the engine then looks only at readers that have a sample to take.
        session.segment().follow();
        Ok(Rc::new(Self {
            doorbell: session.segment().external_leader()?,
            session,
            waits_for_room: Cell::new(false),
            armed_for_room: Cell::new(false),
        }))
    }

    /// Returns the doorbell. It is readable once after each [`arm`](Self::arm).
    pub(super) fn doorbell(&self) -> &ExternalLeader {
        &self.doorbell
    }

    /// Arms the doorbell. A look at the rings finds samples that came before; samples that come after ring it.
    pub(super) fn arm(&self) {
        let room = self.waits_for_room.get();
        self.doorbell.clear();
        self.doorbell.arm(room);
        self.armed_for_room.set(room);
    }

    /// Returns whether the engine began to wait for room after the doorbell was armed: it has to be armed again.
    pub(super) fn is_armed_too_little(&self) -> bool {
        self.waits_for_room.get() && !self.armed_for_room.get()
    }
}

impl Rings for ShmRings {
    fn open_reader(
        &self,
        spec: EndpointSpec,
        stands_for: Vec<Gid>,
    ) -> Result<Rc<dyn RingReader>, String> {
        let subscription = self.session.create_relay(spec, stands_for);
        let subscription = subscription.map_err(|error| error.to_string())?;
        Ok(Rc::new(RelayReader { subscription, taken: RefCell::default() }))
    }

    fn open_writer(
        &self,
        remote: &Endpoint,
        held: &Arc<MemoryBudget>,
    ) -> Result<Rc<dyn RingWriter>, String> {
        let writer = RemoteWriter::stand_in(&self.session, remote.clone(), held);
        Ok(Rc::new(StandInWriter(writer.map_err(|error| error.to_string())?)))
    }

    fn take_active(&self, found: &mut Vec<(Gid, Gid)>) {
        self.session.segment().take_active(found);
    }

    fn set_waiting_for_room(&self, waiting: bool) {
        // The loop arms the doorbell again before it sleeps.
        self.waits_for_room.set(waiting);
    }
}

/// A relay subscription.
struct RelayReader {
    subscription: Subscription,
    /// The samples of one take, and where their payloads are.
    taken: RefCell<Vec<(MessageInfo, Range<usize>)>>,
}

impl RingReader for RelayReader {
    fn gid(&self) -> Gid {
        self.subscription.gid()
    }

    fn with_data(&self) -> Vec<Gid> {
        self.subscription.with_data()
    }

    fn has_data_of(&self, publisher: &Gid) -> bool {
        self.subscription.has_from(publisher)
    }

    fn reads(&self, publisher: &Gid) -> bool {
        self.subscription.reads(publisher)
    }

    fn matched(&self) -> Vec<Gid> {
        self.subscription.matched()
    }

    fn take_many(
        &self,
        publisher: &Gid,
        most: TakeLimit,
        each: &mut dyn FnMut(MessageInfo, Bytes),
    ) -> usize {
        let (mut taken, mut payloads) = (self.taken.borrow_mut(), Vec::new());
        self.subscription.take_many_of(publisher, most, &mut payloads, |info, payload| {
            taken.push((info, payload));
        });
        if payloads.len() < payloads.capacity() / 2 {
            // Fewer came than were waiting.
            payloads.shrink_to_fit();
        }
        let (samples, payloads) = (taken.len(), Bytes::from(payloads));
        if let [(info, _)] = taken[..] {
            // The sample shares its memory with no other.
            each(info, payloads);
        } else {
            taken.iter().for_each(|(info, at)| each(*info, payloads.slice(at.clone())));
        }
        taken.clear();
        samples
    }

    fn skip_of(&self, publisher: &Gid, depth: u64) {
        self.subscription.skip_of(publisher, depth);
    }

    fn retry_of(&self, publisher: &Gid) -> Option<Duration> {
        self.subscription.retry_of(publisher)
    }

    fn is_held_up(&self, publisher: &Gid) -> bool {
        self.subscription.is_held_up(publisher)
    }

    fn lost_of(&self, publisher: &Gid) -> u64 {
        self.subscription.lost_of(publisher)
    }

    fn acknowledge_of(&self, publisher: &Gid, sequence: u64) {
        self.subscription.acknowledge_of(publisher, sequence);
    }

    fn take_back(&self) {
        self.subscription.take_back();
    }

    fn unacknowledged(&self) -> HashMap<Gid, u64> {
        self.subscription.unacknowledged()
    }

    fn unacknowledged_bytes_of(&self, publisher: &Gid) -> u64 {
        self.subscription.unacknowledged_bytes_of(publisher)
    }

    fn refused_of(&self, publisher: &Gid) -> Option<u64> {
        self.subscription.refused_of(publisher)
    }

    fn give_up(&self, publisher: Gid, samples: u64) {
        self.subscription.give_up(publisher, samples);
    }

    fn assertions(&self) -> Vec<(Gid, u64)> {
        self.subscription.assertions()
    }

    fn set_stands_for(&self, gids: Vec<Gid>) {
        self.subscription.set_stands_for(gids);
    }
}

/// A stand-in.
struct StandInWriter(RemoteWriter);

impl RingWriter for StandInWriter {
    fn endpoint(&self) -> &Endpoint {
        self.0.endpoint()
    }

    fn partners(&self) -> Vec<Gid> {
        self.0.partners()
    }

    fn try_write(&self, client: &Gid, meta: Meta, payload: &[u8]) -> Result<Written, RingError> {
        self.0.try_write_quietly(client, meta, payload).map_err(|error| match error {
            PublishError::Blocked { .. } => RingError::Full,
            // A sample that needs at most half of the memory budget may fit later. A longer one may fit in no state of
            // the other rings. It is lost like one that is too long, so that the engine does not wait for ever.
            error @ PublishError::MemoryBudget { needed, most, .. } if needed <= most / 2 => {
                RingError::Short(error.to_string())
            }
            error => RingError::Lost(error.to_string()),
        })
    }

    fn announce(&self) {
        self.0.announce();
    }

    fn assert_alive(&self) {
        self.0.assert_alive();
    }

    fn with_calls(&self) -> Vec<Gid> {
        match &self.0 {
            RemoteWriter::Publisher(_) => Vec::new(),
            RemoteWriter::Client(client) => {
                client.has_response().then(|| client.gid()).into_iter().collect()
            }
            RemoteWriter::Server(server) => server.with_requests(),
        }
    }

    fn reads_calls_of(&self, client: &Gid) -> bool {
        match &self.0 {
            RemoteWriter::Publisher(_) => false,
            RemoteWriter::Client(own) => *client == own.gid(),
            RemoteWriter::Server(server) => server.reads(client),
        }
    }

    fn take_call_of(&self, client: &Gid) -> Option<(MessageInfo, Vec<u8>)> {
        match &self.0 {
            RemoteWriter::Publisher(_) => None,
            RemoteWriter::Client(own) if *client == own.gid() => {
                let mut payload = Vec::new();
                let info = own.take_response(&mut payload)?;
                Some((info, payload))
            }
            RemoteWriter::Client(_) => None,
            RemoteWriter::Server(server) => server.take_request_of(client),
        }
    }

    fn calls_of(&self, client: &Gid) -> u64 {
        self.0.unread_of(client)
    }

    fn refused_of(&self, client: &Gid) -> Option<u64> {
        self.0.refused_of(client)
    }
}
