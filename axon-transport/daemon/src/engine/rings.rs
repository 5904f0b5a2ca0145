//! The rings of this host as the engine uses them: relay readers of local publishers, and stand-ins that
//! write for remote ones. The daemon's rings are in shared memory; the simulator has models of them.

use std::{collections::HashMap, rc::Rc, sync::Arc, time::Duration};

use axon_envelope::inner::RequestId;
use axon_shm::{Meta, ids::Gid, internal::MemoryBudget};
use axon_transport::{
    EndpointSpec, MessageInfo,
    graph::Endpoint,
    internal::session::{TakeLimit, Written},
};
use bytes::Bytes;

/// Opens readers and writers.
pub(crate) trait Rings {
    /// Opens a relay: a subscription that reads on behalf of a peer's subscriptions, `stands_for`.
    ///
    /// # Errors
    /// The reason for the failure, for the log.
    fn open_reader(
        &self,
        spec: EndpointSpec,
        stands_for: Vec<Gid>,
    ) -> Result<Rc<dyn RingReader>, String>;

    /// Opens a stand-in for a remote publisher, client or server, under its GID. The stand-in's memory is
    /// charged to `held`.
    ///
    /// # Errors
    /// The reason for the failure, for the log.
    fn open_writer(
        &self,
        remote: &Endpoint,
        held: &Arc<MemoryBudget>,
    ) -> Result<Rc<dyn RingWriter>, String>;

    /// Adds to `found` the readers that may have samples to take, each with the publisher. These are the
    /// readers whose rings got samples since the last call, and a few more. So the cost of a sample does not
    /// grow with the number of readers.
    fn take_active(&self, found: &mut Vec<(Gid, Gid)>);

    /// Sets whether the engine waits for room in a ring. While it waits, a reader that makes room wakes it.
    fn set_waiting_for_room(&self, waiting: bool);
}

/// A relay subscription: it reads the rings of all local publishers of a topic.
pub(crate) trait RingReader {
    /// Returns the relay's own GID.
    fn gid(&self) -> Gid;
    /// Returns the publishers that have samples to take.
    fn with_data(&self) -> Vec<Gid>;
    /// Returns whether this publisher has samples to take.
    fn has_data_of(&self, publisher: &Gid) -> bool;
    /// Returns whether the relay reads this publisher.
    fn reads(&self, publisher: &Gid) -> bool;
    /// Returns the publishers that the relay reads.
    fn matched(&self) -> Vec<Gid>;
    /// Takes the next samples of a publisher, up to `most`. Returns their number.
    fn take_many(
        &self,
        publisher: &Gid,
        most: TakeLimit,
        each: &mut dyn FnMut(MessageInfo, Bytes),
    ) -> usize;
    /// Returns when to call [`take_many`](Self::take_many) again if it returned no sample although some wait.
    /// It skips a number of samples that do not count, such as expired ones, and then lets others have their
    /// turn. It also returns none if there was no memory for a sample.
    fn retry_of(&self, publisher: &Gid) -> Option<Duration>;
    /// Returns whether waiting samples of this publisher cannot be taken yet, because memory is missing: the
    /// publisher's memory has not arrived, or this process is short of it.
    fn is_held_up(&self, _publisher: &Gid) -> bool {
        false
    }
    /// Skips all samples of this publisher but the newest `depth`.
    fn skip_of(&self, publisher: &Gid, depth: u64);
    /// Returns how many samples of this publisher were replaced by newer ones before they were taken, or
    /// skipped.
    fn lost_of(&self, _publisher: &Gid) -> u64 {
        0
    }
    /// Acknowledges the samples of this publisher up to this number: the peer has them or will never have
    /// them.
    fn acknowledge_of(&self, publisher: &Gid, sequence: u64);
    /// Makes the taken samples that are not acknowledged available to be taken again.
    fn take_back(&self);
    /// Returns the number of unacknowledged samples of each publisher.
    fn unacknowledged(&self) -> HashMap<Gid, u64>;
    /// Returns the bytes that the unacknowledged samples of this publisher take in its ring.
    fn unacknowledged_bytes_of(&self, publisher: &Gid) -> u64;
    /// Returns how many publishes of this publisher found no room because readers had not taken, or
    /// acknowledged, its oldest sample. Returns `None` unless this reader is one of them now.
    fn refused_of(&self, publisher: &Gid) -> Option<u64>;
    /// Reports that so many samples of this publisher will never reach the peer.
    fn give_up(&self, publisher: Gid, samples: u64);
    /// Returns how often each publisher asserted its liveliness.
    fn assertions(&self) -> Vec<(Gid, u64)>;
    /// Replaces the peer's subscriptions that the relay reads for.
    fn set_stands_for(&self, gids: Vec<Gid>);
}

/// Why a sample was not written to a ring.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum RingError {
    /// A KEEP_ALL reader has no room. Try again when a reader has made some.
    Full,
    /// The stand-ins of the peer's identity have used up their memory; the text states the amount. There is
    /// no signal when others release some.
    Short(String),
    /// The sample is lost; the text gives the reason.
    Lost(String),
}

/// A stand-in for a remote publisher, client or server. The stand-in of a client or server also reads the
/// responses or requests for its endpoint.
pub(crate) trait RingWriter {
    /// Returns the remote endpoint.
    fn endpoint(&self) -> &Endpoint;
    /// Returns the local endpoints that the stand-in reaches.
    fn partners(&self) -> Vec<Gid>;
    /// Writes a sample; `client` is the client that a response answers. A sleeping subscription may stay
    /// asleep until [`announce`](Self::announce).
    ///
    /// # Errors
    /// The ring is full, or the sample is lost.
    fn try_write(&self, client: &Gid, meta: Meta, payload: &[u8]) -> Result<Written, RingError>;
    /// Wakes the sleeping subscriptions once for all written samples.
    fn announce(&self);
    /// Records that the remote publisher asserted its liveliness.
    fn assert_alive(&self);
    /// Returns the clients whose calls, or responses, wait to be taken.
    fn with_calls(&self) -> Vec<Gid>;
    /// Returns whether the stand-in reads the calls, or responses, of this client.
    fn reads_calls_of(&self, client: &Gid) -> bool;
    /// Takes the next call, or response, of this client.
    fn take_call_of(&self, client: &Gid) -> Option<(MessageInfo, Vec<u8>)>;
    /// Returns how many calls, or responses, of this client wait to be taken.
    fn calls_of(&self, _client: &Gid) -> u64 {
        0
    }
    /// Returns how many calls, or responses, of this client found no room, if the waiting ones may block the
    /// next one.
    fn refused_of(&self, _client: &Gid) -> Option<u64> {
        None
    }
}

/// A sample that is being sent to a peer.
#[derive(Clone, Debug)]
pub(crate) struct RingSample {
    /// The sample's publisher, number and times.
    pub(crate) info: MessageInfo,
    /// The call, if the sample is its request or response.
    pub(crate) call: Option<RequestId>,
    /// The bytes to send: the serialized message, or its compressed frame.
    pub(crate) payload: Bytes,
    /// The form of the sample, which includes the state of its compression.
    form: Form,
    /// When the engine took the sample from its ring.
    pub(crate) taken: Duration,
}

/// The form of a sample: the state of its compression.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Form {
    /// Compression was not requested yet.
    Undecided,
    /// The compression order with this number decides.
    Asked(u64),
    /// The sample is sent uncompressed.
    Plain,
    /// The sample is compressed into one zstd frame.
    Zstd {
        /// Bytes of the serialized message.
        from: usize,
    },
}

impl RingSample {
    /// Creates a sample of a topic.
    pub(crate) fn new(info: MessageInfo, payload: Bytes, now: Duration) -> Self {
        Self { info, call: None, payload, form: Form::Undecided, taken: now }
    }

    /// Returns the time since the sample was published, as far as this host knows.
    pub(crate) fn age(&self, now: Duration) -> Duration {
        let before = self.info.lifetime.map_or(Duration::ZERO, |lifetime| lifetime.age);
        before.saturating_add(now.saturating_sub(self.taken))
    }

    /// Returns the rest of the sample's lifespan; `None` if that is infinite.
    pub(crate) fn lifespan_left(&self, now: Duration) -> Option<Duration> {
        Some(self.info.lifetime?.lifespan.saturating_sub(self.age(now)))
    }

    /// Returns the length of the serialized message in bytes.
    pub(crate) fn length(&self) -> usize {
        match self.form {
            Form::Zstd { from } => from,
            _ => self.payload.len(),
        }
    }

    /// Returns the memory in bytes that a queue counts for the sample. Compression does not reduce it,
    /// because the peer needs the full amount.
    pub(crate) fn size(&self) -> usize {
        self.length() + size_of::<Self>()
    }

    /// Returns whether compression was not requested yet.
    pub(crate) fn is_undecided(&self) -> bool {
        self.form == Form::Undecided
    }

    /// Returns whether the sample is being compressed.
    pub(crate) fn is_asked(&self) -> bool {
        matches!(self.form, Form::Asked(_))
    }

    /// Returns whether the compression order with this number is for this sample.
    pub(crate) fn is_asked_by(&self, order: u64) -> bool {
        self.form == Form::Asked(order)
    }

    /// Returns whether the sample is compressed.
    pub(crate) fn is_compressed(&self) -> bool {
        matches!(self.form, Form::Zstd { .. })
    }

    /// Records the number of the compression order that decides.
    pub(crate) fn set_asked(&mut self, order: u64) {
        self.form = Form::Asked(order);
    }

    /// Sets the compressed frame; with `None` the sample is sent uncompressed.
    pub(crate) fn set_compressed(&mut self, frame: Option<Bytes>) {
        self.form = match frame {
            Some(frame) => Form::Zstd { from: std::mem::replace(&mut self.payload, frame).len() },
            None => Form::Plain,
        };
    }
}
