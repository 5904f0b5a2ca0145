//! Waiting for any of several things.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use super::{
    Client, Event, GuardCondition, Server, Session, SessionError, Subscription, events::Source,
    guard::Guard, state::Shared, subscription::SubscriptionInner,
};
use crate::{
    events::EventKind,
    shm::{SessionSegment, ShmError},
    wait::{Look, PassedOn},
};

/// Something to wait for.
#[derive(Clone, Copy, Debug)]
#[non_exhaustive]
pub enum Waitable<'a> {
    /// Ready while there is something to take.
    Subscription(&'a Subscription),
    /// Ready while there is a request to take.
    Server(&'a Server),
    /// Ready while there is a response to take.
    Client(&'a Client),
    /// Ready once it was triggered. The wait that finds it so resets it.
    GuardCondition(&'a GuardCondition),
    /// Ready while it occurred and its status was not taken since.
    Event(&'a Event),
}

/// The part of a [`Waitable`] that may be looked at by whoever listens for all.
pub(super) enum Part {
    Data(Arc<SubscriptionInner>),
    Guard(Arc<Guard>),
    Event(Source, EventKind),
}

/// What is waited for, without keeping it from ending.
pub(crate) struct Watch {
    parts: Vec<Part>,
    /// The sessions that it belongs to, but for the one that waits.
    others: Vec<Arc<Shared>>,
}

/// While another session is waited at, its control thread listens for it, and passes on what comes.
struct Visit<'a> {
    other: &'a Shared,
    _passed: PassedOn<'a>,
}

impl<'a> Visit<'a> {
    fn new(other: &'a Shared, watch: &Arc<Watch>, waits: &Shared) -> Result<Self, ShmError> {
        other.listen()?;
        Ok(Self { other, _passed: other.segment.pass_on(watch.clone(), &waits.segment) })
    }
}

impl Drop for Visit<'_> {
    fn drop(&mut self) {
        self.other.listen_no_more();
    }
}

impl Session {
    /// Waits until at least one of `waitables` is ready, for at most `timeout`: for ever where it is
    /// `None`, and not at all where it is zero. The indices of all that are ready then, in order; none
    /// if the time is over.
    ///
    /// Any number of threads may wait at the same time. One that waits for what another waits for,
    /// too, is no error, but a guard condition then stands for one of them only. What belongs to
    /// another session of this process can be waited for as well, and takes a thread more on its way.
    ///
    /// ```
    /// use std::time::Duration;
    ///
    /// use axon_transport::{
    ///     config::{Config, DaemonPolicy, OsFiles},
    ///     qos::Qos,
    ///     session::{EndpointSpec, Session, SessionOptions, Waitable},
    /// };
    ///
    /// let config = Config { daemon: DaemonPolicy::Off, ..Config::resolve([], None, &OsFiles)? };
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
    /// [`SessionError::OtherSession`] when one is of another session that is closed or led by an event
    /// loop, and in a forked child.
    pub fn wait_for(
        &self,
        waitables: &[Waitable<'_>],
        timeout: Option<Duration>,
    ) -> Result<Vec<usize>, SessionError> {
        self.wait_watch(&self.watch(waitables)?, timeout)
    }

    /// What [`wait_watch`](Self::wait_watch) waits for.
    pub(crate) fn watch(&self, waitables: &[Waitable<'_>]) -> Result<Arc<Watch>, SessionError> {
        let (mut parts, mut others) = (Vec::with_capacity(waitables.len()), Vec::new());
        for waitable in waitables {
            let (part, segment) = waitable.part();
            parts.push(part);
            if !Arc::ptr_eq(segment, self.segment()) {
                let session = waitable.session().ok_or(SessionError::OtherSession)?;
                if !others.iter().any(|known| Arc::ptr_eq(known, &session)) {
                    others.push(session);
                }
            }
        }
        Ok(Arc::new(Watch { parts, others }))
    }

    /// As [`wait_for`](Self::wait_for).
    pub(crate) fn wait_watch(
        &self,
        watch: &Arc<Watch>,
        timeout: Option<Duration>,
    ) -> Result<Vec<usize>, SessionError> {
        if self.is_forked() {
            return Err(ShmError::Forked.into());
        }
        let deadline = timeout.and_then(|timeout| Instant::now().checked_add(timeout));
        let visit = |other| Visit::new(other, watch, self.shared());
        let visits: Result<Vec<_>, _> = watch.others.iter().map(|one| visit(one)).collect();
        let _visits = visits.map_err(|_| SessionError::OtherSession)?;
        loop {
            let ready = watch.collect();
            let left = deadline.map(|deadline| deadline.saturating_duration_since(Instant::now()));
            if !ready.is_empty() || left.is_some_and(|left| left.is_zero()) {
                return Ok(ready);
            }
            // That something may be ready is enough for it to return: the next look is exact.
            self.segment().wait_for(watch.clone(), left);
        }
    }
}

impl Waitable<'_> {
    /// What is looked at, and the segment of the session that it belongs to.
    fn part(&self) -> (Part, &Arc<SessionSegment>) {
        match self {
            Waitable::Subscription(subscription) => {
                (Part::Data(subscription.inner.clone()), subscription.session.segment())
            }
            Waitable::Server(server) => {
                (Part::Data(server.requests.clone()), server.session.segment())
            }
            Waitable::Client(client) => {
                (Part::Data(client.responses.clone()), client.session.segment())
            }
            Waitable::GuardCondition(guard) => {
                (Part::Guard(guard.guard().clone()), guard.guard().segment())
            }
            Waitable::Event(event) => {
                let (source, kind) = event.parts();
                (Part::Event(source, kind), event.session.segment())
            }
        }
    }

    /// Its session, where that is open.
    fn session(&self) -> Option<Arc<Shared>> {
        let session = match self {
            Waitable::Subscription(subscription) => &subscription.session,
            Waitable::Server(server) => &server.session,
            Waitable::Client(client) => &client.session,
            Waitable::GuardCondition(guard) => return guard.guard().session(),
            Waitable::Event(event) => &event.session,
        };
        Some(session.shared().clone())
    }
}

impl Watch {
    /// What is ready. Guard conditions that are stand no more.
    fn collect(&self) -> Vec<usize> {
        let ready = |part: &Part| match part {
            Part::Data(inner) => inner.has_data(),
            Part::Guard(guard) => guard.take(),
            Part::Event(source, kind) => source.has(*kind),
        };
        self.parts
            .iter()
            .enumerate()
            .filter(|(_, part)| ready(part))
            .map(|(index, _)| index)
            .collect()
    }
}

impl Look for Watch {
    fn ready(&self) -> bool {
        self.parts.iter().any(|part| match part {
            Part::Data(inner) => inner.ready(),
            Part::Guard(guard) => guard.is_triggered(),
            Part::Event(source, kind) => source.may_have(*kind),
        })
    }
}
