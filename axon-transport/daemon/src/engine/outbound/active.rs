//! From rings with samples to their flows.

use std::time::Duration;

use axon_shm::{ids::Gid, qos::Qos};

use super::{FlowId, Outbound, Source, flow::Flow};

impl Outbound {
    /// Samples may wait for these sources, each of a writer. Those of other peers are among them.
    pub(crate) fn handle_active(&mut self, active: &[(Gid, Gid)], now: Duration) {
        for (source, writer) in active {
            let Some(number) = self.by_source.get(source).copied() else { continue };
            let Some(served) = self.routes.get(&number) else { continue };
            let found = served.sources.iter().find(|other| other.gid() == *source);
            for of in found.map_or_else(Vec::new, |source| source.with_data_of(writer)) {
                self.take_in(number, of, now);
            }
        }
    }

    /// Looks at all rings of a route.
    pub(super) fn look_for_samples(&mut self, number: u32, now: Duration) {
        let Some(served) = self.routes.get(&number) else { return };
        let mut waiting: Vec<Gid> = served.sources.iter().flat_map(Source::with_data).collect();
        if served.sources.len() > 1 {
            waiting.sort_unstable();
            waiting.dedup();
        }
        waiting.into_iter().for_each(|of| self.take_in(number, of, now));
    }

    /// Samples of a publisher, or client, wait.
    fn take_in(&mut self, number: u32, of: Gid, now: Duration) {
        let Some(id) = self.flow(number, of, now) else { return };
        let (Some(flow), Some(served)) = (&mut self.flows[id], self.routes.get(&number)) else {
            return;
        };
        flow.handle_samples();
        flow.take_burst(&served.sources, &self.counters, now);
        self.note_busy(id, now);
        self.schedule(id);
    }

    /// The flow of a publisher, or client, over a route.
    fn flow(&mut self, number: u32, of: Gid, now: Duration) -> Option<FlowId> {
        let served = self.routes.get_mut(&number)?;
        if let Some(id) = served.flows.get(&of) {
            return Some(*id);
        }
        let first = served.sources.iter().find(|source| source.reads(&of));
        let qos = first.map_or_else(Qos::keep_all, Source::qos);
        let mut flow = Flow::new(of, &served.shared, &qos, &self.budget, now);
        flow.set_sources(&served.sources, served.seen.get(&of).copied());
        let id = match self.free.pop() {
            Some(id) => {
                self.flows[id] = Some(flow);
                id
            }
            None => {
                self.flows.push(Some(flow));
                self.flows.len() - 1
            }
        };
        served.flows.insert(of, id);
        Some(id)
    }
}
