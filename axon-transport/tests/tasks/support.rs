//! A session without a daemon, and the smallest of all executors.

use std::{
    pin::pin,
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    },
    task::{Context, Poll, Wake, Waker},
    thread::{self, Thread},
    time::{Duration, Instant},
};

use axon_transport::{
    EndpointSpec, Publisher, Session, SessionOptions, Subscription,
    config::{Config, DaemonPolicy},
    qos::Qos,
};

/// Long enough for a loaded machine; a test that works never waits for it.
pub(crate) const PATIENCE: Duration = Duration::from_secs(60);

pub(crate) fn alone() -> Session {
    let config = Config::builder().daemon(DaemonPolicy::Off).build().unwrap();
    Session::open(&config, SessionOptions::new("test")).unwrap()
}

pub(crate) fn pair(session: &Session, topic: &str) -> (Publisher, Subscription) {
    let spec = || EndpointSpec::new(topic, "test/Bytes", Qos::keep_all());
    let subscription = session.create_subscription(spec()).unwrap();
    let publisher = session.create_publisher(spec()).unwrap();
    assert!(subscription.wait_matched(1, PATIENCE));
    (publisher, subscription)
}

/// Sleeps until the future is ready. A wake-up that is lost is a failure.
pub(crate) fn block_on<T>(future: impl Future<Output = T>) -> T {
    struct Unpark(Thread);

    impl Wake for Unpark {
        fn wake(self: Arc<Self>) {
            self.0.unpark();
        }
    }

    let waker = Waker::from(Arc::new(Unpark(thread::current())));
    let deadline = Instant::now() + PATIENCE;
    let mut future = pin!(future);
    loop {
        if let Poll::Ready(output) = future.as_mut().poll(&mut Context::from_waker(&waker)) {
            return output;
        }
        let left = deadline.saturating_duration_since(Instant::now());
        assert!(!left.is_zero(), "a wake-up was lost");
        thread::park_timeout(left);
    }
}

/// Counts the times that it is woken.
#[derive(Default)]
pub(crate) struct Count(AtomicUsize);

impl Wake for Count {
    fn wake(self: Arc<Self>) {
        self.0.fetch_add(1, Ordering::SeqCst);
    }
}

impl Count {
    pub(crate) fn new() -> (Arc<Self>, Waker) {
        let count = Arc::<Self>::default();
        let waker = Waker::from(count.clone());
        (count, waker)
    }

    pub(crate) fn get(&self) -> usize {
        self.0.load(Ordering::SeqCst)
    }
}

/// Waits for something that must come.
pub(crate) fn until(what: &str, mut reached: impl FnMut() -> bool) {
    let deadline = Instant::now() + PATIENCE;
    while !reached() {
        assert!(Instant::now() < deadline, "in vain: {what}");
        thread::sleep(Duration::from_millis(1));
    }
}
