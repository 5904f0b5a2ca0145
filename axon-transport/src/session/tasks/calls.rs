//! Requests for whose responses tasks wait. Each task receives the response to its own request.

use std::{
    collections::{HashMap, HashSet},
    fmt,
    future::poll_fn,
    pin::pin,
    sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError},
    task::{Context, Poll, Wake, Waker},
    thread::{self, Thread},
    time::{Duration, Instant},
};

use axon_shm::{
    PublishError, Sample,
    internal::{Carried, Writer},
};

use super::listening::Listener;
use crate::{
    ids::Gid,
    session::{
        Client, RecvError, clock,
        state::SessionShared,
        subscription::{SubscriptionInner, take_sample_from},
    },
};

/// Responses that are looked at before others have their turn.
const BATCH: usize = 256;

/// Why a call has no response.
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
    /// The request could not be sent. [`PublishError::Blocked`] says that a server does not take its requests and
    /// that there is no room for more: the call does not wait for room.
    #[error(transparent)]
    Send(#[from] PublishError),
    /// The response could not be waited for: it did not come in time, or as [`RecvError`] says.
    #[error(transparent)]
    Recv(#[from] RecvError),
    /// The response came, and there is no memory for it.
    #[error("no memory for a response of {len} bytes")]
    NoMemory {
        /// Its length.
        len: usize,
    },
}

/// The calls of a client that are under way.
#[derive(Default)]
pub(in crate::session) struct Calls {
    by_number: Mutex<HashMap<u64, Call>>,
    /// The ring of the requests.
    ring: OnceLock<Arc<Writer>>,
}

struct Call {
    /// To which its request went.
    servers: Vec<Gid>,
    waker: Option<Waker>,
    outcome: Option<Result<Sample, ServerGone>>,
}

struct ServerGone;

impl Calls {
    /// The ring of the client's requests.
    pub(in crate::session) fn set_ring(&self, ring: Arc<Writer>) {
        // There is one.
        let _ = self.ring.set(ring);
    }

    /// Whether a server that is not read may still answer: a daemon carries its requests, or carried them, and the ring
    /// keeps them for the next daemon.
    fn carried(&self, server: &Gid) -> Option<Carried> {
        self.ring.get()?.carried(server)
    }

    /// Sends a request, and has its response kept. Its number.
    fn begin<E>(&self, servers: Vec<Gid>, send: impl FnOnce() -> Result<u64, E>) -> Result<u64, E> {
        // A response that comes before its number is in the table would be nobody's.
        let mut calls = self.lock();
        let number = send()?;
        calls.insert(number, Call { servers, waker: None, outcome: None });
        Ok(number)
    }

    /// What became of a call; else `waker` is woken when something does.
    fn outcome(&self, number: u64, waker: &Waker) -> Option<Result<Sample, ServerGone>> {
        let waker = waker.clone();
        let mut calls = self.lock();
        let call = calls.get_mut(&number)?;
        let outcome = call.outcome.take();
        let before = call.waker.replace(waker);
        drop(calls);
        drop(before);
        outcome
    }

    fn end(&self, number: u64) {
        let call = self.lock().remove(&number);
        drop(call);
    }

    /// Hands out the responses that came, and drops those that nobody waits for. Whether a call still waits.
    pub(super) fn collect(&self, of: &SubscriptionInner, shared: &SessionShared) -> bool {
        // The lock is held from the moment that a response leaves its ring until its call has it. A reader of
        // `calls` therefore finds the response either in the ring or in its call.
        let mut calls = self.lock();
        let (mut woken, mut passed) = (Vec::new(), Vec::new());
        let mut waiting = calls.values().filter(|call| call.outcome.is_none()).count();
        let mut looked = 0;
        while waiting > 0 {
            if looked == BATCH {
                shared.wake();
                break;
            }
            let Some((info, sample)) = take_sample_from(of, shared) else {
                let (failed, again) = self.fail_those_without_server(&mut calls, of, &mut woken);
                waiting -= failed;
                if let Some(again) = again {
                    shared.look_again(again);
                }
                break;
            };
            looked += 1;
            match calls.get_mut(&info.sequence).filter(|call| call.outcome.is_none()) {
                Some(call) => {
                    call.outcome = Some(Ok(sample));
                    woken.extend(call.waker.take());
                    waiting -= 1;
                }
                None => passed.push(sample),
            }
        }
        drop(calls);
        woken.into_iter().for_each(Waker::wake);
        waiting > 0
    }

    /// Once all responses that came are taken: those of whose servers none is left, and nothing more can come, get no
    /// response any more. How many these are, and when to look again.
    fn fail_those_without_server(
        &self,
        calls: &mut HashMap<u64, Call>,
        of: &SubscriptionInner,
        woken: &mut Vec<Waker>,
    ) -> (usize, Option<Instant>) {
        let servers: HashSet<Gid> =
            calls.values().flat_map(|call| &call.servers).copied().collect();
        let gone: Vec<Gid> = {
            let matched_readers = of.lock();
            servers.into_iter().filter(|server| !matched_readers.reads(server)).collect()
        };
        // After that: one that comes back is attached before it is read.
        let mut again = None::<Instant>;
        let lost: HashSet<Gid> = gone
            .into_iter()
            .filter(|server| match self.carried(server) {
                Some(Carried::Attached) => false,
                Some(Carried::Absent(until)) => {
                    again = Some(again.map_or(until, |before| before.min(until)));
                    false
                }
                None => true,
            })
            .collect();
        let mut failed = 0;
        for call in calls.values_mut().filter(|call| call.outcome.is_none()) {
            if call.servers.iter().all(|server| lost.contains(server)) {
                call.outcome = Some(Err(ServerGone));
                woken.extend(call.waker.take());
                failed += 1;
            }
        }
        (failed, again)
    }

    fn lock(&self) -> MutexGuard<'_, HashMap<u64, Call>> {
        self.by_number.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A call that is under way, until it is dropped.
struct Calling<'a> {
    inner: &'a SubscriptionInner,
    shared: &'a SessionShared,
    number: u64,
    _listener: Listener<'a>,
}

impl Calling<'_> {
    fn poll(&self, context: &Context<'_>) -> Poll<Result<Sample, CallError>> {
        if self.shared.segment.is_forked() {
            return Poll::Ready(Err(RecvError::Forked.into()));
        }
        let look = || self.inner.calls.outcome(self.number, context.waker());
        let outcome = look().or_else(|| {
            // The order is that of the module's head.
            self.shared.listening.arm();
            self.inner.calls.collect(self.inner, self.shared);
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
        // A forked child has none of the parent's locks.
        if !self.shared.segment.is_forked() {
            self.inner.calls.end(self.number);
        }
    }
}

impl Client {
    /// Sends a request and waits for its response, without a thread that waits: for a task of any runtime.
    ///
    /// Any number of calls may be under way at the same time. Of several servers the first response counts. A
    /// future that is dropped gives its call up: its response is discarded when it comes, by the next call at the
    /// latest. For a timeout, use the runtime's, or [`call_blocking`](Self::call_blocking): a response that is lost
    /// with a link to another host is lost without a word if the server stays.
    ///
    /// While a call waits, responses to what [`send_request`](Self::send_request) sent are discarded, and
    /// [`take_response`](Self::take_response) may take what a call waits for: a client either calls, or sends
    /// and takes.
    ///
    /// # Errors
    /// What [`CallError`] lists.
    pub async fn call(&self, payload: &[u8]) -> Result<Vec<u8>, CallError> {
        let (inner, shared) = (&*self.responses, self.session.shared());
        if shared.segment.is_forked() {
            return Err(RecvError::Forked.into());
        }
        let servers = self.servers();
        if servers.is_empty() {
            return Err(CallError::Unavailable);
        }
        let listener = Listener::new(shared)?;
        let send = || self.ring.try_publish_next(clock::wall(), payload);
        let number = inner.calls.begin(servers, send)?;
        let calling = Calling { inner, shared, number, _listener: listener };
        let sample = poll_fn(|context| calling.poll(context)).await?;
        let mut response = Vec::new();
        let copied = sample.copy_to(&mut response);
        copied.map_err(|_| CallError::NoMemory { len: sample.len() })?;
        Ok(response)
    }

    /// As [`call`](Self::call), for a thread that waits, for at most `timeout`; without end where it is `None`.
    /// Not for a callback or listener, which runs on the thread that would wake it.
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

/// The output of a future, if it has one in time.
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

impl fmt::Debug for Calls {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Calls").finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests {
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
        let left = || client.responses.calls.lock().len();
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
