//! The routes with their flows. A flow exists as long as its route names it.

mod flows;
mod routes;

use std::{collections::HashMap, rc::Rc, sync::Arc};

use axon_shm::{ids::Gid, qos::Qos};

pub(super) use self::flows::Flows;
use self::routes::Routes;
use super::{
    backlog::Backlog, budget::Budget, drains::DrainedFlow, flow::Flow, progress::SentProgress,
    served::ServedFlows, source::Source, stall::BusyFlow,
};
use crate::engine::counters::Counters;
use crate::engine::rank::FlowId;

/// The routes and flows of one peer. If a method returns the numbers of flows that are gone, the caller forgets them
/// before another flow gets one of the numbers.
#[derive(Default)]
pub(super) struct FlowTable {
    pub(super) routes: Routes,
    pub(super) flows: Flows,
}

/// The flows of a route whose sources changed.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct Changed {
    /// Flows that are gone: no source reads them, and none of their samples is left.
    pub(super) gone: Vec<FlowId>,
    /// All other flows.
    pub(super) stay: Vec<FlowId>,
}

impl FlowTable {
    /// Returns a flow with its route.
    pub(super) fn get_mut(&mut self, id: FlowId) -> Option<(&mut Flow, &ServedFlows)> {
        let flow = self.flows.get_mut(id)?;
        let served = self.routes.get(flow.info.route_number)?;
        Some((flow, served))
    }

    /// Returns the flow of a publisher, or client, over a route.
    pub(super) fn find(&self, number: u32, of: &Gid) -> Option<FlowId> {
        self.routes.get(number)?.flows.get(of).copied()
    }

    /// Like [`find`](Self::find), but creates the flow if it does not exist.
    pub(super) fn find_or_insert(
        &mut self,
        number: u32,
        of: Gid,
        budget: &Rc<Budget>,
    ) -> Option<FlowId> {
        let served = self.routes.get_mut(number)?;
        if let Some(id) = served.flows.get(&of) {
            return Some(*id);
        }
        let qos = served.source_of(&of).map_or_else(Qos::keep_all, Source::qos);
        let mut flow = Flow::new(of, &served.shared, &qos, budget);
        flow.set_sources(&served.sources, served.seen.get(&of).copied());
        let id = self.flows.insert(flow);
        served.flows.insert(of, id);
        Some(id)
    }

    /// Removes a flow. Returns its number.
    pub(super) fn remove(&mut self, number: u32, of: &Gid) -> Option<FlowId> {
        let id = self.routes.get_mut(number)?.flows.remove(of)?;
        self.flows.remove(id);
        Some(id)
    }

    /// Replaces the sources of a route. `seen` has the newest sample of each publisher that the peer has.
    pub(super) fn set_sources(
        &mut self,
        number: u32,
        sources: Vec<Source>,
        seen: HashMap<Gid, u64>,
    ) -> Changed {
        let mut changed = Changed::default();
        let Some(served) = self.routes.set_sources(number, sources, seen) else { return changed };
        let mut unread = Vec::new();
        for (of, id) in &served.flows {
            let Some(flow) = self.flows.get_mut(*id) else { continue };
            flow.set_sources(&served.sources, served.seen.get(of).copied());
            if flow.is_idle() && !served.reads(of) {
                unread.push(*of);
            } else {
                changed.stay.push(*id);
            }
        }
        changed.gone.extend(unread.iter().filter_map(|of| self.remove(number, of)));
        changed
    }

    /// Removes a route. Returns its flows, which are gone.
    pub(super) fn remove_route(&mut self, number: u32) -> Vec<FlowId> {
        let Some(served) = self.routes.remove(number) else { return Vec::new() };
        let gone: Vec<_> = served.flows.into_values().collect();
        for id in &gone {
            self.flows.remove(*id);
        }
        gone
    }

    /// Gives up the unacknowledged samples of a route. Returns their number.
    pub(super) fn give_up(&mut self, number: u32, counters: &Counters) -> u64 {
        let Some(served) = self.routes.get(number) else { return 0 };
        let mut calls = 0;
        for (of, id) in &served.flows {
            if let Some(flow) = self.flows.get_mut(*id) {
                flow.give_up();
                if served.is_service() {
                    calls += flow.end(counters) + served.keeps(of).unwrap_or(0);
                }
            }
        }
        calls + served.give_up()
    }

    /// Removes at most `most` KEEP_ALL relays of a route. Returns them, and the flows that read them, which are gone.
    pub(super) fn take_kept(&mut self, number: u32, most: usize) -> (Vec<Source>, Vec<FlowId>) {
        let (kept, gone) = self.routes.take_kept(number, most);
        for id in &gone {
            self.flows.remove(*id);
        }
        (kept, gone)
    }

    /// Returns whether BEST_EFFORT samples of a publisher wait for a limit.
    pub(super) fn holds_best_effort(&self, number: u32, of: &Gid) -> bool {
        let flow = self.find(number, of).and_then(|id| self.flows.get(id));
        flow.is_some_and(Flow::holds_best_effort)
    }

    /// Returns the rest of a publisher that ended, whose route had this number. While the link `starves`, no flow that
    /// waits for others is excused.
    pub(super) fn left_of(&self, number: u32, of: &Gid, starves: bool) -> Option<DrainedFlow> {
        let route = self.routes.successor_of(number, of);
        let flow = self.find(route, of).and_then(|id| self.flows.get(id));
        let (samples, progress) = match self.routes.get(route)?.unacknowledged().get(of) {
            Some(samples) => (*samples, flow.map_or((0, 0), Flow::progress)),
            None => flow.and_then(Flow::best_effort_left).map(|(left, sent)| (left, (sent, 0)))?,
        };
        let is_excused = !starves && flow.is_some_and(Flow::waits_for_others);
        Some(DrainedFlow { route, samples, progress, is_excused })
    }

    /// Returns the bytes of its ring that the unacknowledged samples of a publisher take.
    pub(super) fn bytes_left_of(&self, number: u32, of: &Gid) -> u64 {
        self.routes.get(number).map_or(0, |served| served.unacknowledged_bytes_of(of))
    }

    /// Returns the flows with unacknowledged samples.
    pub(super) fn busy(&self) -> impl Iterator<Item = BusyFlow> {
        self.flows.busy().filter_map(|(id, flow)| {
            Some(busy_flow(id, flow, self.routes.get(flow.info.route_number)?))
        })
    }

    /// Returns the flows of a route whose samples KEEP_ALL relays keep, by publisher, with how far QUIC took the
    /// samples.
    pub(super) fn kept_flows(&self, number: u32) -> Vec<(Gid, BusyFlow, SentProgress)> {
        let Some(served) = self.routes.get(number) else { return Vec::new() };
        let flows = served.flows.iter().filter_map(|(of, id)| {
            let flow = self.flows.get(*id)?;
            Some((*of, busy_flow(*id, flow, served), flow.sent_progress()))
        });
        flows.filter(|(_, flow, _)| flow.keeps.is_some()).collect()
    }

    /// Counts the samples that were overwritten in their rings while their flows left them there.
    pub(super) fn count_overwritten(&mut self, counters: &Counters) {
        self.flows.for_each_busy(|flow| {
            if flow.rank().is_some()
                && let Some(served) = self.routes.get(flow.info.route_number)
            {
                flow.count_overwritten(&served.sources, counters);
            }
        });
    }

    /// Returns the samples that wait for the peer.
    pub(super) fn backlog(&self) -> Backlog {
        let mut backlog = Backlog::default();
        for (_, flow) in self.flows.busy() {
            if let Some((class, bytes)) = flow.waiting() {
                backlog.bytes[class as usize] += bytes;
            }
            backlog.oldest = [backlog.oldest, flow.oldest()].into_iter().flatten().min();
        }
        backlog
    }

    /// Handles the end of the link if no other link carries the flows: counts the samples that did not arrive, and
    /// reports them to the publishers. Returns the losses by topic.
    pub(super) fn link_over(&mut self, counters: &Counters) -> Vec<(Arc<str>, u64)> {
        let mut losses = Vec::new();
        for served in self.routes.values() {
            let mut unsent = 0;
            for (of, id) in &served.flows {
                let Some(flow) = self.flows.get_mut(*id) else { continue };
                let left = flow.end(counters);
                // A RELIABLE sample of a topic counts until it is acknowledged.
                if served.is_service() || !served.is_reliable(of) {
                    unsent += left;
                }
            }
            let topic = &served.shared.topic;
            let lost = if served.is_service() {
                unsent
            } else {
                counters.lost(topic, "no_link", unsent);
                served.give_up()
            };
            if lost > 0 {
                counters.lost(topic, "link_ended", lost);
                losses.push((Arc::clone(topic), lost));
            }
        }
        losses
    }
}

fn busy_flow(id: FlowId, flow: &Flow, served: &ServedFlows) -> BusyFlow {
    BusyFlow {
        id,
        route: flow.info.route_number,
        is_stalled: served.stalled,
        progress: flow.progress(),
        keeps: served.keeps(&flow.info.of),
        refused: served.refused(&flow.info.of),
        is_service: served.is_service(),
        uses_credit: flow.uses_credit(),
        waits_for_others: flow.waits_for_others(),
        waits_for_limit: flow.waits_for_limit(),
        lacks_keys: false,
        is_quiet: flow.is_quiet(),
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use axon_transport::config::TopicPriority;

    use super::*;
    use crate::engine::outbound::model::{ModelRing, route};

    const NOW: Duration = Duration::ZERO;

    fn gid(number: u8) -> Gid {
        Gid([number; 16])
    }

    /// Creates a table with route 1, which reads the rings of publishers 11 and 12, and two rings.
    struct Fixture {
        table: FlowTable,
        rings: [Rc<ModelRing>; 2],
        budget: Rc<Budget>,
        counters: Counters,
    }

    impl Fixture {
        fn new(qos: Qos) -> Self {
            let rings = [1, 2].map(|number| ModelRing::new(gid(number), gid(10 + number)));
            let mut table = FlowTable::default();
            table.routes.add(1, route(1, TopicPriority::Normal));
            let sources = rings.iter().map(|ring| ring.source(qos)).collect();
            assert_eq!(table.set_sources(1, sources, HashMap::new()), Changed::default());
            let budget = Budget::new(1 << 20).of_peer();
            Self { table, rings, budget, counters: Counters::default() }
        }

        fn flow(&mut self, publisher: u8) -> FlowId {
            self.table.find_or_insert(1, gid(publisher), &self.budget).unwrap()
        }

        /// Makes the flow take all samples from its ring, as a burst.
        fn fill(&mut self, id: FlowId) {
            let (flow, served) = self.table.get_mut(id).unwrap();
            flow.handle_samples();
            flow.blocked = true;
            flow.take_burst(&served.sources, &self.counters, NOW);
        }

        fn set_sources(&mut self, rings: &[usize]) -> Changed {
            let sources = rings.iter().map(|at| self.rings[*at].source(Qos::default()));
            self.table.set_sources(1, sources.collect(), HashMap::new())
        }
    }

    #[test]
    fn a_publisher_has_one_flow_over_a_route() {
        let mut of = Fixture::new(Qos::default());
        assert_eq!((of.flow(11), of.flow(12), of.flow(11)), (0, 1, 0));
        assert_eq!((of.table.find(1, &gid(12)), of.table.find(1, &gid(13))), (Some(1), None));
        assert_eq!(of.table.find_or_insert(2, gid(11), &of.budget), None, "no such route");
        assert_eq!((of.table.remove(1, &gid(11)), of.table.remove(1, &gid(11))), (Some(0), None));
        assert_eq!((of.table.find(1, &gid(11)), of.flow(13)), (None, 0));
    }

    #[test]
    fn an_idle_flow_is_gone_with_its_source_and_one_with_samples_stays() {
        let mut of = Fixture::new(Qos::default());
        let flows = [of.flow(11), of.flow(12)];
        of.rings[1].publish(1, 100);
        of.fill(flows[1]);
        let changed = of.set_sources(&[]);
        assert_eq!(changed, Changed { gone: vec![0], stay: vec![1] });
        assert!(of.table.get_mut(0).is_none() && of.table.get_mut(1).is_some());
        assert_eq!(of.set_sources(&[0]), Changed { gone: vec![], stay: vec![1] });
    }

    #[test]
    fn the_flows_of_a_route_end_with_it() {
        let mut of = Fixture::new(Qos::default());
        of.flow(11);
        of.flow(12);
        let mut gone = of.table.remove_route(1);
        gone.sort_unstable();
        assert_eq!(gone, [0, 1]);
        assert!(of.table.flows.ids().is_empty() && of.table.remove_route(1).is_empty());
    }

    #[test]
    fn flows_of_kept_relays_are_gone() {
        let mut of = Fixture::new(Qos::keep_all());
        of.flow(11);
        of.flow(12);
        let (kept, gone) = of.table.take_kept(1, 1);
        assert_eq!((kept.len(), gone), (1, vec![0]));
        assert_eq!(of.table.flows.ids(), [1]);
    }

    #[test]
    fn the_backlog_counts_busy_flows_only() {
        let mut of = Fixture::new(Qos::default());
        let flow = of.flow(11);
        of.rings[0].publish(3, 100);
        of.fill(flow);
        assert_eq!(of.table.backlog(), Backlog::default());
        of.table.flows.set_busy(flow);
        let backlog = of.table.backlog();
        assert!(backlog.bytes.iter().sum::<usize>() >= 300 && backlog.oldest == Some(NOW));
        let busy: Vec<_> = of.table.busy().map(|flow| (flow.id, flow.is_quiet)).collect();
        assert_eq!(busy, [(flow, false)]);
    }

    #[test]
    fn unsent_samples_end_with_the_link_unless_the_publisher_keeps_them() {
        for (qos, lost) in [(Qos::sensor_data(), 2), (Qos::keep_all(), 0)] {
            let mut of = Fixture::new(qos);
            let flow = of.flow(11);
            of.rings[0].publish(2, 100);
            let (counters, now) = (Counters::default(), NOW);
            of.table.flows.set_busy(flow);
            let (state, served) = of.table.get_mut(flow).unwrap();
            state.handle_samples();
            state.fill(&served.sources, &counters, now);
            // The ring of the test counts none as unacknowledged.
            assert!(of.table.link_over(&counters).is_empty());
            let losses: u64 = counters.take_lost().iter().map(|loss| loss.samples).sum();
            assert_eq!(losses, lost, "{qos:?}");
        }
    }
}
