//! Futures that wait for messages: for any runtime, and without a thread of their own.
//!
//! The session's control thread listens on the doorbell for them, as it does for callbacks, and wakes the tasks
//! whose endpoint has a message. A task does four things before it sleeps, in this order:
//!
//! 1. It makes the control thread [listen](crate::session::core::Listener).
//! 2. It puts its waker in the endpoint's `Wakers`.
//! 3. It [arms](crate::session::core::Listening::arm) a new ticket of the doorbell.
//! 4. It looks for a message once more.
//!
//! No wake-up is lost. A writer publishes and then looks for an armed ticket. The doorbell's own protocol guarantees
//! that either the task's look after the arming sees the publication, or the writer sees the ticket. So if step 4
//! does not find a message, its writer finds the ticket of step 3, or a later one. If the ticket is still armed, the
//! writer rings. The control thread takes each ring and then looks at the wakers, and step 2 came before the ring.
//! If another message has used the ticket up, the control thread still has to answer that message's ring: it takes
//! the ring, finds the waker of step 2, and checks the waker's endpoint for a message. Either it sees the message,
//! or it arms a ticket before it looks again. It repeats this while a waker is left whose endpoint has no message.
//!
//! Wakers are woken and dropped under no lock: either may run arbitrary code, and may even drop the endpoint.

use std::{
    fmt,
    future::poll_fn,
    pin::Pin,
    task::{Context, Poll},
};

use axon_shm::Sample;
use futures_core::{FusedStream, Stream};

use super::{server::Server, subscription::Subscription};
use crate::session::{
    core::{Listener, SessionCore},
    endpoint_state::{MessageInfo, SubscriptionInner},
    error::RecvError,
};

/// Maximum number of messages that a stream returns without a pause. It then lets its runtime run other tasks.
const IN_A_ROW: u32 = 32;

/// A task that waits at an endpoint.
struct Receiver<'a> {
    inner: &'a SubscriptionInner,
    core: &'a SessionCore,
    listener: Option<Listener<'a>>,
    /// The task's number in the endpoint's wakers, once it has waited.
    id: Option<u64>,
}

impl<'a> Receiver<'a> {
    fn new(inner: &'a SubscriptionInner, core: &'a SessionCore) -> Self {
        Self { inner, core, listener: None, id: None }
    }

    /// Returns the message that `take` finds, once it finds one.
    fn poll<T>(
        &mut self,
        context: &Context<'_>,
        mut take: impl FnMut() -> Option<T>,
    ) -> Poll<Result<T, RecvError>> {
        if self.core.is_forked() {
            return Poll::Ready(Err(RecvError::Forked));
        }
        let mut taken = take();
        if taken.is_none() {
            // The order of the steps is explained at the head of the module.
            if self.listener.is_none() {
                self.listener = Some(Listener::new(self.core)?);
            }
            if self.inner.wakers.set(&mut self.id, context.waker()) {
                self.core.listening.arm();
                taken = take();
            }
        }
        let Some(taken) = taken else { return Poll::Pending };
        self.wait_no_more();
        Poll::Ready(Ok(taken))
    }

    fn wait_no_more(&self) {
        if let Some(id) = self.id {
            self.inner.wakers.remove(id);
        }
    }
}

impl Drop for Receiver<'_> {
    fn drop(&mut self) {
        // A forked child must not take the parent's locks.
        if !self.core.is_forked() {
            self.wait_no_more();
        }
    }
}

/// The messages of an endpoint as a [`Stream`], from [`Subscription::stream`] or [`Server::stream`].
///
/// The stream continues for as long as it is polled, even if publishers come and go. It ends after an error: no later
/// poll could succeed. After 32 messages without a pause it wakes its own task and returns `Pending`, so that a
/// publisher which never pauses does not keep other tasks of the thread waiting.
///
/// ```
/// # use axon_transport::{
/// #     EndpointSpec, Session, SessionOptions,
/// #     config::{Config, DaemonPolicy},
/// #     qos::Qos,
/// # };
/// # let config = Config::builder().daemon(DaemonPolicy::Off).build()?;
/// # let session = Session::open(&config, SessionOptions::new("robot"))?;
/// # let spec = || EndpointSpec::new("/speed", "example/Speed", Qos::default());
/// let subscription = session.create_subscription(spec())?;
/// let mut messages = subscription.stream();
/// let printing = async move {
///     while let Some(message) = messages.next().await {
///         let (info, payload) = message?;
///         println!("{}: {payload:?}", info.sequence);
///     }
///     Ok::<(), axon_transport::RecvError>(())
/// };
/// // Any runtime runs it.
/// # drop(printing);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct Messages<'a> {
    receiver: Receiver<'a>,
    in_a_row: u32,
    ended: bool,
}

impl<'a> Messages<'a> {
    fn new(inner: &'a SubscriptionInner, core: &'a SessionCore) -> Self {
        Self { receiver: Receiver::new(inner, core), in_a_row: 0, ended: false }
    }
}

impl Messages<'_> {
    /// Returns the next message; `None` after an error. Like `StreamExt::next`, without a crate that has it.
    pub async fn next(&mut self) -> Option<Result<(MessageInfo, Vec<u8>), RecvError>> {
        poll_fn(|context| Pin::new(&mut *self).poll_next(context)).await
    }
}

impl Stream for Messages<'_> {
    type Item = Result<(MessageInfo, Vec<u8>), RecvError>;

    fn poll_next(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        let this = self.get_mut();
        if this.ended {
            return Poll::Ready(None);
        }
        if this.in_a_row == IN_A_ROW {
            this.in_a_row = 0;
            context.waker().wake_by_ref();
            return Poll::Pending;
        }
        let (inner, core) = (this.receiver.inner, this.receiver.core);
        let mut bytes = Vec::new();
        let polled = this.receiver.poll(context, || inner.take_bytes(core, &mut bytes));
        this.in_a_row = if polled.is_ready() { this.in_a_row + 1 } else { 0 };
        polled.map(|result| {
            this.ended = result.is_err();
            Some(result.map(|info| (info, bytes)))
        })
    }
}

impl FusedStream for Messages<'_> {
    fn is_terminated(&self) -> bool {
        self.ended
    }
}

impl fmt::Debug for Messages<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Messages").field(&self.receiver.inner.endpoint).finish()
    }
}

impl Subscription {
    /// Like [`recv`](Self::recv), without limit and without blocking a thread: for a task of any runtime.
    ///
    /// The session's control thread wakes the task. Several tasks may wait at one subscription; each sample goes to one
    /// of them. Dropping the future loses no sample. For a timeout, use the runtime's.
    ///
    /// ```
    /// # use std::{pin::pin, task::{Context, Poll, Waker}};
    /// use axon_transport::{
    ///     EndpointSpec, Session, SessionOptions,
    ///     config::{Config, DaemonPolicy},
    ///     qos::Qos,
    /// };
    ///
    /// # fn block_on<T>(future: impl Future<Output = T>) -> T {
    /// #     let mut future = pin!(future);
    /// #     loop {
    /// #         let polled = future.as_mut().poll(&mut Context::from_waker(Waker::noop()));
    /// #         if let Poll::Ready(ready) = polled {
    /// #             return ready;
    /// #         }
    /// #         std::thread::yield_now();
    /// #     }
    /// # }
    /// # let config = Config::builder().daemon(DaemonPolicy::Off).build()?;
    /// let session = Session::open(&config, SessionOptions::new("robot"))?;
    /// let spec = || EndpointSpec::new("/t", "T", Qos::default());
    /// let subscription = session.create_subscription(spec())?;
    /// let publisher = session.create_publisher(spec())?;
    /// # assert!(subscription.wait_matched(1, std::time::Duration::from_secs(10)));
    /// # block_on(async {
    /// publisher.publish(b"hello")?;
    /// let (_info, bytes) = subscription.recv_async().await?;
    /// assert_eq!(bytes, b"hello");
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// # })?;
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    ///
    /// # Errors
    /// [`RecvError::Forked`] in a forked child, and [`RecvError::AlreadyLed`] if an event loop of the program listens
    /// already.
    pub async fn recv_async(&self) -> Result<(MessageInfo, Vec<u8>), RecvError> {
        recv(&self.inner, self.session.core()).await
    }

    /// Like [`recv_async`](Self::recv_async), in place, as [`take_sample`](Self::take_sample) does.
    ///
    /// # Errors
    /// As for [`recv_async`](Self::recv_async).
    pub async fn recv_sample_async(&self) -> Result<(MessageInfo, Sample), RecvError> {
        let mut receiver = Receiver::new(&self.inner, self.session.core());
        poll_fn(|context| receiver.poll(context, || self.take_sample())).await
    }

    /// Returns a stream of the samples, each as [`recv_async`](Self::recv_async) returns it.
    pub fn stream(&self) -> Messages<'_> {
        Messages::new(&self.inner, self.session.core())
    }
}

impl Server {
    /// Returns the next request, as [`Subscription::recv_async`] returns samples.
    ///
    /// # Errors
    /// As for [`Subscription::recv_async`].
    pub async fn recv_request_async(&self) -> Result<(MessageInfo, Vec<u8>), RecvError> {
        recv(&self.requests, self.session.core()).await
    }

    /// Returns a stream of the requests, each as [`recv_request_async`](Self::recv_request_async) returns it.
    pub fn stream(&self) -> Messages<'_> {
        Messages::new(&self.requests, self.session.core())
    }
}

async fn recv(
    inner: &SubscriptionInner,
    core: &SessionCore,
) -> Result<(MessageInfo, Vec<u8>), RecvError> {
    let (mut receiver, mut bytes) = (Receiver::new(inner, core), Vec::new());
    let take =
        |context: &mut Context<'_>| receiver.poll(context, || inner.take_bytes(core, &mut bytes));
    let info = poll_fn(take).await?;
    Ok((info, bytes))
}
