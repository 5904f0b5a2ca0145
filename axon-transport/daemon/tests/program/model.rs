//! The expected state of endpoints by the rules of ROS 2 and of AXON's design, and the processes' expected view of it.

use std::collections::{BTreeMap, BTreeSet};

use super::{
    orders::{Call, Described, Kind, Losses, Own, Reported, Sample, Taken},
    rules::same_type,
};

/// Bytes of a publisher's history that each process may keep.
pub(super) const RING: u64 = 8 << 20;
/// Bytes of it that are certainly kept, whatever the lengths of the samples. The real bound is up to the
/// implementation.
const SURE: u64 = RING / 2;

/// A longer sample may be in a segment of its publisher that its readers receive a little later.
const COPIED: u64 = 4096;

/// The model of a node or an endpoint.
pub(super) struct Modelled {
    pub(super) gid: String,
    pub(super) process: usize,
    pub(super) what: Described,
    /// For a publisher: true if its clock is slow by [`SLOW`](super::stage::SLOW); and the samples that it published.
    pub(super) slow: bool,
    pub(super) sequence: u64,
    pub(super) bytes: u64,
    /// The samples that late joiners get, oldest first.
    pub(super) history: BTreeMap<i64, Owed>,
    /// The samples that a subscription has to take, by source time.
    pub(super) owed: BTreeMap<i64, Owed>,
    taken: u64,
    lost: u64,
    expired: u64,
    /// The losses that its event counted when last seen.
    told: u64,
    /// The requests that a server has to answer, or the responses that a client has to take, each with the other end.
    pub(super) calls: BTreeSet<Call>,
    /// The incompatible endpoints that it met, and the reasons of the last one.
    met: Met,
}

/// Counts of everything that an endpoint met since it was created.
#[derive(Default)]
struct Met {
    matched: u64,
    qos: u64,
    policies: BTreeSet<String>,
    types: u64,
}

/// A sample that a subscription has to take.
#[derive(Clone, Debug)]
pub(super) struct Owed {
    pub(super) sample: Sample,
    /// The process of its publisher, and the bytes that the publisher had published before it.
    pub(super) process: usize,
    pub(super) behind: u64,
    /// True if it is too old to be delivered.
    pub(super) expired: bool,
    /// True if its publisher waits rather than let this reader lose it.
    pub(super) held: bool,
}

/// The relation of two endpoints.
#[derive(Debug, PartialEq)]
pub(super) enum Relation {
    None,
    Match,
    /// They would match except for these policies.
    Qos(BTreeSet<String>),
    Type,
}

impl Modelled {
    pub(super) fn new(gid: String, process: usize, what: Described, slow: bool) -> Self {
        let (history, owed) = (BTreeMap::new(), BTreeMap::new());
        let (sequence, bytes, taken, lost, expired, told) = (0, 0, 0, 0, 0, 0);
        let (calls, met) = (BTreeSet::new(), Met::default());
        Self {
            gid,
            process,
            what,
            slow,
            sequence,
            bytes,
            history,
            owed,
            taken,
            lost,
            expired,
            told,
            calls,
            met,
        }
    }

    pub(super) fn is(&self, kind: Kind) -> bool {
        self.what.kind == kind
    }

    pub(super) fn relation(&self, other: &Self) -> Relation {
        let (offers, wants) = match (self.what.kind, other.what.kind) {
            (Kind::Publisher, Kind::Subscription) => (&self.what, &other.what),
            (Kind::Subscription, Kind::Publisher) => (&other.what, &self.what),
            // Servers and clients differ only in how much they keep, so all are compatible.
            (Kind::Server, Kind::Client) | (Kind::Client, Kind::Server) => {
                let same = self.what.topic == other.what.topic;
                return if same { Relation::Match } else { Relation::None };
            }
            _ => return Relation::None,
        };
        if offers.topic != wants.topic {
            return Relation::None;
        }
        if !same_type((&offers.type_name, &offers.hash), (&wants.type_name, &wants.hash)) {
            return Relation::Type;
        }
        let policies = offers.profile.falls_short_of(&wants.profile);
        if policies.is_empty() { Relation::Match } else { Relation::Qos(policies) }
    }

    pub(super) fn matches(&self, other: &Self) -> bool {
        self.relation(other) == Relation::Match
    }

    /// Records that this endpoint and another one found each other. `new` is true if this endpoint was just created:
    /// then any of the endpoints that it finds may be the last one.
    pub(super) fn meet(&mut self, relation: &Relation, new: bool) {
        match relation {
            Relation::None => {}
            Relation::Match => self.met.matched += 1,
            Relation::Type => self.met.types += 1,
            Relation::Qos(policies) => {
                self.met.qos += 1;
                if !new {
                    self.met.policies.clear();
                }
                self.met.policies.extend(policies.iter().cloned());
            }
        }
    }

    /// Returns the state of this endpoint that its process must see, if `matched` are its matches.
    pub(super) fn sees(&self, matched: BTreeSet<String>) -> Own {
        let current = matched.len() as u64;
        let reports = matches!(self.what.kind, Kind::Publisher | Kind::Subscription);
        let alive = if self.is(Kind::Subscription) { current } else { 0 };
        let reported = reports.then(|| Reported {
            ever: self.met.matched,
            current,
            qos: self.met.qos,
            policy: None,
            types: self.met.types,
            // No lease and no deadline is so short that a program misses it.
            alive,
            ..Reported::default()
        });
        Own { matched, reported }
    }

    /// Returns whether the named policy is one of the possible ones.
    pub(super) fn may_name(&self, policy: Option<&String>) -> bool {
        match policy {
            Some(policy) => self.met.policies.contains(policy),
            None => self.met.policies.is_empty(),
        }
    }

    /// Returns whether a wait finds it ready. An expired sample is only found out when it is taken.
    pub(super) fn is_ready(&self) -> bool {
        !self.owed.is_empty() || !self.calls.is_empty()
    }

    fn depth(&self) -> usize {
        self.what.profile.depth.map_or(usize::MAX, |depth| depth as usize)
    }

    /// Adds a sample to a publisher's history for late joiners.
    pub(super) fn keep_history(&mut self, sample: &Owed) {
        self.history.insert(sample.sample.stamp, sample.clone());
        while self.history.len() > self.depth() {
            self.history.pop_first();
        }
    }

    /// Adds a sample that a subscription has to take. It may lose the sample unless the sample is `held` for it.
    pub(super) fn owe(&mut self, sample: &Owed, held: bool) {
        self.owed.insert(sample.sample.stamp, Owed { held, ..sample.clone() });
        while self.owed.len() > self.depth() {
            self.owed.pop_first();
        }
    }

    /// Adds a request of a client, or a response of a server; only the newest are kept.
    pub(super) fn keep_call(&mut self, other: &str, stamp: u64) {
        let of_other = (other.to_owned(), 0)..=(other.to_owned(), u64::MAX);
        self.calls.insert((other.to_owned(), stamp));
        while self.calls.range(of_other.clone()).count() > self.depth() {
            let oldest = self.calls.range(of_other.clone()).next().cloned();
            oldest.map(|oldest| self.calls.remove(&oldest));
        }
    }

    /// Adds the samples that it gets from a publisher that existed before it.
    pub(super) fn join(&mut self, publisher: &Self) {
        let both = [&publisher.what, &self.what].iter().all(|what| what.profile.transient_local);
        if both {
            let stands = self.depth().min(publisher.depth());
            let late: Vec<_> = publisher.history.values().rev().take(stands).cloned().collect();
            let held = publisher.waits_for(self);
            late.iter().for_each(|sample| self.owe(sample, held));
        }
    }

    /// Returns whether this publisher waits for this reader rather than lose its samples.
    pub(super) fn waits_for(&self, reader: &Self) -> bool {
        let both = [&self.what, &reader.what];
        self.process != reader.process
            && both.iter().all(|what| what.profile.reliable && what.profile.depth.is_none())
    }

    /// Returns the bytes of a publisher that it has to take.
    pub(super) fn backlog(&self, publisher: &str) -> u64 {
        let of = self.owed.values().filter(|owed| owed.sample.publisher == publisher);
        of.map(|owed| owed.sample.len).sum()
    }

    /// Returns whether this reader may hold the publisher back.
    pub(super) fn may_hold(&self, publisher: &Self) -> bool {
        publisher.matches(self) && publisher.waits_for(self) && self.backlog(&publisher.gid) >= SURE
    }

    /// Records the losses that its event counts before anything is taken.
    pub(super) fn hear_of(&mut self, losses: Losses) {
        assert!(losses.total > self.told, "{losses:?}");
        assert_eq!(losses.change, losses.total - self.told);
        self.told = losses.total;
    }

    /// Checks the order of samples. Samples of one publisher come by number, samples of several by time. But a
    /// subscription does not wait for a segment of a publisher that its process has not received yet.
    fn assert_order(&self, taken: &[&Sample], due: &[&Owed]) {
        let late = |owed: &&&Owed| owed.process != self.process && owed.sample.len > COPIED;
        let late: BTreeSet<_> =
            due.iter().filter(late).map(|owed| &owed.sample.publisher).collect();
        let mut newest = i64::MIN;
        let mut numbers: BTreeMap<&String, u64> = BTreeMap::new();
        for sample in taken {
            let before = numbers.insert(&sample.publisher, sample.sequence);
            assert!(before < Some(sample.sequence), "after {before:?}: {sample:?} of {taken:?}");
            let in_time = sample.stamp >= newest || late.contains(&sample.publisher);
            assert!(in_time, "after one of {newest}: {sample:?} of {taken:?}");
            newest = newest.max(sample.stamp);
        }
        let mut taken = taken.to_vec();
        taken.sort_by_key(|sample| sample.stamp);
        let due: Vec<&Sample> = due.iter().map(|owed| &owed.sample).collect();
        assert_eq!(taken, due, "what was taken, and what there was to take");
    }

    /// Compares the samples that it took with the samples that it had to take. `published` is the number of bytes that
    /// each publisher has published. Returns the number of lost samples.
    pub(super) fn take(&mut self, taken: &Taken, published: &BTreeMap<String, u64>) -> u64 {
        let owed = std::mem::take(&mut self.owed);
        let mut numbers = taken.samples.iter().map(|(_, number)| *number);
        assert!(numbers.all(|number| {
            self.taken += 1;
            number == self.taken
        }));
        let samples: Vec<&Sample> = taken.samples.iter().map(|(sample, _)| sample).collect();
        let stamps: BTreeSet<i64> = samples.iter().map(|sample| sample.stamp).collect();
        let (expired, fresh): (Vec<_>, Vec<_>) = owed.values().partition(|owed| owed.expired);
        let (come, missing): (Vec<_>, Vec<_>) =
            fresh.into_iter().partition(|owed| stamps.contains(&owed.sample.stamp));
        self.assert_order(&samples, &come);
        for lost in &missing {
            assert!(self.what.profile.depth.is_none(), "what is within a depth stands: {lost:?}");
            assert!(!lost.held, "its publisher was to wait for it: {lost:?}");
            let publisher = &lost.sample.publisher;
            let since = published[publisher] - lost.behind;
            assert!(since > SURE, "lost, though only {since} bytes came since: {lost:?}");
            let before = |sample: &Sample| {
                sample.publisher == *publisher && sample.sequence < lost.sample.sequence
            };
            assert!(!samples.iter().any(|sample| before(sample)), "older ones stood: {lost:?}");
        }
        self.expired += expired.len() as u64;
        assert_eq!(taken.expired, self.expired, "too old");
        let lost = missing.len() as u64;
        self.lost += lost;
        let Losses { total, change } = taken.losses;
        assert_eq!((taken.lost, total), (self.lost, self.lost), "lost");
        assert_eq!(change, total - self.told);
        self.told = total;
        lost
    }
}
