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
    /// The callback of this handle. The endpoint knows it from the first `set_callback` on.
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

    /// Returns the kind of the event.
    pub fn kind(&self) -> EventKind {
        self.kind
    }

    /// Returns whether it occurred since its status was last taken. Returns false in a forked child.
    pub fn is_ready(&self) -> bool {
        !self.session.is_forked() && self.source.has(self.kind)
    }

    /// Takes the status; its changes are counted anew from here. In a forked child, this returns the status of an event
    /// that never occurred.
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

    /// Sets the callback for this event. The previous callback of this handle is not called any more once this returns.
    /// The new callback receives at once, on this thread, the number of occurrences since the status was last taken
    /// that this handle has not reported. Later occurrences are reported on the control thread, or on a thread that
    /// adds or removes another endpoint of the session. The callback must neither block nor panic, nor hold the
    /// session. It ends with this handle.
    pub fn set_callback(&self, callback: Option<NewDataCallback>) {
        if !self.session.is_forked() {
            self.source.events().tell(self.kind, &self.callback);
            self.callback.set(callback);
        }
    }

    /// Ends the callback for good. Once this returns, the callback has returned and is not called any more, whatever is
    /// set later: for a handle that other threads may still use although it has ended.
    pub(crate) fn tell_no_more(&self) {
        if !self.session.is_forked() {
            self.callback.end();
            self.source.events().tell_no_more(&self.callback);
        }
    }

    /// Returns the parts that a wait set checks.
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
