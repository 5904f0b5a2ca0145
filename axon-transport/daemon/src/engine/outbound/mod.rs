//! Samples to one peer: from the rings of local publishers into QUIC streams.
//!
//! Samples wait in the rings and flows, not in QUIC, because QoS still applies to them there. QUIC holds bulk
//! samples for the congestion window and a little more ([`connection`](super::quic::connection)), so that the
//! newest sample is sent soon. A pass costs time only for the flows that have samples to send.

mod backlog;
pub(crate) mod budget;
mod burst;
mod drains;
mod flow;
mod flow_scheduler;
#[cfg(test)]
mod model;
mod pings;
mod progress;
mod queue;
mod schedule;
mod served;
mod source;
mod stall;
mod table;
mod unfinished;

use std::{collections::HashMap, rc::Rc, sync::Arc, time::Duration};

use axon_shm::ids::Gid;
use bytes::Bytes;
use quinn_proto::{StreamId, VarInt};

pub(crate) use self::{
    backlog::Backlog,
    served::{ResponseNumbers, RouteOut},
    source::Source,
    stall::StallCause,
    unfinished::{UnfinishedFlow, UnfinishedFlows},
};
use self::{
    budget::Budget,
    drains::{FinishedPublisher, GivenUpSamples, PublisherDrains},
    flow::{Flow, FlowPause},
    flow_scheduler::FlowScheduler,
    pings::Pings,
    served::{FlowRoute, ServedFlows},
    source::FlowProgress,
    stall::{BusyFlow, FlowStalls, PeerActivity},
    table::FlowTable,
};
use super::{
    compression::PeerCompression, congestion::let_probe_through, quic::connection::Carrier,
    rank::FlowId,
};
use crate::{
    engine::{counters::Counters, limits::Limit},
    link::{CloseCode, ReceiveLimits, ReceivedOf},
};

/// Time after which flows check again whether a link has keys.
const NO_CARRIER: Duration = Duration::from_secs(1);

/// An event for the owner of the peer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum OutboundEvent {
    /// An ended publisher has no samples left.
    Drained(Gid),
    /// Samples were given up.
    Lost {
        /// The topic.
        topic: Arc<str>,
        /// The cause, as status shows it.
        cause: &'static str,
        /// The number of samples.
        samples: u64,
    },
    /// The peer does not read the samples of this route.
    Stalled(u32, StallCause),
}

/// The samples to one peer.
pub(crate) struct Outbound {
    table: FlowTable,
    turns: FlowScheduler,
    endings: PublisherDrains,
    stalls: FlowStalls,
    pings: Pings,
    budget: Rc<Budget>,
    counters: Rc<Counters>,
    responses: ResponseNumbers,
    compression: PeerCompression,
    events: Vec<OutboundEvent>,
}

impl Outbound {
    /// Creates an outbound side without routes.
    pub(crate) fn new(
        budget: Rc<Budget>,
        counters: Rc<Counters>,
        responses: ResponseNumbers,
        compression: PeerCompression,
        stalled_after: Duration,
        now: Duration,
    ) -> Self {
        Self {
            table: FlowTable::default(),
            turns: FlowScheduler::new(Rc::clone(&budget)),
            endings: PublisherDrains::new(budget.of_daemon()),
            stalls: FlowStalls::new(stalled_after, now),
            pings: Pings::default(),
            budget,
            counters,
            responses,
            compression,
            events: Vec::new(),
        }
    }

    /// Adds or changes a route.
    pub(crate) fn set_route(&mut self, number: u32, route: RouteOut, now: Duration) {
        let RouteOut { sources, seen, unfinished, .. } = route;
        let shared = FlowRoute {
            number,
            topic: route.topic,
            route: route.route,
            priority: route.priority,
            acknowledged: route.acknowledged,
            short_headers: route.short_headers,
            compressed: route.compressed,
            redundant: route.redundant,
            limit: route.limit,
            responses: self.responses.clone(),
            credit: Rc::clone(self.turns.credit()),
        };
        self.table.routes.add(number, shared);
        self.update_sources(number, sources, seen, now);
        for (of, UnfinishedFlow { progress, sent_progress }) in unfinished {
            let Some(id) = self.table.find(number, &of) else { continue };
            let Some(flow) = self.table.flows.get_mut(id) else { continue };
            flow.go_on(sent_progress);
            self.stalls.inherit(id, flow.progress(), progress, now);
        }
    }

    /// Replaces the sources of a route.
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
        let changed = self.table.set_sources(number, sources, seen);
        self.forget(changed.gone);
        for id in changed.stay {
            self.note_busy(id, now);
            self.schedule(id);
        }
        // Samples may wait in any of the route's rings.
        let waiting = self.table.routes.get(number).map_or_else(Vec::new, ServedFlows::with_data);
        waiting.into_iter().for_each(|of| self.take_in(number, of, now));
    }

    /// Replaces the limits on a route.
    pub(crate) fn set_limits(&mut self, number: u32, limits: Vec<Rc<Limit>>) {
        let Some(served) = self.table.routes.get(number) else { return };
        served.shared.limit.set(limits);
        for id in served.flows.values().copied().collect::<Vec<_>>() {
            if let Some(flow) = self.table.flows.get_mut(id) {
                flow.handle_limits();
                self.schedule(id);
            }
        }
    }

    /// Takes in samples that may wait at these sources, each with its writer. Sources of other peers may be
    /// in the list.
    pub(crate) fn handle_active(&mut self, now: Duration, active: &[(Gid, Gid)]) {
        for (source, writer) in active {
            let Some((number, source)) = self.table.routes.of_source(source) else { continue };
            for of in source.with_data_of(writer) {
                self.take_in(number, of, now);
            }
        }
    }

    /// Takes in waiting samples of a publisher or client.
    fn take_in(&mut self, number: u32, of: Gid, now: Duration) {
        let Some(id) = self.table.find_or_insert(number, of, &self.budget) else { return };
        let Some((flow, served)) = self.table.get_mut(id) else { return };
        flow.handle_samples();
        flow.take_burst(&served.sources, &self.counters, now);
        self.note_busy(id, now);
        self.schedule(id);
    }

    /// Marks a flow as busy, because samples of it wait.
    fn note_busy(&mut self, id: FlowId, now: Duration) {
        if self.table.flows.set_busy(id) {
            self.stalls.handle_first(now);
        }
    }

    /// Ends a route that the peer no longer wants.
    pub(crate) fn end_route(&mut self, number: u32) {
        let gone = self.table.remove_route(number);
        self.forget(gone);
    }

    /// Ends a route that the peer does not read, and gives up its unacknowledged samples. Returns the number
    /// of these samples.
    pub(crate) fn give_up_route(&mut self, number: u32) -> u64 {
        let given_up = self.table.give_up(number, &self.counters);
        self.end_route(number);
        given_up
    }

    /// Takes over up to `most` KEEP_ALL relays of a route, whose samples another daemon of the peer's host
    /// may ask for. Nothing of their flows is given up. Also returns the unfinished flows.
    pub(crate) fn take_kept(
        &mut self,
        number: u32,
        most: usize,
        now: Duration,
    ) -> (Vec<Source>, UnfinishedFlows) {
        let unfinished = self.leave(number, now);
        let (kept, gone) = self.table.take_kept(number, most);
        self.forget(gone);
        (kept, unfinished)
    }

    /// Returns the unfinished flows of a service's route that is about to end. The next route continues with
    /// them, because their samples are still there.
    pub(crate) fn leave_service(&mut self, number: u32) -> UnfinishedFlows {
        self.leave(number, self.stalls.looked())
    }

    /// Returns the unfinished flows of a route: those that hold up a publisher, server or client.
    fn leave(&mut self, number: u32, now: Duration) -> UnfinishedFlows {
        let flows = self.table.kept_flows(number).into_iter();
        let known = flows.map(|(of, flow, sent_progress)| {
            (of, UnfinishedFlow { progress: self.stalls.leave(&flow, now), sent_progress })
        });
        known.collect()
    }

    /// Returns whether samples of a publisher wait for their acknowledgement or for a limit.
    pub(crate) fn has_left(&self, number: u32, sources: &[Source], publisher: &Gid) -> bool {
        sources.iter().any(|source| source.has_unacknowledged(publisher))
            || self.table.holds_best_effort(number, publisher)
    }

    /// Handles the end of a publisher: its remaining samples are sent. Then [`OutboundEvent::Drained`]
    /// follows.
    pub(crate) fn handle_publisher_ended(&mut self, now: Duration, number: u32, publisher: Gid) {
        self.endings.add(number, publisher, now);
    }

    fn schedule(&mut self, id: FlowId) {
        if let Some(flow) = self.table.flows.get(id) {
            self.turns.add(id, flow);
        }
    }

    /// Forgets flows that are gone. Their numbers may be used for other flows.
    fn forget(&mut self, gone: impl IntoIterator<Item = FlowId>) {
        for id in gone {
            self.turns.forget(id);
            self.pings.forget(id);
            self.stalls.forget(id);
        }
    }

    /// Passes samples to QUIC until QUIC takes no more or no sample is left.
    pub(crate) fn pump(&mut self, carrier: &mut Carrier<'_>, now: Duration) {
        for (stream, is_cut) in self.table.flows.take_ended_streams() {
            carrier.streams.remove(&stream);
            end(carrier.quic, stream, is_cut);
        }
        self.turns.retry(&mut self.table.flows);
        carrier.priorities = self.table.routes.priorities();
        carrier.closed_from = self.turns.closed_from();
        let mut blocked = None;
        while let Some(turn) = self.turns.next() {
            let Some((flow, served)) = self.table.get_mut(turn.flow) else { continue };
            (carrier.flow, carrier.lender) = (turn.flow, turn.lender);
            let before = carrier.taken;
            let mut done = FlowProgress::default();
            let pause = match flow.waits_for_credit && !carrier.is_open_to(turn.rank) {
                true => FlowPause::NoCredit,
                false => {
                    let (counters, compression) = (&self.counters, &self.compression);
                    flow.write(&served.sources, carrier, counters, compression, &mut done, now)
                }
            };
            flow.waits_for_credit = pause == FlowPause::NoCredit;
            served.done(flow.info.of, done);
            let taken = carrier.taken - before;
            if carrier.loses && taken > 0 {
                self.pings.handle_sent(now, turn.flow, carrier.quic.rtt());
            }
            self.turns.handle_sent(turn, taken);
            if flow.is_held() {
                self.turns.handle_held(turn);
            }
            if matches!(pause, FlowPause::Blocked | FlowPause::NoCredit) {
                flow.blocked = true;
                flow.take_burst(&served.sources, &self.counters, now);
            }
            if pause == FlowPause::Blocked {
                let limit = carrier.limit_of(turn.rank);
                blocked = Some(blocked.map_or(limit, |least: u64| least.min(limit)));
            }
            self.table.flows.note_timer(turn.flow);
            self.turns.handle_over(now, turn, pause, &mut self.table.flows);
            carrier.closed_from = self.turns.closed_from();
        }
        self.table.flows.finish_idle_streams(self.turns.take_wanted_streams(), carrier);
        carrier.rest(blocked, self.turns.wait_for_quic(), now);
    }

    /// Sets how much the peer takes in over this link.
    pub(crate) fn set_receive_limits(&mut self, intake: &ReceiveLimits) {
        self.turns.credit().set(Some(intake));
    }

    /// Handles the answer to a compression order: the sample is sent as `frame`, or uncompressed if that is
    /// `None`.
    pub(crate) fn handle_compressed(&mut self, id: FlowId, order: u64, frame: Option<Bytes>) {
        if let Some(flow) = self.table.flows.get_mut(id) {
            flow.handle_compressed(order, frame, &self.counters);
            self.schedule(id);
        }
    }

    /// Continues a flow whose stream has room in QUIC again.
    pub(crate) fn handle_writable(&mut self, id: FlowId) {
        if let Some(flow) = self.table.flows.get_mut(id) {
            flow.blocked = false;
            self.schedule(id);
        }
    }

    /// Continues flows that wait for a stream: the peer allows more streams.
    pub(crate) fn handle_streams_available(&mut self) {
        self.turns.handle_streams_available(&self.table.flows);
    }

    /// Continues flows that wait for keys: there may be some now.
    pub(crate) fn handle_keys(&mut self) {
        self.turns.handle_keys(&self.table.flows);
    }

    /// Handles the acknowledgement of a complete stream by the peer's QUIC.
    pub(crate) fn handle_finished(
        &mut self,
        now: Duration,
        id: FlowId,
        stream: StreamId,
        quic: &mut quinn_proto::Connection,
    ) {
        if let Some(flow) = self.table.flows.get_mut(id) {
            flow.handle_finished(now, stream, quic, &self.counters);
            flow.blocked = false;
            self.schedule(id);
        }
    }

    /// Handles that the peer wants no more of a stream.
    pub(crate) fn handle_stopped(
        &mut self,
        id: FlowId,
        stream: StreamId,
        quic: &mut quinn_proto::Connection,
    ) {
        let Some((flow, served)) = self.table.get_mut(id) else { return };
        let mut done = FlowProgress::default();
        flow.handle_stopped(stream, quic, &self.counters, &mut done);
        flow.blocked = false;
        served.done(flow.info.of, done);
        self.schedule(id);
    }

    /// Handles acknowledgements of the peer. Numbers that were not sent to it, and more drops than samples, are
    /// ignored.
    pub(crate) fn handle_received(&mut self, flows: &[ReceivedOf]) {
        for ReceivedOf { route, publisher, sequence, dropped } in flows {
            let Some(served) = self.table.routes.get(*route) else { continue };
            if !served.shared.acknowledged {
                continue;
            }
            let Some(id) = served.flows.get(publisher).copied() else { continue };
            let Some((flow, served)) = self.table.get_mut(id) else { continue };
            if let Some(done) = flow.acknowledge(*sequence, *dropped) {
                served.done(*publisher, done);
                self.schedule(id);
            }
        }
        self.turns.handle_acknowledged();
    }

    /// Moves all flows to a new link. Samples that the old link did not deliver are sent again.
    pub(crate) fn succeed(&mut self, mut old: Option<&mut quinn_proto::Connection>) {
        for (stream, is_cut) in self.table.flows.take_ended_streams() {
            if let Some(old) = old.as_deref_mut() {
                end(old, stream, is_cut);
            }
        }
        for id in self.table.flows.ids() {
            if let Some(flow) = self.table.flows.get_mut(id) {
                flow.succeed(old.as_deref_mut(), &self.counters);
                self.schedule(id);
            }
        }
        self.turns.credit().set(None);
        self.handle_streams_available();
        self.handle_keys();
    }

    /// Handles the end of the link without a successor: counts the samples that did not arrive, and reports
    /// them to the publishers. Returns the losses by topic.
    pub(crate) fn link_over(&mut self) -> Vec<(Arc<str>, u64)> {
        self.table.link_over(&self.counters)
    }

    /// Returns when [`handle_timeout`](Self::handle_timeout) is due.
    pub(crate) fn poll_timeout(&self) -> Option<Duration> {
        let parts = [
            self.table.flows.poll_timeout(),
            self.endings.poll_timeout(),
            (!self.table.flows.are_quiet()).then(|| self.stalls.poll_timeout()),
            self.pings.poll_timeout(),
            self.turns.poll_timeout(),
        ];
        parts.into_iter().flatten().min()
    }

    /// Does the work that is due. `heard` counts the frames that arrived over the link. Without a carrier
    /// there are no keys for the link.
    pub(crate) fn handle_timeout(
        &mut self,
        now: Duration,
        mut carrier: Option<&mut Carrier<'_>>,
        heard: u64,
    ) {
        while let Some(id) = self.table.flows.take_due(now) {
            let Some((flow, served)) = self.table.get_mut(id) else { continue };
            match carrier.as_deref_mut() {
                Some(carrier) => flow.handle_timeout(now, carrier, &self.counters),
                None => flow.timer = Some(now + NO_CARRIER),
            }
            // The publisher of an idle flow may be gone.
            if flow.timer.is_none() && flow.is_idle() && !served.reads(&flow.info.of) {
                let (number, of) = (flow.info.route_number, flow.info.of);
                let gone = self.table.remove(number, &of);
                self.forget(gone);
            }
            self.table.flows.note_timer(id);
            self.schedule(id);
        }
        self.turns.handle_timeout(now, &self.table.flows);
        let rtt = carrier.as_deref().map_or(NO_CARRIER, |carrier| carrier.quic.rtt());
        let lacks_keys = carrier.as_deref().is_some_and(|carrier| carrier.seal.lacks_keys_of_kme());
        let is_on_the_way = |id| self.table.flows.get(id).is_some_and(Flow::is_on_the_way);
        if self.pings.handle_timeout(now, rtt, is_on_the_way)
            && let Some(carrier) = carrier
        {
            carrier.quic.ping();
            let_probe_through(carrier.quic);
        }
        self.look_at_endings(now);
        self.look_at_stalls(heard, lacks_keys, now);
    }

    /// Reports the ended publishers without remaining samples, and gives up the samples of those without
    /// progress.
    fn look_at_endings(&mut self, now: Duration) {
        let starves = self.stalls.starves();
        let left_of = |route, of: &Gid| self.table.left_of(route, of, starves);
        let bytes_of = |route, of: &Gid| self.table.bytes_left_of(route, of);
        let over = self.endings.handle_timeout(now, left_of, bytes_of);
        for FinishedPublisher { publisher, given_up } in over {
            if let Some(given_up) = given_up {
                self.give_up_ended(publisher, given_up);
            }
            self.events.push(OutboundEvent::Drained(publisher));
        }
    }

    fn give_up_ended(&mut self, of: Gid, given_up: GivenUpSamples) {
        let GivenUpSamples { route: number, samples, why } = given_up;
        let Some(served) = self.table.routes.get(number) else { return };
        let topic = Arc::clone(&served.shared.topic);
        // BEST_EFFORT samples in the rings are only counted when they are taken.
        let is_reliable = served.is_reliable(&of);
        let in_rings = served.give_up_ended(&of);
        let samples = if is_reliable { samples } else { samples + in_rings };
        why.warn(&topic, &of, samples);
        let gone = self.table.remove(number, &of);
        self.forget(gone);
        self.counters.dropped("publisher_ended", samples);
        self.events.push(OutboundEvent::Lost { topic, cause: "publisher_ended", samples });
    }

    /// Reports the routes without progress for the limit. While this host's KME gives no keys, flows with
    /// nothing in flight are excused.
    fn look_at_stalls(&mut self, heard: u64, lacks_keys: bool, now: Duration) {
        let (returned, is_awaited) = (self.turns.credit().returned(), self.turns.wait_for_credit());
        let peer = PeerActivity { heard, returned, is_awaited };
        let busy = self
            .table
            .busy()
            .map(|flow| BusyFlow { lacks_keys: lacks_keys && !flow.uses_credit, ..flow });
        let found = self.stalls.handle_timeout(now, peer, busy);
        for (number, why) in found.stalled {
            if let Some(served) = self.table.routes.get_mut(number) {
                served.stalled = true;
            }
            self.events.push(OutboundEvent::Stalled(number, why));
        }
        found.quiet.into_iter().for_each(|id| self.table.flows.set_quiet(id));
    }

    /// Counts the samples that were overwritten in their rings while their flows left them there.
    pub(crate) fn count_overwritten(&mut self) {
        self.table.count_overwritten(&self.counters);
    }

    /// Returns the next event.
    pub(crate) fn poll_event(&mut self) -> Option<OutboundEvent> {
        if self.events.is_empty() { None } else { Some(self.events.remove(0)) }
    }

    /// Returns the samples that wait for the peer.
    pub(crate) fn backlog(&self) -> Backlog {
        self.table.backlog()
    }

    /// Returns whether QUIC has to be given samples or the end of a stream.
    pub(crate) fn has_work(&self) -> bool {
        self.turns.has_work() || self.table.flows.has_ended_streams()
    }
}

/// Ends a stream. Resets it if a sample on it is cut off, so that the sample does not look complete.
fn end(quic: &mut quinn_proto::Connection, stream: StreamId, is_cut: bool) {
    let mut stream = quic.send_stream(stream);
    // Either error means that the stream is over.
    let _ = match is_cut {
        true => stream.reset(VarInt::from_u32(CloseCode::Goodbye.code())).map_err(drop),
        false => stream.finish().map_err(drop),
    };
}
