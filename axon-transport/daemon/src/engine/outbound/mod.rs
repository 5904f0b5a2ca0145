//! Samples to one peer: from the rings of local publishers into QUIC streams.
//!
//! Samples wait here and not in QUIC, because QoS can act on them here. Of bulk, QUIC holds the congestion window and a
//! little more ([`connection`](super::connection)), so that the newest sample is soon the next. A pass costs the flows
//! that have something to send, and no others.

mod active;
mod backlog;
pub(crate) mod budget;
mod burst;
mod ending;
mod flow;
mod lending;
mod nudges;
mod queue;
mod schedule;
mod served;
mod source;
mod stall;
mod streams;
mod without;

use std::{
    collections::{BTreeSet, HashMap},
    rc::Rc,
    sync::Arc,
    time::Duration,
};

use axon_shm::ids::Gid;
use quinn_proto::{StreamId, VarInt};

pub(crate) use self::{
    backlog::Backlog,
    schedule::{Class, FlowId, Priorities, Rank},
    served::{ResponseNumbers, RouteOut},
    source::Source,
};
use self::{
    budget::Budget,
    ending::Endings,
    flow::{CreditQueue, Flow, Pause, PeerCredit},
    lending::Lending,
    nudges::Nudges,
    schedule::Schedule,
    served::{FlowRoute, Served},
    source::Done,
    stall::Stalls,
    without::Without,
};
use super::{congestion::let_probe_through, connection::Carrier};
use crate::{
    engine::counters::Counters,
    link::{CloseCode, Intake, ReceivedOf},
};

/// Flows look again after this time at a link that has no keys.
const NO_CARRIER: Duration = Duration::from_secs(1);

/// What the peer's owner has to know.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum OutboundEvent {
    /// Nothing is left of a publisher that ended.
    Drained(Gid),
    /// Samples were given up.
    Lost {
        /// The topic.
        topic: Arc<str>,
        /// The cause, as status shows it.
        cause: &'static str,
        /// How many.
        samples: u64,
    },
    /// The peer does not read what it asked for over this route.
    Stalled(u32),
}

/// The samples to one peer.
pub(crate) struct Outbound {
    routes: HashMap<u32, Served>,
    /// The routes of the sources.
    by_source: HashMap<Gid, u32>,
    flows: Vec<Option<Flow>>,
    free: Vec<FlowId>,
    schedule: Schedule,
    priorities: Priorities,
    lending: Lending,
    budget: Rc<Budget>,
    counters: Rc<Counters>,
    timers: BTreeSet<(Duration, FlowId)>,
    without: Without,
    credit: Rc<PeerCredit>,
    /// The flows that wait for credit.
    for_credit: CreditQueue,
    /// Streams may have become idle since a flow found none.
    frees_streams: bool,
    /// Streams of flows that ended, and whether a sample is cut off there.
    ended: Vec<(StreamId, bool)>,
    /// Flows with samples that are not acknowledged. The others cost nothing.
    busy: BTreeSet<FlowId>,
    endings: Endings,
    stalls: Stalls,
    nudges: Nudges,
    responses: ResponseNumbers,
    events: Vec<OutboundEvent>,
}

impl Outbound {
    /// Serves nothing yet.
    pub(crate) fn new(
        budget: Rc<Budget>,
        counters: Rc<Counters>,
        responses: ResponseNumbers,
        stalled_after: Duration,
        now: Duration,
    ) -> Self {
        Self {
            routes: HashMap::new(),
            by_source: HashMap::new(),
            flows: Vec::new(),
            free: Vec::new(),
            schedule: Schedule::default(),
            priorities: Priorities::default(),
            lending: Lending::default(),
            without: Without::new(&budget),
            budget,
            credit: PeerCredit::new(),
            for_credit: CreditQueue::default(),
            counters,
            timers: BTreeSet::new(),
            frees_streams: false,
            ended: Vec::new(),
            busy: BTreeSet::new(),
            endings: Endings::default(),
            stalls: Stalls::new(stalled_after, now),
            nudges: Nudges::default(),
            responses,
            events: Vec::new(),
        }
    }

    /// Serves this route from now on, or changes it.
    pub(crate) fn set_route(&mut self, number: u32, route: RouteOut, now: Duration) {
        let RouteOut { sources, seen, .. } = route;
        let shared = FlowRoute {
            number,
            topic: route.topic,
            route: route.route,
            priority: route.priority,
            acknowledged: route.acknowledged,
            short_headers: route.short_headers,
            responses: self.responses.clone(),
            credit: Rc::clone(&self.credit),
        };
        self.routes.entry(number).or_insert_with(|| {
            self.priorities.add(shared.priority);
            Served {
                shared,
                stalled: false,
                sources: Vec::new(),
                seen: HashMap::new(),
                flows: HashMap::new(),
            }
        });
        self.update_sources(number, sources, seen, now);
    }

    /// The route has these sources from now on.
    pub(crate) fn set_sources(&mut self, number: u32, sources: Vec<Source>, now: Duration) {
        self.update_sources(number, sources, HashMap::new(), now);
    }

    fn update_sources(
        &mut self,
        number: u32,
        sources: Vec<Source>,
        seen: HashMap<Gid, u64>,
        now: Duration,
    ) {
        let Some(served) = self.routes.get_mut(&number) else { return };
        for gone in served.sources.iter().map(Source::gid) {
            self.by_source.remove(&gone);
        }
        self.by_source.extend(sources.iter().map(|source| (source.gid(), number)));
        served.sources = sources;
        served.seen = seen;
        let Served { sources, seen, flows, .. } = served;
        let (mut unread, mut read) = (Vec::new(), Vec::new());
        for (of, id) in flows.iter() {
            let Some(flow) = &mut self.flows[*id] else { continue };
            flow.set_sources(sources, seen.get(of).copied());
            if flow.is_idle() && !sources.iter().any(|source| source.reads(of)) {
                unread.push(*of);
            } else {
                read.push(*id);
            }
        }
        for of in unread {
            self.remove_flow(number, &of);
        }
        for id in read {
            self.note_busy(id, now);
            self.schedule(id);
        }
        self.look_for_samples(number, now);
    }

    /// The peer no longer wants this route.
    pub(crate) fn end_route(&mut self, number: u32) {
        let Some(served) = self.routes.remove(&number) else { return };
        self.priorities.remove(served.shared.priority);
        for source in &served.sources {
            self.by_source.remove(&source.gid());
        }
        for id in served.flows.into_values() {
            self.forget_flow(id);
        }
    }

    /// The peer does not read this route: as [`end_route`](Self::end_route), but the samples that are not
    /// acknowledged are given up. Returns how many.
    pub(crate) fn give_up_route(&mut self, number: u32) -> u64 {
        let given_up = self.routes.get(&number).map_or(0, Served::give_up);
        let flows = self.routes.get(&number).into_iter().flat_map(|served| served.flows.values());
        for id in flows {
            self.flows[*id].iter_mut().for_each(Flow::give_up);
        }
        self.end_route(number);
        given_up
    }

    /// Takes the KEEP_ALL relays of a route, as many as `most` says, whose samples another daemon of the peer's host may
    /// ask for. Nothing of their flows is given up.
    pub(crate) fn take_kept(&mut self, number: u32, most: usize) -> Vec<Source> {
        let Some(served) = self.routes.get_mut(&number) else { return Vec::new() };
        let kept: Vec<_> = served.sources.extract_if(.., |s| s.keeps_all()).take(most).collect();
        for source in &kept {
            self.by_source.remove(&source.gid());
        }
        let read = |of: &Gid| kept.iter().any(|source| source.reads(of));
        let flows: Vec<_> = served.flows.extract_if(|of, _| read(of)).collect();
        flows.into_iter().for_each(|(_, id)| self.forget_flow(id));
        kept
    }

    /// A publisher of a route ended: the samples that it left are sent, and then [`OutboundEvent::Drained`] comes.
    pub(crate) fn handle_publisher_ended(&mut self, number: u32, publisher: Gid, now: Duration) {
        self.endings.add(number, publisher, now);
    }

    fn schedule(&mut self, id: FlowId) {
        if let Some(flow) = &mut self.flows[id]
            && flow.scheduled.is_none()
            && !flow.blocked
            && let Some(rank) = flow.rank()
        {
            flow.scheduled = Some(rank);
            self.schedule.push(id, rank);
        }
    }

    fn remove_flow(&mut self, number: u32, of: &Gid) {
        let removed = self.routes.get_mut(&number).and_then(|served| served.flows.remove(of));
        if let Some(id) = removed {
            self.forget_flow(id);
        }
    }

    /// Forgets a flow. Its number is free again once no list has it.
    fn forget_flow(&mut self, id: FlowId) {
        let Some(mut flow) = self.flows[id].take() else { return };
        self.ended.extend(flow.take_streams());
        self.timers.remove(&(flow.timer.unwrap_or_default(), id));
        self.without.forget(id);
        self.for_credit.forget(id);
        self.busy.remove(&id);
        self.nudges.forget(id);
        self.stalls.forget(id);
        if flow.scheduled.is_some() {
            self.schedule.remove(id);
        }
        self.free.push(id);
    }

    /// Hands samples to QUIC until it takes no more, or none is left.
    pub(crate) fn pump(&mut self, carrier: &mut Carrier<'_>, now: Duration) {
        for (stream, is_cut) in self.ended.drain(..) {
            carrier.streams.remove(&stream);
            end(carrier.quic, stream, is_cut);
        }
        self.retry_held();
        self.retry_for_credit();
        carrier.priorities = self.priorities;
        carrier.closed_from = self.for_credit.closed_from();
        let mut blocked = None;
        while let Some(id) = self.schedule.pop(|at| self.lending.borrows(at)) {
            let Some(flow) = &mut self.flows[id] else { continue };
            let Some(served) = self.routes.get(&flow.route_number) else { continue };
            let Some(rank) = flow.scheduled.take() else { continue };
            carrier.lender = self.lending.borrow(rank);
            carrier.flow = id;
            let (before, taken) = (flow.timer, carrier.taken);
            let mut done = Done::default();
            let pause = match flow.waits_for_credit && !carrier.is_open_to(rank) {
                true => Pause::NoCredit,
                false => flow.write(&served.sources, carrier, &self.counters, &mut done, now),
            };
            flow.waits_for_credit = pause == Pause::NoCredit;
            served.done(flow.of, done);
            if carrier.loses && carrier.taken > taken {
                self.nudges.handle_sent(id, carrier.quic.rtt(), now);
            }
            match (carrier.taken - taken, carrier.lender) {
                (0, _) => {}
                (bytes, Some(_)) => self.lending.handle_borrowed(rank, bytes),
                (bytes, None) => self.lending.handle_sent(rank, bytes),
            }
            if flow.is_held() {
                self.without.room(id);
            }
            if flow.timer != before {
                self.timers.remove(&(before.unwrap_or_default(), id));
                self.timers.extend(flow.timer.map(|due| (due, id)));
            }
            match pause {
                Pause::Turn => self.schedule(id),
                Pause::Empty => {}
                Pause::Blocked => {
                    flow.blocked = true;
                    flow.take_burst(&served.sources, &self.counters, now);
                    let limit = carrier.limit_of(rank);
                    blocked = Some(blocked.map_or(limit, |least: u64| least.min(limit)));
                    self.lending.handle_blocked(rank);
                }
                Pause::NoStream => {
                    self.without.stream(id);
                    self.frees_streams = true;
                }
                Pause::NoKey => {
                    self.without.key(id, now);
                }
                Pause::NoCredit => {
                    flow.blocked = true;
                    flow.take_burst(&served.sources, &self.counters, now);
                    // What it took from its rings may have another rank.
                    self.for_credit.add(id, flow.rank().unwrap_or(rank).place());
                    carrier.closed_from = self.for_credit.closed_from();
                    self.lending.handle_blocked(rank);
                }
            }
            // Flows that gave credit back in this pass may be the last ones that use any.
            if self.schedule.is_empty() {
                self.retry_for_credit();
                carrier.closed_from = self.for_credit.closed_from();
            }
        }
        if std::mem::take(&mut self.frees_streams) {
            self.finish_idle_streams(carrier);
        }
        carrier.rest(blocked);
    }

    /// Tries the flows again that found no room, if there is more now.
    fn retry_held(&mut self) {
        for id in self.without.take_for_room(&self.budget) {
            self.schedule(id);
        }
    }

    /// Tries the flows again that found no credit, if there is more now.
    fn retry_for_credit(&mut self) {
        if !self.for_credit.is_due(&self.credit) {
            return;
        }
        for id in self.for_credit.take(&self.credit).into_iter().rev() {
            let Some(flow) = &mut self.flows[id] else { continue };
            flow.blocked = false;
            // Its samples may have been acknowledged meanwhile.
            flow.waits_for_credit &= flow.rank().is_some();
            if flow.scheduled.is_none()
                && let Some(rank) = flow.rank()
            {
                flow.scheduled = Some(rank);
                self.schedule.push_first(id, rank);
            }
        }
    }

    /// The peer says how much it takes in over this link.
    pub(crate) fn set_intake(&mut self, intake: &Intake) {
        self.credit.set(Some(intake));
    }

    /// QUIC takes more of this flow's stream.
    pub(crate) fn handle_writable(&mut self, id: FlowId) {
        if let Some(flow) = self.flows.get_mut(id).and_then(Option::as_mut) {
            flow.blocked = false;
            self.schedule(id);
        }
    }

    /// The peer allows more streams.
    pub(crate) fn handle_streams_available(&mut self) {
        for id in self.without.take_for_stream() {
            self.schedule(id);
        }
    }

    /// There may be keys for messages.
    pub(crate) fn handle_keys(&mut self) {
        for id in self.without.take_for_key() {
            self.schedule(id);
        }
    }

    /// The peer's QUIC has all of a stream.
    pub(crate) fn handle_finished(
        &mut self,
        id: FlowId,
        stream: StreamId,
        quic: &mut quinn_proto::Connection,
        now: Duration,
    ) {
        if let Some(flow) = self.flows.get_mut(id).and_then(Option::as_mut) {
            flow.handle_finished(stream, quic, &self.counters, now);
            flow.blocked = false;
            self.schedule(id);
        }
    }

    /// The peer wants no more of a stream.
    pub(crate) fn handle_stopped(
        &mut self,
        id: FlowId,
        stream: StreamId,
        quic: &mut quinn_proto::Connection,
    ) {
        let Some(flow) = self.flows.get_mut(id).and_then(Option::as_mut) else { return };
        let mut done = Done::default();
        flow.handle_stopped(stream, quic, &self.counters, &mut done);
        flow.blocked = false;
        if let Some(served) = self.routes.get(&flow.route_number) {
            served.done(flow.of, done);
        }
        self.schedule(id);
    }

    /// The peer acknowledges samples. Numbers that were not sent to it, and more drops than samples, are ignored.
    pub(crate) fn handle_received(&mut self, flows: &[ReceivedOf]) {
        for ReceivedOf { route, publisher, sequence, dropped } in flows {
            let Some(served) = self.routes.get(route) else { continue };
            if !served.shared.acknowledged {
                continue;
            }
            let Some(id) = served.flows.get(publisher).copied() else { continue };
            let Some(flow) = &mut self.flows[id] else { continue };
            if let Some(done) = flow.acknowledge(*sequence, *dropped) {
                served.done(*publisher, done);
                self.schedule(id);
            }
        }
        self.frees_streams |= self.without.waits_for_stream() > 0;
    }

    /// A new link carries all flows. What the old link did not deliver is sent again.
    pub(crate) fn succeed(&mut self, mut old: Option<&mut quinn_proto::Connection>) {
        for (stream, is_cut) in self.ended.drain(..) {
            if let Some(old) = old.as_deref_mut() {
                end(old, stream, is_cut);
            }
        }
        for id in 0..self.flows.len() {
            if let Some(flow) = &mut self.flows[id] {
                flow.succeed(old.as_deref_mut(), &self.counters);
                self.schedule(id);
            }
        }
        self.credit.set(None);
        self.handle_streams_available();
        self.handle_keys();
    }

    /// The link is over, and no other carries the flows: counts what did not arrive, and tells the publishers. Returns
    /// the losses by topic.
    pub(crate) fn link_over(&mut self) -> Vec<(Arc<str>, u64)> {
        let mut losses = Vec::new();
        for served in self.routes.values() {
            let mut unsent = 0;
            for (of, id) in &served.flows {
                let Some(flow) = &mut self.flows[*id] else { continue };
                let left = flow.end(&self.counters);
                let source = served.sources.iter().find(|source| source.reads(of));
                let reliable = source.is_some_and(|source| {
                    source.qos().reliability == axon_shm::qos::Reliability::Reliable
                });
                // A RELIABLE sample of a topic counts until it is acknowledged.
                if served.is_service() || !reliable {
                    unsent += left;
                }
            }
            let topic = &served.shared.topic;
            let lost = if served.is_service() {
                unsent
            } else {
                self.counters.lost(topic, "no_link", unsent);
                served.give_up()
            };
            if lost > 0 {
                self.counters.lost(topic, "link_ended", lost);
                losses.push((Arc::clone(topic), lost));
            }
        }
        losses
    }

    /// When [`handle_timeout`](Self::handle_timeout) is due.
    pub(crate) fn poll_timeout(&self) -> Option<Duration> {
        let flow = self.timers.first().map(|(due, _)| *due);
        let endings = self.endings.poll_timeout();
        let stalls = (!self.busy.is_empty()).then(|| self.stalls.poll_timeout()).flatten();
        let nudges = self.nudges.poll_timeout();
        [flow, endings, stalls, nudges, self.without.poll_timeout()].into_iter().flatten().min()
    }

    /// Does what is due. `heard` counts the frames that came over the link.
    /// Without a carrier there are no keys for the link.
    pub(crate) fn handle_timeout(
        &mut self,
        mut carrier: Option<&mut Carrier<'_>>,
        heard: u64,
        now: Duration,
    ) {
        while let Some((due, id)) = self.timers.first().copied()
            && due <= now
        {
            self.timers.pop_first();
            let Some(flow) = &mut self.flows[id] else { continue };
            match carrier.as_deref_mut() {
                Some(carrier) => flow.handle_timeout(carrier, &self.counters, now),
                None => flow.timer = Some(now + NO_CARRIER),
            }
            let (of, number, timer, idle) =
                (flow.of, flow.route_number, flow.timer, flow.is_idle());
            match timer {
                Some(due) => {
                    self.timers.insert((due, id));
                }
                None if idle => self.remove_unread(number, &of),
                None => {}
            }
            self.schedule_if_there(id);
        }
        if self.without.poll_timeout().is_some_and(|due| due <= now) {
            self.handle_keys();
        }
        let rtt = carrier.as_deref().map_or(NO_CARRIER, |carrier| carrier.quic.rtt());
        let is_on_the_way = |id: FlowId| {
            self.flows.get(id).and_then(Option::as_ref).is_some_and(Flow::is_on_the_way)
        };
        if self.nudges.handle_timeout(rtt, now, is_on_the_way)
            && let Some(carrier) = carrier
        {
            carrier.quic.ping();
            let_probe_through(carrier.quic);
        }
        self.look_at_endings(now);
        self.look_at_stalls(heard, now);
    }

    fn schedule_if_there(&mut self, id: FlowId) {
        if self.flows[id].is_some() {
            self.schedule(id);
        }
    }

    /// Forgets an idle flow whose publisher is gone.
    fn remove_unread(&mut self, number: u32, of: &Gid) {
        let Some(served) = self.routes.get(&number) else { return };
        if !served.sources.iter().any(|source| source.reads(of)) {
            self.remove_flow(number, of);
        }
    }

    /// Counts the samples that were overwritten in their rings while their flows left them there.
    pub(crate) fn count_overwritten(&mut self) {
        for id in &self.busy {
            if let Some(flow) = &mut self.flows[*id]
                && flow.rank().is_some()
                && let Some(served) = self.routes.get(&flow.route_number)
            {
                flow.count_overwritten(&served.sources, &self.counters);
            }
        }
    }

    /// The next event.
    pub(crate) fn poll_event(&mut self) -> Option<OutboundEvent> {
        if self.events.is_empty() { None } else { Some(self.events.remove(0)) }
    }

    /// What waits for the peer.
    pub(crate) fn backlog(&self) -> Backlog {
        let mut backlog = Backlog::default();
        for flow in self.busy.iter().filter_map(|id| self.flows[*id].as_ref()) {
            if let Some((class, bytes)) = flow.waiting() {
                backlog.bytes[class as usize] += bytes;
            }
            backlog.oldest = [backlog.oldest, flow.oldest()].into_iter().flatten().min();
        }
        backlog
    }

    /// Whether there is anything to hand to QUIC.
    pub(crate) fn has_work(&self) -> bool {
        !self.schedule.is_empty()
            || !self.ended.is_empty()
            || self.frees_streams
            || self.for_credit.is_due(&self.credit)
    }
}

/// Ends a stream. One on which a sample is cut off must not look whole.
fn end(quic: &mut quinn_proto::Connection, stream: StreamId, is_cut: bool) {
    let mut stream = quic.send_stream(stream);
    // Either error says that the stream is over.
    let _ = match is_cut {
        true => stream.reset(VarInt::from_u32(CloseCode::Goodbye.code())).map_err(drop),
        false => stream.finish().map_err(drop),
    };
}
