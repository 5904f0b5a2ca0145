//! Wait sets: waits for any of several subscriptions, guard conditions and events.

use std::{ops::Deref, sync::Arc, time::Duration};

use axon_shm::{
    ShmError,
    internal::{ForwardedWakeups, SessionSegment, WakeCheck},
};
use smallvec::SmallVec;

use crate::{
    events::EventKind,
    session::{
        core::{Guard, GuardCondition, SessionCore},
        endpoint_state::{EventSource, SubscriptionInner},
        endpoints::{Client, Event, Server, Subscription},
        error::SessionError,
        handle::Session,
    },
};

/// An object to wait for.
///
/// ```
/// # use std::time::Duration;
/// use axon_transport::Waitable;
/// # use axon_transport::{
/// #     EndpointSpec, Session, SessionOptions,
/// #     config::{Config, DaemonPolicy},
/// #     qos::Qos,
/// # };
/// # let config = Config::builder().daemon(DaemonPolicy::Off).build()?;
/// # let session = Session::open(&config, SessionOptions::new("robot"))?;
/// # let spec = || EndpointSpec::new("/speed", "example/Speed", Qos::default());
/// let publisher = session.create_publisher(spec())?;
/// let subscription = session.create_subscription(spec())?;
/// assert!(publisher.wait_matched(1, Duration::from_secs(10)));
/// let stop = session.create_guard_condition();
/// publisher.publish(b"1.5 m/s")?;
///
/// let all = [Waitable::GuardCondition(&stop), Waitable::Subscription(&subscription)];
/// let ready = session.wait_for(&all, Some(Duration::from_secs(10)))?;
/// assert_eq!(ready[..], [1]);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Copy, Debug)]
#[non_exhaustive]
pub enum Waitable<'a> {
    /// Ready while there is a sample to take.
    Subscription(&'a Subscription),
    /// Ready while there is a request to take.
    Server(&'a Server),
    /// Ready while there is a response to take.
    Client(&'a Client),
    /// Ready once it was triggered. The wait that finds it ready resets it.
    GuardCondition(&'a GuardCondition),
    /// Ready if it occurred since its status was last taken.
    Event(&'a Event),
}

/// The indices of the ready objects among all waitables, in order. It is a slice, and a small number of indices needs
/// no allocation.
///
/// ```
/// # use std::time::Duration;
/// use axon_transport::{Ready, Waitable};
/// # use axon_transport::{
/// #     Session, SessionOptions,
/// #     config::{Config, DaemonPolicy},
/// # };
/// # let config = Config::builder().daemon(DaemonPolicy::Off).build()?;
/// # let session = Session::open(&config, SessionOptions::new("robot"))?;
/// let stop = session.create_guard_condition();
/// let nothing: Ready = session.wait_for(&[Waitable::GuardCondition(&stop)], Some(Duration::ZERO))?;
/// assert!(nothing.is_empty());
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Ready(SmallVec<[usize; USUAL_READY]>);

/// Number of indices that need no allocation: usually no more objects are ready at the same time.
const USUAL_READY: usize = 8;

/// The part of a [`Waitable`] that is checked.
#[derive(Clone, Copy)]
enum Part<'a> {
    Data(&'a Arc<SubscriptionInner>),
    Guard(&'a Arc<Guard>),
    Event(&'a EventSource, EventKind),
}

/// An owned [`Part`], which other threads can check.
enum OwnedWaitable {
    Data(Arc<SubscriptionInner>),
    Guard(Arc<Guard>),
    Event(EventSource, EventKind),
}

/// The objects that a thread waits for. The set does not keep them from ending.
pub(crate) struct WeakWaitSet {
    parts: Vec<OwnedWaitable>,
    /// The sessions of the objects, except the waiting one.
    others: Vec<Arc<SessionCore>>,
}

/// A wait for objects of another session: until it is dropped, that session's control thread listens and forwards the
/// wake-ups.
struct ForeignWait<'a> {
    other: &'a SessionCore,
    _forwarded: ForwardedWakeups<'a>,
}

impl<'a> ForeignWait<'a> {
    fn new(
        other: &'a SessionCore,
        watch: &Arc<WeakWaitSet>,
        waits: &SessionCore,
    ) -> Result<Self, ShmError> {
        other.listen()?;
        Ok(Self { other, _forwarded: other.segment.forward_wakeups(watch.clone(), &waits.segment) })
    }
}

impl Drop for ForeignWait<'_> {
    fn drop(&mut self) {
        self.other.listen_no_more();
    }
}

impl Session {
    /// Waits until at least one of `waitables` is ready, for at most `timeout`: without limit if it is `None`, and not
    /// at all if it is zero. Returns the indices of all objects that are ready then, in order; none if the time is
    /// over.
    ///
    /// Any number of threads may wait at the same time. Two threads may wait for the same object, but a guard condition
    /// wakes only one of them. Objects of another session of this process are allowed, too; their wake-ups pass through
    /// one more thread.
    ///
    /// ```
    /// use std::time::Duration;
    ///
    /// use axon_transport::{
    ///     EndpointSpec, Session, SessionOptions, Waitable,
    ///     config::{Config, DaemonPolicy},
    ///     qos::Qos,
    /// };
    ///
    /// let config = Config::builder().daemon(DaemonPolicy::Off).build()?;
    /// let session = Session::open(&config, SessionOptions::new("robot"))?;
    /// let spec = || EndpointSpec::new("/t", "T", Qos::default());
    /// let subscription = session.create_subscription(spec())?;
    /// let publisher = session.create_publisher(spec())?;
    /// let stop = session.create_guard_condition();
    /// assert!(subscription.wait_matched(1, Duration::from_secs(10)));
    /// publisher.publish(b"hello")?;
    /// let all = [Waitable::GuardCondition(&stop), Waitable::Subscription(&subscription)];
    /// assert_eq!(session.wait_for(&all, None)?, [1]);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    ///
    /// # Errors
    /// [`SessionError::OtherSession`] if an object belongs to another session that is closed or led by an event loop;
    /// an error in a forked child.
    pub fn wait_for(
        &self,
        waitables: &[Waitable<'_>],
        timeout: Option<Duration>,
    ) -> Result<Ready, SessionError> {
        if waitables.iter().any(|one| !Arc::ptr_eq(one.segment(), self.segment())) {
            return self.wait_watch(&self.watch(waitables)?, timeout);
        }
        let take = || indices(waitables.iter().map(|one| one.part().take()));
        let watch = || {
            let parts = waitables.iter().map(|one| one.part().kept()).collect();
            Arc::new(WeakWaitSet { parts, others: Vec::new() })
        };
        self.wait_until(take, watch, timeout)
    }

    /// Creates the set that [`wait_watch`](Self::wait_watch) waits for.
    pub(crate) fn watch(
        &self,
        waitables: &[Waitable<'_>],
    ) -> Result<Arc<WeakWaitSet>, SessionError> {
        let (mut parts, mut others) = (Vec::with_capacity(waitables.len()), Vec::new());
        for waitable in waitables {
            parts.push(waitable.part().kept());
            if !Arc::ptr_eq(waitable.segment(), self.segment()) {
                let session = waitable.session().ok_or(SessionError::OtherSession)?;
                if !others.iter().any(|known| Arc::ptr_eq(known, &session)) {
                    others.push(session);
                }
            }
        }
        Ok(Arc::new(WeakWaitSet { parts, others }))
    }

    /// Like [`wait_for`](Self::wait_for).
    pub(crate) fn wait_watch(
        &self,
        watch: &Arc<WeakWaitSet>,
        timeout: Option<Duration>,
    ) -> Result<Ready, SessionError> {
        if self.is_forked() {
            return Err(ShmError::Forked.into());
        }
        let visit = |other| ForeignWait::new(other, watch, self.core());
        let visits: Result<Vec<_>, _> = watch.others.iter().map(|one| visit(one)).collect();
        let _visits = visits.map_err(|_| SessionError::OtherSession)?;
        let take = || indices(watch.parts.iter().map(|kept| kept.part().take()));
        self.wait_until(take, || watch.clone(), timeout)
    }

    /// Waits until `take` finds a ready object. `watch` creates the set that other threads check; it is called only if
    /// another thread needs it.
    fn wait_until(
        &self,
        mut take: impl FnMut() -> Ready,
        watch: impl Fn() -> Arc<WeakWaitSet>,
        timeout: Option<Duration>,
    ) -> Result<Ready, SessionError> {
        if self.is_forked() {
            return Err(ShmError::Forked.into());
        }
        let mut ready = Ready::default();
        let look = || {
            ready = take();
            !ready.is_empty()
        };
        self.segment().wait_for(look, &|| -> Arc<dyn WakeCheck> { watch() }, timeout);
        Ok(ready)
    }
}

/// Returns the indices of the `true` items.
fn indices(all: impl Iterator<Item = bool>) -> Ready {
    Ready(all.enumerate().filter_map(|(index, there)| there.then_some(index)).collect())
}

impl Deref for Ready {
    type Target = [usize];

    fn deref(&self) -> &[usize] {
        &self.0
    }
}

impl<const N: usize> PartialEq<[usize; N]> for Ready {
    fn eq(&self, other: &[usize; N]) -> bool {
        self[..] == other[..]
    }
}

impl Waitable<'_> {
    /// Returns the part that is checked.
    fn part(&self) -> Part<'_> {
        match self {
            Waitable::Subscription(subscription) => Part::Data(&subscription.inner),
            Waitable::Server(server) => Part::Data(&server.requests),
            Waitable::Client(client) => Part::Data(&client.responses),
            Waitable::GuardCondition(guard) => Part::Guard(guard.guard()),
            Waitable::Event(event) => {
                let (source, kind) = event.parts();
                Part::Event(source, kind)
            }
        }
    }

    /// Returns the segment of the session that it belongs to.
    fn segment(&self) -> &Arc<SessionSegment> {
        match self {
            Waitable::Subscription(subscription) => subscription.session.segment(),
            Waitable::Server(server) => server.session.segment(),
            Waitable::Client(client) => client.session.segment(),
            Waitable::GuardCondition(guard) => guard.guard().segment(),
            Waitable::Event(event) => event.session.segment(),
        }
    }

    /// Returns its session, if that is open.
    fn session(&self) -> Option<Arc<SessionCore>> {
        let session = match self {
            Waitable::Subscription(subscription) => &subscription.session,
            Waitable::Server(server) => &server.session,
            Waitable::Client(client) => &client.session,
            Waitable::GuardCondition(guard) => return guard.guard().session(),
            Waitable::Event(event) => &event.session,
        };
        Some(session.core().clone())
    }
}

impl Part<'_> {
    /// Returns whether it is ready. Resets a guard condition that is ready.
    fn take(self) -> bool {
        match self {
            Part::Data(inner) => inner.has_data(),
            Part::Guard(guard) => guard.take(),
            Part::Event(source, kind) => source.has(kind),
        }
    }

    /// Like [`take`](Self::take), for other threads than the waiting one. It changes nothing, and returns true while a
    /// thread is taking samples.
    fn may_be_ready(self) -> bool {
        match self {
            Part::Data(inner) => inner.ready(),
            Part::Guard(guard) => guard.is_triggered(),
            Part::Event(source, kind) => source.may_have(kind),
        }
    }

    fn kept(self) -> OwnedWaitable {
        match self {
            Part::Data(inner) => OwnedWaitable::Data(Arc::clone(inner)),
            Part::Guard(guard) => OwnedWaitable::Guard(Arc::clone(guard)),
            Part::Event(source, kind) => OwnedWaitable::Event(source.clone(), kind),
        }
    }
}

impl OwnedWaitable {
    fn part(&self) -> Part<'_> {
        match self {
            Self::Data(inner) => Part::Data(inner),
            Self::Guard(guard) => Part::Guard(guard),
            Self::Event(source, kind) => Part::Event(source, *kind),
        }
    }
}

impl WakeCheck for WeakWaitSet {
    fn ready(&self) -> bool {
        self.parts.iter().any(|kept| kept.part().may_be_ready())
    }
}
