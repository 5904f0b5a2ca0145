//! A route that the peer asked for, and the reports to its sources.

use std::{cell::Cell, collections::HashMap, rc::Rc, sync::Arc, time::Duration};

use axon_envelope::{Kind, Route};
use axon_shm::{
    ids::Gid,
    qos::{History, Reliability},
};
use axon_transport::config::TopicPriority;

use super::{
    flow::PeerCredit,
    source::{FlowProgress, Source},
    unfinished::UnfinishedFlows,
};
use crate::engine::limits::RouteLimit;
use crate::engine::rank::FlowId;

/// A route that the peer asked for.
pub(crate) struct RouteOut {
    /// The topic's name.
    pub(crate) topic: Arc<str>,
    /// Topic and kind, for the envelope.
    pub(crate) route: Route,
    /// The priority of the topic.
    pub(crate) priority: TopicPriority,
    /// True if the peer acknowledges the samples.
    pub(crate) acknowledged: bool,
    /// True if the peer reads short headers.
    pub(crate) short_headers: bool,
    /// True if its samples may be compressed.
    pub(crate) compressed: bool,
    /// True if small samples may cross both paths.
    pub(crate) redundant: bool,
    /// The limits on the route's samples to the peer.
    pub(crate) limit: RouteLimit,
    /// The sources of its samples.
    pub(crate) sources: Vec<Source>,
    /// The newest sample of each publisher that the peer has already.
    pub(crate) seen: HashMap<Gid, u64>,
    /// The flows of an earlier daemon of the peer's host that continue.
    pub(crate) unfinished: UnfinishedFlows,
}

/// The parts of a route that its flows share.
pub(super) struct FlowRoute {
    pub(super) number: u32,
    pub(super) topic: Arc<str>,
    pub(super) route: Route,
    pub(super) priority: TopicPriority,
    pub(super) acknowledged: bool,
    pub(super) short_headers: bool,
    pub(super) compressed: bool,
    pub(super) redundant: bool,
    pub(super) limit: RouteLimit,
    pub(super) responses: ResponseNumbers,
    pub(super) credit: Rc<PeerCredit>,
}

/// Numbers the responses of this daemon in the order in which they are taken. A flow that ends and begins again, or the
/// flow of the next link, continues with higher numbers, so no peer mistakes a response for one that it has.
#[derive(Clone, Debug, Default)]
pub(crate) struct ResponseNumbers(Rc<Cell<u64>>);

impl ResponseNumbers {
    /// Returns the next number.
    pub(super) fn next(&self) -> u64 {
        self.0.set(self.0.get() + 1);
        self.0.get()
    }
}

/// A route and its flows.
pub(super) struct ServedFlows {
    pub(super) shared: FlowRoute,
    /// True if its peer is known not to read the route.
    pub(super) stalled: bool,
    pub(super) sources: Vec<Source>,
    pub(super) seen: HashMap<Gid, u64>,
    pub(super) flows: HashMap<Gid, FlowId>,
}

impl ServedFlows {
    /// Creates a route without sources.
    pub(super) fn new(shared: FlowRoute) -> Self {
        Self {
            shared,
            stalled: false,
            sources: Vec::new(),
            seen: HashMap::new(),
            flows: HashMap::new(),
        }
    }

    /// Returns whether it belongs to a service.
    pub(super) fn is_service(&self) -> bool {
        self.shared.route.kind != Kind::Topic
    }

    /// Returns the first source that reads this publisher or client.
    pub(super) fn source_of(&self, of: &Gid) -> Option<&Source> {
        self.sources.iter().find(|source| source.reads(of))
    }

    /// Returns whether a source reads this publisher or client.
    pub(super) fn reads(&self, of: &Gid) -> bool {
        self.source_of(of).is_some()
    }

    /// Returns whether samples of this publisher count until they are acknowledged.
    pub(super) fn is_reliable(&self, of: &Gid) -> bool {
        self.source_of(of).is_some_and(|s| s.qos().reliability == Reliability::Reliable)
    }

    /// Returns the number of samples that KEEP_ALL relays make a publisher keep, or of calls that a stand-in makes a
    /// client keep, if there are any.
    pub(super) fn keeps(&self, of: &Gid) -> Option<u64> {
        self.keeping(of).filter_map(|source| source.kept_of(of)).max()
    }

    /// Returns how many publishes of a publisher found no space, if a KEEP_ALL relay may be the reason for the next
    /// one; for calls, the same.
    pub(super) fn refused(&self, of: &Gid) -> Option<u64> {
        self.keeping(of).filter_map(|source| source.refused_of(of)).max()
    }

    fn keeping(&self, of: &Gid) -> impl Iterator<Item = &Source> {
        let keeping = |source: &&Source| source.qos().history == History::KeepAll;
        self.sources.iter().filter(keeping).filter(|source| source.reads(of))
    }

    /// Returns the publishers, or clients, that have samples to take, each once.
    pub(super) fn with_data(&self) -> Vec<Gid> {
        let mut waiting: Vec<Gid> = self.sources.iter().flat_map(Source::with_data).collect();
        if self.sources.len() > 1 {
            waiting.sort_unstable();
            waiting.dedup();
        }
        waiting
    }

    /// Reports to the sources up to which number they may forget the samples of a publisher.
    pub(super) fn done(&self, of: Gid, FlowProgress { sequence, given_up }: FlowProgress) {
        if given_up > 0
            && let Some(source) = self.source_of(&of)
        {
            source.give_up(of, given_up);
        }
        let Some(sequence) = sequence else { return };
        for source in self.sources.iter().filter(|source| source.reads(&of)) {
            source.acknowledge_of(&of, sequence);
        }
    }

    /// Returns the number of unacknowledged RELIABLE samples, by publisher.
    pub(super) fn unacknowledged(&self) -> HashMap<Gid, u64> {
        let mut most = HashMap::new();
        for (of, samples) in self.sources.iter().flat_map(Source::unacknowledged) {
            let known: &mut u64 = most.entry(of).or_default();
            *known = samples.max(*known);
        }
        most
    }

    /// Returns the bytes of its ring that the unacknowledged samples of this publisher take.
    pub(super) fn unacknowledged_bytes_of(&self, of: &Gid) -> u64 {
        let of = self.sources.iter().map(|source| source.unacknowledged_bytes_of(of));
        of.max().unwrap_or(0)
    }

    /// Gives up all samples of a publisher that ended. Returns the number of samples in a ring.
    pub(super) fn give_up_ended(&self, of: &Gid) -> u64 {
        let mut most = 0;
        for source in self.sources.iter().filter(|source| source.reads(of)) {
            // Its remaining samples are not sent any more.
            let taken = std::iter::from_fn(|| source.take_of(of, Duration::ZERO)).count();
            source.acknowledge_of(of, u64::MAX);
            most = most.max(taken as u64);
        }
        most
    }

    /// Reports the undeliverable samples to the publishers. Returns their number.
    pub(super) fn give_up(&self) -> u64 {
        let mut all = 0;
        for (of, samples) in self.unacknowledged() {
            all += samples;
            let source = self.sources.iter().find(|source| source.has_unacknowledged(&of));
            if let Some(source) = source {
                source.give_up(of, samples);
            }
        }
        all
    }
}
