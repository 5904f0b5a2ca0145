//! Models of rings and routes for the tests of the samples to a peer.

use std::{
    cell::{Cell, RefCell},
    collections::{HashMap, VecDeque},
    rc::Rc,
    time::Duration,
};

use axon_envelope::{Kind, Route, TopicHash};
use axon_shm::{ids::Gid, qos::Qos};
use axon_transport::{MessageInfo, config::TopicPriority, internal::session::TakeLimit};
use bytes::Bytes;

use super::{
    budget::Budget,
    flow::{Flow, PeerCredit},
    served::{FlowRoute, ResponseNumbers},
    source::Source,
};
use crate::engine::{limits::RouteLimit, rings::RingReader, route::RelaySpec};

/// The ring of one publisher, with its one reader. It keeps every sample.
pub(super) struct ModelRing {
    reader: Gid,
    publisher: Gid,
    samples: RefCell<VecDeque<(u64, usize)>>,
    pub(super) published: Cell<u64>,
    pub(super) copied: Cell<u64>,
    pub(super) lost: Cell<u64>,
    /// Maximum number of samples that were taken together.
    pub(super) most_together: Cell<usize>,
    /// The number of samples that are published when one is copied, and the number of times.
    pub(super) meanwhile: Cell<(u64, u64)>,
}

impl ModelRing {
    /// Creates the empty ring of `publisher`.
    pub(super) fn new(reader: Gid, publisher: Gid) -> Rc<Self> {
        Rc::new(Self {
            reader,
            publisher,
            samples: RefCell::default(),
            published: Cell::default(),
            copied: Cell::default(),
            lost: Cell::default(),
            most_together: Cell::default(),
            meanwhile: Cell::default(),
        })
    }

    /// Returns its reader as a source with this QoS.
    pub(super) fn source(self: &Rc<Self>, qos: Qos) -> Source {
        let spec =
            RelaySpec { qos, depth: qos.depth, type_hash: Vec::new(), stands_for: Vec::new() };
        Source::Relay(spec, Rc::clone(self) as Rc<dyn RingReader>)
    }

    /// Publishes `samples` samples of this length.
    pub(super) fn publish(&self, samples: u64, length: usize) {
        for _ in 0..samples {
            self.published.set(self.published.get() + 1);
            self.samples.borrow_mut().push_back((self.published.get(), length));
        }
    }
}

impl RingReader for ModelRing {
    fn gid(&self) -> Gid {
        self.reader
    }

    fn with_data(&self) -> Vec<Gid> {
        self.matched()
    }

    fn has_data_of(&self, publisher: &Gid) -> bool {
        self.reads(publisher) && !self.samples.borrow().is_empty()
    }

    fn reads(&self, publisher: &Gid) -> bool {
        *publisher == self.publisher
    }

    fn matched(&self) -> Vec<Gid> {
        vec![self.publisher]
    }

    fn take_many(
        &self,
        publisher: &Gid,
        most: TakeLimit,
        each: &mut dyn FnMut(MessageInfo, Bytes),
    ) -> usize {
        let (mut taken, mut bytes) = (0, 0);
        while taken < most.samples {
            let next = self.samples.borrow().front().copied();
            let fits = |length| taken == 0 || bytes + length <= most.bytes;
            let Some((number, length)) = next.filter(|(_, length)| fits(*length)) else { break };
            self.samples.borrow_mut().pop_front();
            self.copied.set(self.copied.get() + 1);
            (taken, bytes) = (taken + 1, bytes + length);
            let (samples, times) = self.meanwhile.get();
            if times > 0 {
                self.meanwhile.set((samples, times - 1));
                self.publish(samples, length);
            }
            each(MessageInfo::of(*publisher, number), vec![0; length].into());
        }
        self.most_together.set(taken.max(self.most_together.get()));
        taken
    }

    fn retry_of(&self, _publisher: &Gid) -> Option<Duration> {
        (!self.samples.borrow().is_empty()).then_some(Duration::ZERO)
    }

    fn skip_of(&self, _publisher: &Gid, depth: u64) {
        let mut samples = self.samples.borrow_mut();
        let stale = samples.len().saturating_sub(depth as usize);
        samples.drain(..stale);
        self.lost.set(self.lost.get() + stale as u64);
    }

    fn lost_of(&self, _publisher: &Gid) -> u64 {
        self.lost.get()
    }

    fn acknowledge_of(&self, _publisher: &Gid, _sequence: u64) {}

    fn take_back(&self) {}

    fn unacknowledged(&self) -> HashMap<Gid, u64> {
        HashMap::new()
    }

    fn unacknowledged_bytes_of(&self, _publisher: &Gid) -> u64 {
        0
    }

    fn refused_of(&self, _publisher: &Gid) -> Option<u64> {
        None
    }

    fn give_up(&self, _publisher: Gid, _samples: u64) {}

    fn assertions(&self) -> Vec<(Gid, u64)> {
        Vec::new()
    }

    fn set_stands_for(&self, _gids: Vec<Gid>) {}
}

/// Creates a route of a topic whose samples the peer acknowledges.
pub(super) fn route(number: u32, priority: TopicPriority) -> FlowRoute {
    FlowRoute {
        number,
        topic: "/t".into(),
        route: Route { kind: Kind::Topic, topic: TopicHash([0; 16]) },
        priority,
        acknowledged: true,
        short_headers: false,
        compressed: true,
        redundant: true,
        limit: RouteLimit::default(),
        responses: ResponseNumbers::default(),
        credit: PeerCredit::new(),
    }
}

/// Creates a flow without sources, of the publisher with this number, over route 1.
pub(super) fn flow(publisher: u8) -> Flow {
    let (route, budget) = (route(1, TopicPriority::Normal), Budget::new(1 << 20).of_peer());
    Flow::new(Gid([publisher; 16]), &route, &Qos::default(), &budget)
}
