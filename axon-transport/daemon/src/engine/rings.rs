//! The rings of this host, as the engine uses them: relay readers of local publishers, and stand-ins that write for
//! remote ones. In the daemon they are shared memory; the simulator has models of them.

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
    /// Opens a relay: a subscription that reads for subscriptions of a peer, which it `stands_for`.
    ///
    /// # Errors
    /// Why there is none, for the log.
    fn open_reader(
        &self,
        spec: EndpointSpec,
        stands_for: Vec<Gid>,
    ) -> Result<Rc<dyn RingReader>, String>;

    /// Opens a stand-in for a remote publisher, client or server, under its GID. What it holds it takes of `held`.
    ///
    /// # Errors
    /// Why there is none, for the log.
    fn open_writer(
        &self,
        remote: &Endpoint,
        held: &Arc<MemoryBudget>,
    ) -> Result<Rc<dyn RingWriter>, String>;

    /// Adds to `found` the readers that may have samples to take, each with the publisher: those whose rings got samples
    /// since the last call, and a few others. So the cost of a sample does not grow with the number of readers.
    fn take_active(&self, found: &mut Vec<(Gid, Gid)>);

    /// Says whether the engine waits for room in a ring: while it does, a reader that makes room wakes it.
    fn set_waiting_for_room(&self, waiting: bool);
}

/// A relay subscription: it reads the rings of all local publishers of a topic.
pub(crate) trait RingReader {
    /// The relay's own GID.
    fn gid(&self) -> Gid;
    /// The publishers that have samples to take.
    fn with_data(&self) -> Vec<Gid>;
    /// Whether this publisher has samples to take.
    fn has_data_of(&self, publisher: &Gid) -> bool;
    /// Whether it reads this publisher.
    fn reads(&self, publisher: &Gid) -> bool;
    /// The publishers that it reads.
    fn matched(&self) -> Vec<Gid>;
    /// Takes the next samples of a publisher, as many as `most` says. Returns how many.
    fn take_many(
        &self,
        publisher: &Gid,
        most: TakeLimit,
        each: &mut dyn FnMut(MessageInfo, Bytes),
    ) -> usize;
    /// After what time [`take_many`](Self::take_many) may have a sample, where it had none although some wait: it passes
    /// over a number that do not count, such as expired ones, and then lets others have their turn; or there was no
    /// memory for a sample.
    fn retry_of(&self, publisher: &Gid) -> Option<Duration>;
    /// Whether samples of this publisher wait that cannot be taken yet, for want of memory: of the publisher's that has
    /// not come, or of this process.
    fn is_held_up(&self, _publisher: &Gid) -> bool {
        false
    }
    /// Passes over all samples of this publisher but the newest `depth`.
    fn skip_of(&self, publisher: &Gid, depth: u64);
    /// How many samples of this publisher newer ones replaced before they were taken, or were passed over.
    fn lost_of(&self, _publisher: &Gid) -> u64 {
        0
    }
    /// The peer has the samples of this publisher up to this number, or will never have them.
    fn acknowledge_of(&self, publisher: &Gid, sequence: u64);
    /// Has what was taken and not acknowledged taken once more.
    fn take_back(&self);
    /// How many samples of each publisher are not acknowledged.
    fn unacknowledged(&self) -> HashMap<Gid, u64>;
    /// Bytes of its ring that the samples of this publisher take that are not acknowledged.
    fn unacknowledged_bytes_of(&self, publisher: &Gid) -> u64;
    /// How many publishes of this publisher found no room since readers had not taken, or acknowledged, its oldest
    /// sample, if this reader is one of these now.
    fn refused_of(&self, publisher: &Gid) -> Option<u64>;
    /// So many samples of this publisher will never reach the peer.
    fn give_up(&self, publisher: Gid, samples: u64);
    /// How often each publisher asserted its liveliness.
    fn assertions(&self) -> Vec<(Gid, u64)>;
    /// The peer's subscriptions that it reads for from now on.
    fn set_stands_for(&self, gids: Vec<Gid>);
}

/// Why a sample was not written to a ring.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum RingError {
    /// A KEEP_ALL reader has no room: try again when a reader made some.
    Full,
    /// The stand-ins of the peer's identity hold as much as they may; the text says how much. Nothing says that others will
    /// give any of it back.
    Short(String),
    /// The sample is lost; the text says why.
    Lost(String),
}

/// A stand-in for a remote publisher, client or server. That of a client or server also reads: the responses or the
/// requests that go to it.
pub(crate) trait RingWriter {
    /// The remote endpoint.
    fn endpoint(&self) -> &Endpoint;
    /// The local endpoints that it reaches.
    fn partners(&self) -> Vec<Gid>;
    /// Writes a sample; `client` is the client that a response answers. A subscription that sleeps may sleep on until
    /// [`announce`](Self::announce).
    ///
    /// # Errors
    /// The ring is full, or the sample is lost.
    fn try_write(&self, client: &Gid, meta: Meta, payload: &[u8]) -> Result<Written, RingError>;
    /// Wakes the subscriptions that sleep, for all samples that were written.
    fn announce(&self);
    /// The remote publisher asserted its liveliness.
    fn assert_alive(&self);
    /// The clients whose calls, or responses, wait to be taken.
    fn with_calls(&self) -> Vec<Gid>;
    /// Whether it reads the calls, or responses, of this client.
    fn reads_calls_of(&self, client: &Gid) -> bool;
    /// Takes the next call, or response, of this client.
    fn take_call_of(&self, client: &Gid) -> Option<(MessageInfo, Vec<u8>)>;
    /// How many calls, or responses, of this client wait to be taken.
    fn calls_of(&self, _client: &Gid) -> u64 {
        0
    }
    /// How many calls, or responses, of this client found no room, if those that wait here are why the next one may not.
    fn refused_of(&self, _client: &Gid) -> Option<u64> {
        None
    }
}

/// A sample on its way to a peer.
#[derive(Clone, Debug)]
pub(crate) struct RingSample {
    /// Its publisher, number and times.
    pub(crate) info: MessageInfo,
    /// The call that it is the request of, or answers.
    pub(crate) call: Option<RequestId>,
    /// The bytes that are sent: the serialized message, or the frame that it was compressed to.
    pub(crate) payload: Bytes,
    /// Whether it is compressed.
    form: Form,
    /// When the engine took it from its ring.
    pub(crate) taken: Duration,
}

/// Whether a sample is compressed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Form {
    /// Nobody asked.
    Undecided,
    /// The answer to the order with this number will tell.
    Asked(u64),
    /// It is sent as it is.
    Plain,
    /// Into one zstd frame, of so many bytes.
    Zstd {
        /// Bytes of the serialized message.
        from: usize,
    },
}

impl RingSample {
    /// A sample of a topic.
    pub(crate) fn new(info: MessageInfo, payload: Bytes, now: Duration) -> Self {
        Self { info, call: None, payload, form: Form::Undecided, taken: now }
    }

    /// Time since it was published, as far as this host knows.
    pub(crate) fn age(&self, now: Duration) -> Duration {
        let before = self.info.lifetime.map_or(Duration::ZERO, |lifetime| lifetime.age);
        before.saturating_add(now.saturating_sub(self.taken))
    }

    /// What is left of its lifespan; `None` if that is infinite.
    pub(crate) fn lifespan_left(&self, now: Duration) -> Option<Duration> {
        Some(self.info.lifetime?.lifespan.saturating_sub(self.age(now)))
    }

    /// Bytes of the serialized message.
    pub(crate) fn length(&self) -> usize {
        match self.form {
            Form::Zstd { from } => from,
            _ => self.payload.len(),
        }
    }

    /// The memory that a queue counts for it, in bytes, whether or not it is compressed: the peer needs as much for it.
    pub(crate) fn size(&self) -> usize {
        self.length() + size_of::<Self>()
    }

    /// Whether nobody asked yet whether it becomes shorter.
    pub(crate) fn is_undecided(&self) -> bool {
        self.form == Form::Undecided
    }

    /// Whether it is being compressed.
    pub(crate) fn is_asked(&self) -> bool {
        matches!(self.form, Form::Asked(_))
    }

    /// Whether the order with this number is about it.
    pub(crate) fn is_asked_by(&self, order: u64) -> bool {
        self.form == Form::Asked(order)
    }

    /// Whether it is compressed.
    pub(crate) fn is_compressed(&self) -> bool {
        matches!(self.form, Form::Zstd { .. })
    }

    /// The order with this number will tell whether it becomes shorter.
    pub(crate) fn set_asked(&mut self, order: u64) {
        self.form = Form::Asked(order);
    }

    /// It is sent as this frame, or as it is.
    pub(crate) fn set_compressed(&mut self, frame: Option<Bytes>) {
        self.form = match frame {
            Some(frame) => Form::Zstd { from: std::mem::replace(&mut self.payload, frame).len() },
            None => Form::Plain,
        };
    }
}
