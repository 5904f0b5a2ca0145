//! Samples of a peer that are beyond a limit: those that are dropped, and those that wait.

use std::{
    collections::{BTreeSet, HashMap},
    rc::Rc,
    time::Duration,
};

use axon_shm::ids::Gid;
use axon_transport::access::Over;

use super::{
    FULL_RETRY, Inbound, Key, LONG,
    incoming::{Incoming, Message, Step, StreamHeader},
    reading::{Next, wait},
};
use crate::engine::{
    account::Charge,
    limits::{Exceeded, RouteLimit},
};

/// A route's number, and the publisher.
type FlowKey = (u32, Gid);

/// What waits for a limit.
#[derive(Debug, Default)]
pub(super) struct Limited {
    /// The newest sample of a flow.
    newest: HashMap<FlowKey, Newest>,
    /// When each of these may pass.
    due: BTreeSet<(Duration, FlowKey)>,
    /// Streams that are not read on until a time.
    streams: BTreeSet<(Duration, Key)>,
}

/// The newest sample of a flow, which waits.
#[derive(Debug)]
struct Newest {
    header: StreamHeader,
    acknowledged: bool,
    message: Message,
    due: Duration,
    _memory: [Option<Charge>; 2],
}

impl Limited {
    /// The number of the sample of a flow that waits.
    fn number_of(&self, flow: &FlowKey) -> Option<u64> {
        self.newest.get(flow).map(|newest| newest.message.number)
    }

    /// This sample waits. Returns the one that it replaces.
    fn put(&mut self, flow: FlowKey, newest: Newest) -> Option<Newest> {
        let before = self.take(flow);
        self.due.insert((newest.due, flow));
        self.newest.insert(flow, newest);
        before
    }

    fn take(&mut self, flow: FlowKey) -> Option<Newest> {
        let newest = self.newest.remove(&flow)?;
        self.due.remove(&(newest.due, flow));
        Some(newest)
    }

    /// A flow whose sample may pass by now.
    fn take_due(&mut self, now: Duration) -> Option<FlowKey> {
        self.due.pop_first_if(now)
    }

    /// The streams that are read on now.
    fn take_streams(&mut self, now: Duration) -> Vec<Key> {
        std::iter::from_fn(|| self.streams.pop_first_if(now)).collect()
    }

    /// All that waits is looked at again.
    fn look_again(&mut self) {
        let streams = std::mem::take(&mut self.streams);
        self.streams = streams.into_iter().map(|(_, key)| (Duration::ZERO, key)).collect();
        self.due = self.newest.keys().map(|flow| (Duration::ZERO, *flow)).collect();
        self.newest.values_mut().for_each(|newest| newest.due = Duration::ZERO);
    }

    /// When the next of them may pass.
    pub(super) fn poll_timeout(&self) -> Option<Duration> {
        let first = self.due.first().map(|(due, _)| *due);
        first.into_iter().chain(self.streams.first().map(|(due, _)| *due)).min()
    }

    /// How many samples wait.
    #[cfg(test)]
    pub(super) fn len(&self) -> usize {
        self.newest.len()
    }
}

/// A set in the order of time.
trait Timed<T> {
    /// Takes the first of it, if that is due.
    fn pop_first_if(&mut self, now: Duration) -> Option<T>;
}

impl<T: Ord> Timed<T> for BTreeSet<(Duration, T)> {
    fn pop_first_if(&mut self, now: Duration) -> Option<T> {
        let is_due = self.first().is_some_and(|(due, _)| *due <= now);
        if is_due { self.pop_first().map(|(_, what)| what) } else { None }
    }
}

impl Inbound {
    /// Returns the message if it may pass the limits of its route. Else it is dropped, or it waits.
    pub(super) fn pass_limit(
        &mut self,
        key: Key,
        stream: &mut Incoming,
        limit: &RouteLimit,
        message: Message,
        acknowledged: bool,
        now: Duration,
    ) -> Result<Message, Next> {
        let Some((header, _)) = stream.header else { return Err(Next::Over) };
        let (flow, number) = ((header.route, header.of), message.number);
        let go_on = if header.reliable { Next::Go } else { Next::Over };
        // Over a new link a sample may come again that waits here, and those that were dropped for it.
        if let Some(waits) = self.limited.number_of(&flow).filter(|waits| *waits >= number) {
            if acknowledged && number < waits {
                self.receipts.came(flow, number, 0, now);
            }
            self.release(stream);
            return Err(go_on);
        }
        if limit.exceeded(&header.of, now).is_none() && !self.deliver_newest(flow, now) {
            return Err(self.wait_for_room(key, stream, message, now));
        }
        let Some(exceeded) = limit.exceeded(&header.of, now) else { return Ok(message) };
        match exceeded.over() {
            Over::Hold => {
                self.limited.streams.insert((now + exceeded.wait, key));
                return Err(wait(stream, Step::Ring(message)));
            }
            Over::DropNewest => self.drop_limited(&exceeded, header, acknowledged, number, now),
            Over::DropOldest => {
                let mut memory = [stream.room.take(), stream.unpacked.take()];
                let length = message.payload.len();
                // One that came whole is held by nobody until it waits.
                if memory.iter().all(Option::is_none) && length <= LONG {
                    memory[0] = self.intake.short.charge(length);
                    if memory[0].is_none() {
                        self.drop_limited(&exceeded, header, acknowledged, number, now);
                        return Err(go_on);
                    }
                }
                let due = now + exceeded.wait;
                let newest = Newest { header, acknowledged, message, due, _memory: memory };
                if let Some(older) = self.limited.put(flow, newest) {
                    let number = older.message.number;
                    self.drop_limited(&exceeded, header, older.acknowledged, number, now);
                    drop(older);
                    self.try_without_room();
                }
                return Err(go_on);
            }
        }
        self.release(stream);
        Err(go_on)
    }

    fn drop_limited(
        &mut self,
        exceeded: &Exceeded,
        header: StreamHeader,
        acknowledged: bool,
        number: u64,
        now: Duration,
    ) {
        exceeded.dropped(1);
        self.counters.lost(&self.topic(header.route), exceeded.cause(), 1);
        if acknowledged {
            self.receipts.dropped((header.route, header.of), number, now);
        }
    }

    /// Writes the sample of a flow that waits for its limit, if there is one. Returns whether none waits now.
    fn deliver_newest(&mut self, flow: FlowKey, now: Duration) -> bool {
        let Some(newest) = self.limited.take(flow) else { return true };
        let Newest { header, acknowledged, ref message, .. } = newest;
        let number = message.number;
        let route = self.routes.get(&flow.0);
        let to =
            route.and_then(|r| Some((r.limit.clone(), Rc::clone(r.writers.get(&message.writer)?))));
        let Some((limit, stand_in)) = to else {
            self.counters.lost(&self.topic(flow.0), "no_route", 1);
            if acknowledged {
                self.receipts.dropped(flow, number, now);
            }
            return true;
        };
        if stand_in.last_sequence() >= Some(number) {
            if acknowledged {
                self.receipts.came(flow, number, 0, now);
            }
            return true;
        }
        let length = message.payload.len();
        match self.write(&stand_in, header, message.meta, &message.payload, now) {
            None => {
                self.limited.put(flow, Newest { due: now + FULL_RETRY, ..newest });
                return false;
            }
            Some(there) => {
                limit.pass(&header.of, length, now);
                match acknowledged {
                    true if there => self.receipts.came(flow, number, length, now),
                    true => self.receipts.dropped(flow, number, now),
                    false => {}
                }
            }
        }
        drop(newest);
        self.try_without_room();
        true
    }

    /// Lets pass what waited for a limit until now.
    pub(super) fn handle_limits_due(&mut self, now: Duration) {
        for key in self.limited.take_streams(now) {
            self.make_ready(key);
        }
        while let Some(flow) = self.limited.take_due(now) {
            let route = self.routes.get(&flow.0);
            let exceeded = route.and_then(|route| route.limit.exceeded(&flow.1, now));
            match (exceeded, self.limited.newest.get_mut(&flow)) {
                // Another publisher of the topic was faster.
                (Some(exceeded), Some(newest)) => {
                    newest.due = now + exceeded.wait;
                    self.limited.due.insert((newest.due, flow));
                }
                _ => {
                    self.deliver_newest(flow, now);
                }
            }
        }
        if let Some(written) = self.written.take() {
            written.announce();
        }
    }

    /// The limits of routes changed.
    pub(crate) fn handle_limits(&mut self) {
        self.limited.look_again();
    }
}
