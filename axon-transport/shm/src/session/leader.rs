//! Lets an event loop wait for a session's doorbell, in place of a blocked thread.

use std::{
    os::fd::{AsFd, AsRawFd, BorrowedFd, RawFd},
    sync::Arc,
};

use crate::{session::segment::SessionSegment, wake::PURPOSES};

/// Leads a session's waits from an event loop instead of a blocked thread.
///
/// Each round: [`clear`](Self::clear), [`arm`](Self::arm), look for work. If there is some, [`disarm`](Self::disarm)
/// and do it; otherwise wait until the descriptor is readable. `clear` wakes the threads that wait meanwhile. In a
/// forked child it does nothing.
///
/// ```
/// use std::{os::unix::net::UnixDatagram, thread};
///
/// use axon_shm::{
///     Context, ExternalLeader, Publisher, PublisherOptions, Sample, Subscriber, SubscriberOptions,
///     qos::Qos,
/// };
/// use tokio::io::unix::AsyncFd;
///
/// /// The next sample, whenever it comes.
/// async fn next(
///     event: &AsyncFd<ExternalLeader>,
///     subscriber: &mut Subscriber,
/// ) -> Result<Sample, Box<dyn std::error::Error>> {
///     loop {
///         event.get_ref().clear();
///         event.get_ref().arm(false);
///         // After the arming: what comes later than this look makes the descriptor readable.
///         if let Some(sample) = subscriber.take()? {
///             event.get_ref().disarm();
///             return Ok(sample);
///         }
///         event.readable().await?.clear_ready();
///     }
/// }
///
/// # fn main() -> Result<(), Box<dyn std::error::Error>> {
/// # let (ours, theirs) = UnixDatagram::pair()?;
/// # let publisher = Publisher::new(&Context::new()?, PublisherOptions::new(Qos::default()))?;
/// # let context = Context::new()?;
/// # let mut subscriber = thread::scope(|scope| {
/// #     scope.spawn(|| publisher.serve(&ours, None));
/// #     Subscriber::connect(&context, &theirs, SubscriberOptions::new(Qos::default()), None)
/// # })?;
/// let runtime = tokio::runtime::Builder::new_current_thread().enable_io().build()?;
/// runtime.block_on(async {
///     // SAFETY: the leader keeps its descriptor, and `AsyncFd` is dropped before it is closed.
///     let event = unsafe { AsyncFd::register(context.event()?) }?;
///     let talker = thread::spawn(move || publisher.publish(b"hello"));
///     let mut text = Vec::new();
///     next(&event, &mut subscriber).await?.copy_to(&mut text)?;
///     assert_eq!(text, b"hello");
/// #   talker.join().unwrap()?;
///     Ok(())
/// })
/// # }
/// ```
///
/// The descriptor is an epoll instance, which any event loop accepts, edge- or level-triggered. The descriptor of a
/// [`Context`](crate::Context), which has no thread to watch other processes, also becomes readable once a second, so
/// that samples of a process that died before it rang are found.
pub struct ExternalLeader {
    session: Arc<SessionSegment>,
}

impl ExternalLeader {
    /// Returns `None` if the session has an external leader already.
    pub(crate) fn new(session: Arc<SessionSegment>) -> Option<Self> {
        // Created only after success: dropping one would end the other leader's lead.
        session.doorbell_hub().lead_from_outside().then(|| Self { session })
    }

    /// Takes the pending rings, and makes the session's other waiters look again.
    pub fn clear(&self) {
        if !self.session.is_forked() {
            self.session.doorbell_hub().take_from_outside(self.session.armed_words());
        }
    }

    /// Arms a new ticket: any later sample rings the doorbell. With `room`, so does space for a publish that returned
    /// [`PublishError::Blocked`](crate::PublishError::Blocked).
    pub fn arm(&self, room: bool) {
        if !self.session.is_forked() {
            let purposes = if room { &PURPOSES[..] } else { &PURPOSES[..1] };
            self.session.doorbell_hub().arm_from_outside(self.session.armed_words(), purposes);
        }
    }

    /// Ends the round without a sleep.
    pub fn disarm(&self) {
        if !self.session.is_forked() {
            self.session.doorbell_hub().disarm_from_outside(self.session.armed_words());
        }
    }
}

impl AsFd for ExternalLeader {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.session.doorbell()
    }
}

impl AsRawFd for ExternalLeader {
    fn as_raw_fd(&self) -> RawFd {
        self.as_fd().as_raw_fd()
    }
}

impl Drop for ExternalLeader {
    fn drop(&mut self) {
        if !self.session.is_forked() {
            self.disarm();
            self.session.doorbell_hub().leave_from_outside();
        }
    }
}
