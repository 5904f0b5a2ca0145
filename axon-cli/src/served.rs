//! Records the subscriptions that a replay served, and what was promised to each.

use std::collections::HashMap;

use axon_transport::{
    Session,
    graph::GraphView,
    ids::Gid,
    qos::{History, Qos, Reliability},
};

use crate::text;

/// The delivery guarantee of a publisher to a subscription.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Promise {
    /// Every message: both are RELIABLE and KEEP_ALL.
    Everything,
    /// The newest messages, up to the depth: both are RELIABLE, and one of them is KEEP_LAST.
    Newest,
    /// Nothing: the subscription or the publisher is BEST_EFFORT.
    Nothing,
}

impl Promise {
    fn of(offered: &Qos, asked: &Qos) -> Self {
        let both = [offered, asked];
        if both.iter().any(|qos| qos.reliability == Reliability::BestEffort) {
            Self::Nothing
        } else if both.iter().all(|qos| qos.history == History::KeepAll) {
            Self::Everything
        } else {
            Self::Newest
        }
    }
}

/// The subscriptions of one publisher when its last message was published.
#[derive(Debug, Default)]
struct Matched {
    gids: Vec<Gid>,
    /// Whether the graph has shown all of these subscriptions.
    is_known: bool,
    keeps_all: bool,
    /// Messages for which a subscription was promised everything.
    kept: u64,
}

/// The subscriptions that received from the publishers of a replay.
#[derive(Debug)]
pub(crate) struct Served {
    offered: Qos,
    matched: Vec<Matched>,
    promises: HashMap<Gid, Promise>,
}

impl Served {
    /// Returns a record without subscriptions, for this number of publishers with the QoS `offered`.
    pub(crate) fn new(offered: Qos, publishers: usize) -> Self {
        let matched = std::iter::repeat_with(Matched::default).take(publishers).collect();
        Self { offered, matched, promises: HashMap::new() }
    }

    /// Records that the next message of this publisher goes to these subscriptions. [`count`](Self::count) counts the
    /// message after it is published.
    pub(crate) fn look(&mut self, session: &Session, publisher: usize, gids: Vec<Gid>) {
        let before = &self.matched[publisher];
        if before.is_known && before.gids == gids {
            return;
        }
        self.learn(publisher, gids, &session.graph());
    }

    fn learn(&mut self, publisher: usize, gids: Vec<Gid>, graph: &GraphView) {
        for gid in &gids {
            if let Some(entry) = graph.endpoints.get(gid) {
                let promise = Promise::of(&self.offered, &entry.endpoint.qos);
                self.promises.insert(*gid, promise);
            }
        }
        let promises = gids.iter().map(|gid| self.promises.get(gid));
        let matched = &mut self.matched[publisher];
        matched.is_known = promises.clone().all(|promise| promise.is_some());
        matched.keeps_all = promises.flatten().any(|promise| *promise == Promise::Everything);
        matched.gids = gids;
    }

    /// Counts the message for which `look` was called, once it is published.
    pub(crate) fn count(&mut self, publisher: usize) {
        let matched = &mut self.matched[publisher];
        matched.kept += u64::from(matched.keeps_all);
    }

    /// Returns the number of this publisher's messages for which a subscription was promised everything.
    pub(crate) fn kept(&self, publisher: usize) -> u64 {
        self.matched[publisher].kept
    }

    /// Describes the subscriptions that were not promised everything. Returns `None` if there were none.
    pub(crate) fn others(&self) -> Option<String> {
        let count = |promise| self.promises.values().filter(|of| **of == promise).count() as u64;
        let (newest, nothing) = (count(Promise::Newest), count(Promise::Nothing));
        let one = |count: u64, one: &str, more: &str| {
            let (subscriptions, verb) =
                if count == 1 { ("subscription", one) } else { ("subscriptions", more) };
            format!("{} {subscriptions} {verb}", text::grouped(count))
        };
        let mut parts = Vec::new();
        if newest > 0 {
            let last = "the last messages only (KEEP_LAST)";
            parts.push(one(newest, &format!("keeps {last}"), &format!("keep {last}")));
        }
        if nothing > 0 {
            parts.push(one(nothing, "is best effort", "are best effort"));
        }
        (!parts.is_empty()).then(|| format!("{}: messages may be missing there", parts.join(", ")))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn everything_is_promised_to_reliable_keep_all_alone() {
        let (all, last, some) = (Qos::keep_all(), Qos::default(), Qos::sensor_data());
        for (offered, asked, promise) in [
            (all, all, Promise::Everything),
            (all, last, Promise::Newest),
            (last, all, Promise::Newest),
            (all, some, Promise::Nothing),
            (some, some, Promise::Nothing),
            (all, all.with_reliability(Reliability::BestEffort), Promise::Nothing),
        ] {
            assert_eq!(Promise::of(&offered, &asked), promise, "{offered:?}, {asked:?}");
        }
    }

    #[test]
    fn subscriptions_that_the_graph_does_not_show_are_promised_nothing_yet() {
        let mut served = Served::new(Qos::keep_all(), 1);
        served.learn(0, vec![Gid([1; 16])], &GraphView::default());
        served.count(0);
        assert!(!served.matched[0].is_known);
        assert_eq!((served.kept(0), served.others()), (0, None));
    }

    #[test]
    fn each_kind_of_subscription_is_named() {
        let mut served = Served::new(Qos::keep_all(), 1);
        let promises = [Promise::Newest, Promise::Nothing, Promise::Nothing, Promise::Everything];
        served.promises = (0..).map(|n| Gid([n; 16])).zip(promises).collect();
        let said = served.others();
        let expected = "1 subscription keeps the last messages only (KEEP_LAST), \
                        2 subscriptions are best effort: messages may be missing there";
        assert_eq!(said.as_deref(), Some(expected));
    }
}
