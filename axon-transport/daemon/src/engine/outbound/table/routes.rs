//! The routes that the peer asked for, and the route of each source.

use std::collections::HashMap;

use axon_shm::ids::Gid;

use crate::engine::{
    outbound::{
        served::{FlowRoute, ServedFlows},
        source::Source,
    },
    rank::{FlowId, Priorities},
};

/// The routes of one peer. `by_source` contains exactly the sources of the routes.
#[derive(Default)]
pub(in crate::engine::outbound) struct Routes {
    served: HashMap<u32, ServedFlows>,
    by_source: HashMap<Gid, u32>,
    priorities: Priorities,
}

impl Routes {
    /// Adds a route without sources. An existing route keeps its state.
    pub(in crate::engine::outbound) fn add(&mut self, number: u32, shared: FlowRoute) {
        self.served.entry(number).or_insert_with(|| {
            self.priorities.add(shared.priority);
            ServedFlows::new(shared)
        });
    }

    /// Replaces the sources of a route. `seen` has the newest sample of each publisher that the peer has. Returns the
    /// route, if it exists.
    pub(in crate::engine::outbound) fn set_sources(
        &mut self,
        number: u32,
        sources: Vec<Source>,
        seen: HashMap<Gid, u64>,
    ) -> Option<&ServedFlows> {
        let served = self.served.get_mut(&number)?;
        for gone in &served.sources {
            self.by_source.remove(&gone.gid());
        }
        self.by_source.extend(sources.iter().map(|source| (source.gid(), number)));
        (served.sources, served.seen) = (sources, seen);
        Some(served)
    }

    /// Removes a route with its sources.
    pub(in crate::engine::outbound) fn remove(&mut self, number: u32) -> Option<ServedFlows> {
        let served = self.served.remove(&number)?;
        self.priorities.remove(served.shared.priority);
        for source in &served.sources {
            self.by_source.remove(&source.gid());
        }
        Some(served)
    }

    /// Removes at most `most` KEEP_ALL relays of a route, and the flows that read them.
    pub(in crate::engine::outbound) fn take_kept(
        &mut self,
        number: u32,
        most: usize,
    ) -> (Vec<Source>, Vec<FlowId>) {
        let Some(served) = self.served.get_mut(&number) else { return Default::default() };
        let kept: Vec<_> = served.sources.extract_if(.., |s| s.keeps_all()).take(most).collect();
        for source in &kept {
            self.by_source.remove(&source.gid());
        }
        let read = |of: &Gid| kept.iter().any(|source| source.reads(of));
        let flows = served.flows.extract_if(|of, _| read(of)).map(|(_, id)| id).collect();
        (kept, flows)
    }

    /// Returns a route.
    pub(in crate::engine::outbound) fn get(&self, number: u32) -> Option<&ServedFlows> {
        self.served.get(&number)
    }

    /// Returns a route. The caller must not change its sources.
    pub(in crate::engine::outbound) fn get_mut(&mut self, number: u32) -> Option<&mut ServedFlows> {
        self.served.get_mut(&number)
    }

    /// Returns all routes.
    pub(in crate::engine::outbound) fn values(&self) -> impl Iterator<Item = &ServedFlows> {
        self.served.values()
    }

    /// Returns the route of a source, and the source.
    pub(in crate::engine::outbound) fn of_source(&self, source: &Gid) -> Option<(u32, &Source)> {
        let number = *self.by_source.get(source)?;
        let sources = &self.served.get(&number)?.sources;
        Some((number, sources.iter().find(|other| other.gid() == *source)?))
    }

    /// Returns the route `number`, or the route that reads this publisher if the peer asked for it anew.
    pub(in crate::engine::outbound) fn successor_of(&self, number: u32, publisher: &Gid) -> u32 {
        if self.served.contains_key(&number) {
            return number;
        }
        let found = self.served.iter().find(|(_, served)| served.reads(publisher));
        found.map_or(number, |(other, _)| *other)
    }

    /// Returns the priorities of the routes.
    pub(in crate::engine::outbound) fn priorities(&self) -> Priorities {
        self.priorities
    }
}

#[cfg(test)]
mod tests {
    use axon_shm::qos::Qos;
    use axon_transport::config::TopicPriority;

    use super::*;
    use crate::engine::outbound::model::{ModelRing, route};

    fn gid(number: u8) -> Gid {
        Gid([number; 16])
    }

    /// Returns the source with this GID, which reads `publisher`.
    fn source(number: u8, publisher: u8, qos: Qos) -> Source {
        ModelRing::new(gid(number), gid(publisher)).source(qos)
    }

    fn numbers(sources: &[Source]) -> Vec<Gid> {
        sources.iter().map(Source::gid).collect()
    }

    #[test]
    fn a_source_belongs_to_the_route_that_has_it_now() {
        let mut routes = Routes::default();
        let of = |routes: &Routes, number| routes.of_source(&gid(number)).map(|(route, _)| route);
        let sources = |numbers: &[u8]| {
            numbers.iter().map(|number| source(*number, 9, Qos::default())).collect::<Vec<_>>()
        };
        routes.add(1, route(1, TopicPriority::Normal));
        routes.add(2, route(2, TopicPriority::Normal));
        assert!(routes.set_sources(3, sources(&[5]), HashMap::new()).is_none());
        assert_eq!(of(&routes, 5), None, "there is no such route");
        routes.set_sources(1, sources(&[5, 6]), HashMap::from([(gid(9), 7)]));
        routes.set_sources(2, sources(&[7]), HashMap::new());
        assert_eq!([5, 6, 7].map(|number| of(&routes, number)), [Some(1), Some(1), Some(2)]);
        assert_eq!(routes.of_source(&gid(6)).map(|(_, source)| source.gid()), Some(gid(6)));
        routes.set_sources(1, sources(&[6, 8]), HashMap::new());
        assert_eq!([5, 6, 8].map(|number| of(&routes, number)), [None, Some(1), Some(1)]);
        assert!(routes.get(1).unwrap().seen.is_empty());
        let removed = routes.remove(1).unwrap();
        assert_eq!(numbers(&removed.sources), [gid(6), gid(8)]);
        assert_eq!([6, 7, 8].map(|number| of(&routes, number)), [None, Some(2), None]);
    }

    #[test]
    fn a_route_that_is_asked_for_again_counts_once() {
        let mut routes = Routes::default();
        routes.add(1, route(1, TopicPriority::Low));
        routes.set_sources(1, vec![source(5, 9, Qos::default())], HashMap::new());
        routes.add(1, route(1, TopicPriority::Low));
        assert_eq!(routes.get(1).unwrap().sources.len(), 1);
        routes.add(2, route(2, TopicPriority::Normal));
        assert_eq!(routes.priorities().below(TopicPriority::High), 2);
        assert!(routes.remove(1).is_some() && routes.remove(1).is_none());
        assert_eq!(routes.priorities().below(TopicPriority::High), 1);
    }

    #[test]
    fn kept_relays_leave_with_the_flows_that_read_them() {
        let mut routes = Routes::default();
        routes.add(1, route(1, TopicPriority::Normal));
        let sources = vec![
            source(1, 11, Qos::keep_all()),
            source(2, 12, Qos::default()),
            source(3, 13, Qos::keep_all()),
        ];
        routes.set_sources(1, sources, HashMap::new());
        let flows = &mut routes.get_mut(1).unwrap().flows;
        flows.extend([(gid(11), 0), (gid(12), 1), (gid(13), 2)]);
        let (kept, flows) = routes.take_kept(1, 1);
        assert_eq!((numbers(&kept), flows), (vec![gid(1)], vec![0]));
        assert!(routes.of_source(&gid(1)).is_none() && routes.of_source(&gid(3)).is_some());
        let (kept, flows) = routes.take_kept(1, 5);
        assert_eq!((numbers(&kept), flows), (vec![gid(3)], vec![2]));
        assert_eq!(numbers(&routes.get(1).unwrap().sources), [gid(2)]);
        assert!(routes.take_kept(7, 5).0.is_empty());
    }

    #[test]
    fn a_route_that_ended_is_followed_by_the_one_that_reads_the_publisher() {
        let mut routes = Routes::default();
        for number in [1, 2] {
            routes.add(number, route(number, TopicPriority::Normal));
            let sources = vec![source(number as u8, 10 + number as u8, Qos::default())];
            routes.set_sources(number, sources, HashMap::new());
        }
        assert_eq!(routes.successor_of(1, &gid(12)), 1, "it has not ended");
        routes.remove(1);
        assert_eq!(routes.successor_of(1, &gid(12)), 2);
        assert_eq!(routes.successor_of(1, &gid(11)), 1, "nobody reads it");
    }
}
