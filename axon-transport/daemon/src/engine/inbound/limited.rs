//! Handles samples and requests of a peer that exceed a limit: most are dropped, and some wait in their stream.

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

/// Streams that are not read until their limit opens.
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

    /// Forgets a stream that is gone.
    pub(super) fn forget(&mut self, stream: &StreamKey) {
        if let Some(until) = self.of.remove(stream) {
            self.due.remove(&(until, *stream));
        }
    }

    /// Takes a stream that may be read again now.
    pub(super) fn take_due(&mut self, now: Duration) -> Option<StreamKey> {
        let (_, stream) = self.due.first().copied().filter(|(due, _)| *due <= now)?;
        self.forget(&stream);
        Some(stream)
    }

    /// Takes all streams, which are not held any more.
    fn take_all(&mut self) -> Vec<StreamKey> {
        self.due.clear();
        std::mem::take(&mut self.of).into_keys().collect()
    }

    /// Returns when the next stream may be read again.
    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        self.due.first().map(|(due, _)| *due)
    }

    /// Returns the number of held streams.
    #[cfg(test)]
    pub(super) fn len(&self) -> usize {
        self.of.len().max(self.due.len())
    }
}

impl Inbound {
    /// Returns the message if it may pass the limits of its route. Otherwise, either its stream is held, and the error
    /// has the stream's next step; or the message must be dropped, and is counted.
    ///
    /// A sample that waited here would delay other samples: it would hold memory, streams and window of its peer, and
    /// its publisher would not know of it. So a topic is held only if its publisher waits for its readers anyway.
    pub(super) fn pass_limit(
        &mut self,
        key: StreamKey,
        stream: &mut IncomingStream,
        limit: &RouteLimit,
        message: OpenedMessage,
        now: Duration,
    ) -> Result<OpenedMessage, Option<StepOutcome>> {
        let Some((header, Some(route))) = stream.header else {
            return Err(Some(StepOutcome::Over));
        };
        let keeps_all = self.routes.get(&header.route).is_some_and(|route| route.keeps_all);
        let may_wait = route.kind == Kind::Request || header.reliable && keeps_all;
        // Streams that wait for one limit are read in turn.
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

    /// Continues the streams whose limit opens.
    pub(super) fn handle_limits_due(&mut self, now: Duration) {
        while let Some(stream) = self.limited.take_due(now) {
            self.make_ready(stream);
        }
    }

    /// Continues all held streams, because the limits of routes changed.
    pub(crate) fn handle_limits(&mut self) {
        for stream in self.limited.take_all() {
            self.make_ready(stream);
        }
    }
}
