//! Samples and requests of a peer that are beyond a limit: most are dropped, and some wait in their stream.

use std::{
    collections::{BTreeSet, HashMap},
    time::Duration,
};

use axon_envelope::Kind;
use axon_transport::access::Overflow;

use super::{
    Inbound, StreamKey,
    incoming::{IncomingStream, OpenedMessage, StreamStep},
    reading::{StepOutcome, wait},
};
use crate::engine::limits::RouteLimit;

/// Streams that are not read on until their limit opens.
#[derive(Debug, Default)]
pub(super) struct RateLimitedStreams {
    due: BTreeSet<(Duration, StreamKey)>,
    of: HashMap<StreamKey, Duration>,
}

impl RateLimitedStreams {
    pub(super) fn hold(&mut self, stream: StreamKey, until: Duration) {
        self.forget(&stream);
        self.due.insert((until, stream));
        self.of.insert(stream, until);
    }

    /// A stream is gone.
    pub(super) fn forget(&mut self, stream: &StreamKey) {
        if let Some(until) = self.of.remove(stream) {
            self.due.remove(&(until, *stream));
        }
    }

    /// A stream that is read on now.
    pub(super) fn take_due(&mut self, now: Duration) -> Option<StreamKey> {
        let (_, stream) = self.due.first().copied().filter(|(due, _)| *due <= now)?;
        self.forget(&stream);
        Some(stream)
    }

    /// All streams, which are held no more.
    fn take_all(&mut self) -> Vec<StreamKey> {
        self.due.clear();
        std::mem::take(&mut self.of).into_keys().collect()
    }

    /// When the next of them is read on.
    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        self.due.first().map(|(due, _)| *due)
    }

    /// How many streams are held.
    #[cfg(test)]
    pub(super) fn len(&self) -> usize {
        self.of.len().max(self.due.len())
    }
}

impl Inbound {
    /// Returns the message if it may pass the limits of its route. Else its stream is held, and what it does next is
    /// returned; or the message is to be dropped and is counted.
    ///
    /// A sample that waited here would be in the way of others: it would keep memory, streams and window of its peer, and its
    /// publisher would not be told of it. So a topic is held only where its publisher waits for its readers anyway.
    pub(super) fn pass_limit(
        &mut self,
        key: StreamKey,
        stream: &mut IncomingStream,
        limit: &RouteLimit,
        message: OpenedMessage,
        now: Duration,
    ) -> Result<OpenedMessage, Option<StepOutcome>> {
        let Some((header, Some(route))) = stream.header else {
            return Err(Some(StepOutcome::Overflow));
        };
        let keeps_all = self.routes.get(&header.route).is_some_and(|route| route.keeps_all);
        let may_wait = route.kind == Kind::Request || header.reliable && keeps_all;
        // Streams that wait for one limit are read on in turn.
        let waits = |over| may_wait && over == Overflow::Hold;
        let Some(exceeded) = limit.exceeded_by(&header.of, waits, now) else {
            return Ok(message);
        };
        if waits(exceeded.overflow()) {
            self.limited.hold(key, now + exceeded.wait);
            return Err(Some(wait(stream, StreamStep::Ring(message))));
        }
        exceeded.dropped(1);
        self.counters.lost(&self.topic(header.route), exceeded.cause(), 1);
        Err(None)
    }

    /// Has the streams read on whose limit opens.
    pub(super) fn handle_limits_due(&mut self, now: Duration) {
        while let Some(stream) = self.limited.take_due(now) {
            self.make_ready(stream);
        }
    }

    /// The limits of routes changed.
    pub(crate) fn handle_limits(&mut self) {
        for stream in self.limited.take_all() {
            self.make_ready(stream);
        }
    }
}
