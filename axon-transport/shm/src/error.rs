//! The errors of this crate, each with its cause and the remedy.

use std::{fmt, io};

use rustix::{
    io::Errno,
    process::{Resource, getrlimit},
};

use crate::ids::{Gid, SessionId};

/// A segment could not be made, checked or mapped.
///
/// ```
/// use axon_shm::{Context, Publisher, PublisherOptions, ShmError, qos::Qos};
///
/// let options = PublisherOptions::new(Qos::default()).max_len(u64::MAX);
/// let refused = Publisher::new(&Context::new()?, options);
/// assert!(matches!(refused, Err(ShmError::TooLarge { .. })));
/// # Ok::<(), ShmError>(())
/// ```
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ShmError {
    /// A system call failed.
    #[error("shared memory: {what}: {source}{}", OwnLimit(source))]
    System {
        /// The purpose of the call.
        what: &'static str,
        /// The error that the system returned.
        source: io::Error,
    },
    /// There is not enough memory to back a new segment.
    #[error(
        "shared memory: {needed} bytes needed, {available} available: \
         free memory or raise the memory limit of this process's control group"
    )]
    NoMemory {
        /// Bytes that were needed.
        needed: u64,
        /// Bytes available to this process when it asked.
        available: u64,
    },
    /// Rings that share a memory budget have used it up.
    #[error(
        "shared memory: {needed} bytes needed, {available} left of the {most} that the rings of one peer may take"
    )]
    MemoryBudget {
        /// Bytes that were needed.
        needed: u64,
        /// Bytes that the ring could still have taken.
        available: u64,
        /// The budget in bytes.
        most: u64,
    },
    /// A descriptor from another process is not a valid segment.
    #[error("shared memory of another process refused: {what}")]
    Refused {
        /// The defect.
        what: &'static str,
    },
    /// The memory of other processes has used up its share of this process's address space.
    #[error(
        "shared memory not mapped: that of {whose} takes up to {maps} maps and {bytes} bytes of \
         this process's address space"
    )]
    AddressSpace {
        /// The owner of the limit: one other process, or all of them together.
        whose: &'static str,
        /// The largest number of maps.
        maps: u64,
        /// The largest number of bytes.
        bytes: u64,
    },
    /// The samples would need more address space than a publisher may take.
    #[error(
        "a ring for messages of {max_message} bytes and {budget} bytes of history is too large: \
         messages may take {} bytes and histories {} bytes",
        super::limits::MAX_MESSAGE,
        super::limits::MAX_BUDGET
    )]
    TooLarge {
        /// The largest message that was asked for, in bytes.
        max_message: u64,
        /// The history that was asked for, in bytes.
        budget: u64,
    },
    /// The session already reads the maximum number of rings.
    #[error("session {session} has no free reader lane left (of {lanes}): close subscriptions")]
    NoLane {
        /// The session.
        session: SessionId,
        /// The number of its lanes.
        lanes: u32,
    },
    /// The servers of the session already have the maximum number of clients.
    #[error(
        "the servers of a relayed session may have {0} clients: share memory, or use more processes"
    )]
    TooManyClients(usize),
    /// The session has used all segment numbers.
    #[error("session {0} has opened as many segments as a session may: open another session")]
    NoNumber(SessionId),
    /// A second waiter asked to lead the session's waits.
    #[error("session {0} already has an external leader of its waits")]
    AlreadyLed(SessionId),
    /// The process forked: objects that were created before belong to the parent.
    #[error("used after fork: a child process must open a session of its own")]
    Forked,
}

/// Displays the remedy if the error says that this process has too many open descriptors (EMFILE). Displays nothing for
/// any other error.
#[derive(Debug)]
pub struct OwnLimit<'a>(pub &'a io::Error);

impl fmt::Display for OwnLimit<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.0.raw_os_error() != Some(Errno::MFILE.raw_os_error()) {
            return Ok(());
        }
        let limit = getrlimit(Resource::Nofile).current.unwrap_or_default();
        write!(
            f,
            ": this process has all of its own {limit} file descriptors open; raise its RLIMIT_NOFILE (ulimit -n \
             where it is started, LimitNOFILE= of its systemd unit)"
        )
    }
}

impl ShmError {
    /// Returns a function that makes the error of a failed system call. `what` names the purpose of the call. For this
    /// project's crates.
    #[doc(hidden)]
    pub fn system(what: &'static str) -> impl FnOnce(Errno) -> Self {
        move |errno| Self::System { what, source: errno.into() }
    }
}

/// A sample was not published.
///
/// ```
/// use axon_shm::{Context, PublishError, Publisher, PublisherOptions, qos::Qos};
///
/// let options = PublisherOptions::new(Qos::default()).max_len(4);
/// let publisher = Publisher::new(&Context::new()?, options)?;
/// let refused = publisher.publish(b"hello");
/// assert_eq!(refused, Err(PublishError::TooLarge { len: 5, max: 4 }));
/// # Ok::<(), axon_shm::ShmError>(())
/// ```
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum PublishError {
    /// The sample is larger than the ring's limit.
    #[error("sample of {len} bytes; the largest is {max} (AXON_MAX_MESSAGE_MB)")]
    TooLarge {
        /// The sample's length in bytes.
        len: u64,
        /// The limit in bytes.
        max: u64,
    },
    /// A KEEP_ALL reader left no room during the whole time that a publish waits.
    #[error("reader {reader} takes samples too slowly: KEEP_ALL history is full")]
    Blocked {
        /// The reader that lags.
        reader: Gid,
    },
    /// Memory to hold the sample is not available.
    #[error(
        "no memory for the sample: {needed} bytes more needed, {available} available{}: \
         free memory or raise the memory limit of this process's control group",
        held_by(keeper.as_ref())
    )]
    NoMemory {
        /// Bytes that were needed.
        needed: u64,
        /// Bytes available to this process when it asked.
        available: u64,
        /// A reader whose pinned samples hold enough memory for this one.
        keeper: Option<PinHolder>,
    },
    /// Rings that share a memory budget have used it up.
    #[error(
        "{needed} bytes more needed for the sample, {available} left of the {most} that the rings of one peer may take"
    )]
    MemoryBudget {
        /// Bytes that were needed.
        needed: u64,
        /// Bytes that the ring could still have taken.
        available: u64,
        /// The budget in bytes.
        most: u64,
    },
    /// The system refused a segment for large samples.
    #[error("no segment for the sample: {reason}")]
    Segment {
        /// The refused operation and the reason.
        reason: String,
    },
    /// Loans that were neither published nor dropped hold the ring's memory.
    #[error("{loans} loans hold the ring's memory: publish or drop them first")]
    Loaned {
        /// The number of outstanding loans.
        loans: u32,
    },
    /// Samples that readers have not dropped hold the ring's memory.
    #[error("the ring's memory is full: {keeper}; drop samples in that reader or close it")]
    Pinned {
        /// A reader that pins samples.
        keeper: PinHolder,
    },
    /// The caller's sequence number does not fit the numbers of the samples before.
    #[error("sequence number {sequence} after {last}: so many samples cannot have been lost")]
    Sequence {
        /// The sample's number.
        sequence: u64,
        /// The number of the sample before it.
        last: u64,
    },
    /// A loan was published before all of it was written.
    #[error("loan of {len} bytes published with {written} written")]
    Incomplete {
        /// The loan's length in bytes.
        len: u64,
        /// The number of bytes that were written.
        written: u64,
    },
    /// The process forked: the publisher belongs to the parent.
    #[error("used after fork: a child process must open a session of its own")]
    Forked,
}

/// A reader that pins samples which the publisher has given up.
///
/// ```
/// use axon_shm::PublishError;
///
/// fn report(error: &PublishError) {
///     if let PublishError::Pinned { keeper } = error {
///         println!("process {:?} pins {} samples", keeper.process, keeper.samples);
///     }
/// }
/// # report(&PublishError::Forked);
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct PinHolder {
    /// The reader's GID.
    pub reader: Gid,
    /// The reader's process, if it is known and has not ended.
    pub process: Option<u32>,
    /// Samples that all readers together pin.
    pub samples: usize,
}

impl fmt::Display for PinHolder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { reader, process, samples } = self;
        write!(f, "reader {reader}")?;
        if let Some(process) = process {
            write!(f, " (pid {process})")?;
        }
        write!(f, " holds pinned samples ({samples} pinned by all readers)")
    }
}

fn held_by(keeper: Option<&PinHolder>) -> String {
    keeper.map_or_else(String::new, |keeper| format!("; {keeper}"))
}

/// A ring could not be read.
///
/// ```
/// use axon_shm::{Sample, Subscriber, TakeError};
///
/// fn next(subscriber: &mut Subscriber) -> Option<Sample> {
///     match subscriber.take() {
///         Ok(sample) => sample,
///         Err(TakeError::Forked) => panic!("a child of a fork has no subscribers"),
///         Err(error) => {
///             eprintln!("{error}");
///             None
///         }
///     }
/// }
/// ```
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum TakeError {
    /// The publisher's process broke the protocol: it wrote something that no publisher writes. The ring is not read
    /// again.
    #[error("ring of publisher {writer} is corrupt ({what}); detached from it")]
    Corrupt {
        /// The publisher.
        writer: Gid,
        /// The defect.
        what: &'static str,
    },
    /// A sample is longer than the subscription expects. It was passed over and counts as lost.
    #[error(
        "sample of {len} bytes of publisher {writer} passed over: this process takes up to {max} \
         (AXON_MAX_MESSAGE_MB)"
    )]
    TooLarge {
        /// The publisher.
        writer: Gid,
        /// The sample's length in bytes.
        len: u64,
        /// The limit in bytes.
        max: u64,
    },
    /// The sample does not fit in this process's memory.
    #[error("no memory to take a sample of {len} bytes")]
    NoMemory {
        /// The sample's length in bytes.
        len: u64,
    },
    /// The process forked: the subscription belongs to the parent.
    #[error("used after fork: a child process must open a session of its own")]
    Forked,
}
