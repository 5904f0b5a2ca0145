//! The events of endpoints, which wait sets and callbacks receive.

use std::{fmt, sync::Arc};

use crate::{
    events::{EventKind, EventStatus, Statuses},
    session::{
        endpoint_state::{Callback, EventSource, NewDataCallback},
        handle::Session,
    },
};

/// One event of a publisher or subscription. Thread-safe; it may outlive its endpoint, and then
/// never occurs again.
///
/// ```
/// use std::time::Duration;
///
/// use axon_transport::{
///     EndpointSpec, Session, SessionOptions,
///     config::{Config, DaemonPolicy},
///     events::{EventKind, EventStatus},
///     qos::Qos,
/// };
///
/// let config = Config::builder().daemon(DaemonPolicy::Off).build()?;
/// let session = Session::open(&config, SessionOptions::new("robot"))?;
/// let publisher = session.create_publisher(EndpointSpec::new("/t", "T", Qos::default()))?;
/// let matched = publisher.event(EventKind::PublicationMatched).expect("publishers have it");
/// let _reader = session.create_subscription(EndpointSpec::new("/t", "T", Qos::default()))?;
/// assert!(publisher.wait_matched(1, Duration::from_secs(10)));
/// let EventStatus::Matched(status) = matched.take() else { unreachable!() };
/// assert_eq!((status.total, status.current_change), (1, 1));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct Event {
    source: EventSource,
    kind: EventKind,
    pub(in crate::session) session: Session,
    /// Its own, which the endpoint knows from when it is first set.
    callback: Arc<Callback>,
}

impl Event {
    pub(in crate::session) fn new(
        source: EventSource,
        kind: EventKind,
        session: Session,
    ) -> Option<Self> {
        let publishers = matches!(source, EventSource::Publisher(_));
        let callback = Arc::default();
        (kind.is_publishers() == publishers).then_some(Self { source, kind, session, callback })
    }

    /// Which it is.
    pub fn kind(&self) -> EventKind {
        self.kind
    }

    /// Whether it occurred since its status was last taken. False in a forked child.
    pub fn is_ready(&self) -> bool {
        !self.session.is_forked() && self.source.has(self.kind)
    }

    /// The status; its changes are counted anew from here. In a forked child, one of which nothing
    /// ever happened.
    pub fn take(&self) -> EventStatus {
        if self.session.is_forked() {
            let mut nothing = match self.source {
                EventSource::Publisher(_) => Statuses::of_publisher(),
                EventSource::Subscription(_) => Statuses::of_subscription(),
            };
            return nothing.take(self.kind).expect("checked when the event was made");
        }
        self.source.events().take(self.kind)
    }

    /// Has `callback` told of it from now on, in place of the one that this handle had before, which is
    /// not called any more once this returns. What happened since the status was last taken, and this
    /// handle told nobody of, it is told at once, on this thread; the rest on the control thread, or
    /// where another endpoint of the session comes or goes. It must neither block nor panic, nor hold
    /// the session. It ends with this handle.
    pub fn set_callback(&self, callback: Option<NewDataCallback>) {
        if !self.session.is_forked() {
            self.source.events().tell(self.kind, &self.callback);
            self.callback.set(callback);
        }
    }

    /// The callback has returned and is not called any more once this returns, whatever is set from now
    /// on: for a handle that other threads may still use though it has ended.
    pub(crate) fn tell_no_more(&self) {
        if !self.session.is_forked() {
            self.callback.end();
            self.source.events().tell_no_more(&self.callback);
        }
    }

    /// What a wait set looks at.
    pub(in crate::session) fn parts(&self) -> (&EventSource, EventKind) {
        (&self.source, self.kind)
    }
}

impl fmt::Debug for Event {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Event").field(&self.kind).finish()
    }
}

impl Drop for Event {
    fn drop(&mut self) {
        self.tell_no_more();
    }
}
