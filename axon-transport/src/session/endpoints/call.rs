//! Calls of services: requests for which a future, or a thread, waits for the response.

use std::{
    future::poll_fn,
    pin::pin,
    sync::Arc,
    task::{Context, Poll, Wake},
    thread::{self, Thread},
    time::{Duration, Instant},
};

use axon_shm::{PublishError, Sample};

use super::client::Client;
use crate::session::{
    clock,
    core::{Listener, SessionCore},
    endpoint_state::{ServerGone, SubscriptionInner},
    error::RecvError,
};

/// The reason why a call has no response.
///
/// ```
/// # use std::time::Duration;
/// use axon_transport::CallError;
/// # use axon_transport::{
/// #     EndpointSpec, Session, SessionOptions,
/// #     config::{Config, DaemonPolicy},
/// #     qos::Qos,
/// # };
/// # let config = Config::builder().daemon(DaemonPolicy::Off).build()?;
/// # let session = Session::open(&config, SessionOptions::new("robot"))?;
/// # let spec = || EndpointSpec::new("/speed", "example/Speed", Qos::default());
/// let client = session.create_client(spec())?;
/// let failed = client.call_blocking(b"how fast?", Some(Duration::from_secs(1)));
/// assert!(matches!(failed, Err(CallError::Unavailable)));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CallError {
    /// No server is there to answer.
    #[error("no server is available")]
    Unavailable,
    /// All servers that the request was sent to are gone, and none of them answered.
    #[error("the server or the link to it was lost before the response arrived")]
    ServerGone,
    /// The request could not be sent. [`PublishError::Blocked`] means that a server does not take its requests and that
    /// there is no space for more: the call does not wait for space.
    #[error(transparent)]
    Send(#[from] PublishError),
    /// The wait for the response failed: it did not come in time, or for another reason of [`RecvError`].
    #[error(transparent)]
    Recv(#[from] RecvError),
    /// The response came, and there is no memory for it.
    #[error("no memory for a response of {len} bytes")]
    NoMemory {
        /// The length of the response.
        len: usize,
    },
}

/// A call under way. Dropping it gives the call up.
struct Calling<'a> {
    inner: &'a SubscriptionInner,
    core: &'a SessionCore,
    number: u64,
    _listener: Listener<'a>,
}

impl Calling<'_> {
    fn poll(&self, context: &Context<'_>) -> Poll<Result<Sample, CallError>> {
        if self.core.is_forked() {
            return Poll::Ready(Err(RecvError::Forked.into()));
        }
        let look = || self.inner.calls.outcome(self.number, context.waker());
        let outcome = look().or_else(|| {
            // The order of the steps is explained at the head of `messages`.
            self.core.listening.arm();
            self.inner.collect_responses(self.core);
            look()
        });
        match outcome {
            Some(outcome) => Poll::Ready(outcome.map_err(|ServerGone| CallError::ServerGone)),
            None => Poll::Pending,
        }
    }
}

impl Drop for Calling<'_> {
    fn drop(&mut self) {
        // A forked child must not take the parent's locks.
        if !self.core.is_forked() {
            self.inner.calls.end(self.number);
        }
    }
}

impl Client {
    /// Sends a request and waits for its response without blocking a thread: for a task of any runtime.
    ///
    /// Any number of calls may be under way at the same time. Of several servers, the first response counts. Dropping
    /// the future gives up its call: its response is discarded when it comes, by the next call at the latest. For a
    /// timeout, use the runtime's, or [`call_blocking`](Self::call_blocking): a response that is lost with a link to
    /// another host is lost without an error if the server stays.
    ///
    /// While a call waits, responses to requests of [`send_request`](Self::send_request) are discarded, and
    /// [`take_response`](Self::take_response) may take the response of a call: use a client either for calls, or to
    /// send and take.
    ///
    /// # Errors
    /// [`CallError`] lists them.
    pub async fn call(&self, payload: &[u8]) -> Result<Vec<u8>, CallError> {
        let (inner, core) = (&*self.responses, self.session.core());
        if core.is_forked() {
            return Err(RecvError::Forked.into());
        }
        let servers = self.servers();
        if servers.is_empty() {
            return Err(CallError::Unavailable);
        }
        let listener = Listener::new(core)?;
        let send = || self.ring.try_publish_next(clock::wall(), payload);
        let number = inner.calls.begin(servers, send)?;
        let calling = Calling { inner, core, number, _listener: listener };
        let sample = poll_fn(|context| calling.poll(context)).await?;
        let mut response = Vec::new();
        let copied = sample.copy_to(&mut response);
        copied.map_err(|_| CallError::NoMemory { len: sample.len() })?;
        Ok(response)
    }

    /// Like [`call`](Self::call), but blocks the thread for at most `timeout`, or without limit if it is `None`. It
    /// must not be used in a callback or listener, which runs on the thread that would wake it.
    ///
    /// # Errors
    /// As for [`call`](Self::call), and [`RecvError::TimedOut`].
    pub fn call_blocking(
        &self,
        payload: &[u8],
        timeout: Option<Duration>,
    ) -> Result<Vec<u8>, CallError> {
        block_on(self.call(payload), timeout).unwrap_or(Err(RecvError::TimedOut.into()))
    }
}

/// Runs a future on this thread. Returns its output, or `None` if it has none in time.
fn block_on<F: Future>(future: F, timeout: Option<Duration>) -> Option<F::Output> {
    struct Unpark(Thread);

    impl Wake for Unpark {
        fn wake(self: Arc<Self>) {
            self.0.unpark();
        }
    }

    let waker = Arc::new(Unpark(thread::current())).into();
    let mut context = Context::from_waker(&waker);
    let deadline = timeout.and_then(|timeout| Instant::now().checked_add(timeout));
    let mut future = pin!(future);
    loop {
        if let Poll::Ready(output) = future.as_mut().poll(&mut context) {
            return Some(output);
        }
        match deadline.map(|deadline| deadline.saturating_duration_since(Instant::now())) {
            None => thread::park(),
            Some(Duration::ZERO) => return None,
            Some(left) => thread::park_timeout(left),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::task::Waker;

    use super::*;
    use crate::{
        config::{Config, DaemonPolicy},
        qos::Qos,
        session::{EndpointSpec, Session, SessionOptions},
    };

    #[test]
    fn no_call_is_left_whether_it_was_answered_failed_or_dropped() {
        let config = Config::builder().daemon(DaemonPolicy::Off).build().unwrap();
        let session = Session::open(&config, SessionOptions::new("test")).unwrap();
        let spec = || EndpointSpec::new("/s", "test/Service", Qos::default());
        let server = session.create_server(spec()).unwrap();
        let client = session.create_client(spec()).unwrap();
        assert!(client.wait_available(Duration::from_secs(60)));
        let left = || client.responses.calls.count();
        let mut context = Context::from_waker(Waker::noop());
        let mut call = Box::pin(client.call(b"dropped"));
        assert!(call.as_mut().poll(&mut context).is_pending());
        assert_eq!(left(), 1);
        drop(call);
        assert_eq!(left(), 0);

        let mut call = Box::pin(client.call(b"answered"));
        assert!(call.as_mut().poll(&mut context).is_pending());
        let mut bytes = Vec::new();
        while let Some(info) = server.take_request(&mut bytes) {
            server.send_response(info.publisher, info.sequence, &bytes).unwrap();
        }
        assert_eq!(block_on(call, None).unwrap().unwrap(), b"answered");
        assert_eq!(left(), 0);
        assert!(!client.has_response(), "that to the first call was dropped on the way");

        let mut call = Box::pin(client.call(b"failed"));
        assert!(call.as_mut().poll(&mut context).is_pending());
        drop(server);
        assert!(matches!(block_on(call, None), Some(Err(CallError::ServerGone))));
        assert_eq!(left(), 0);
    }
}
