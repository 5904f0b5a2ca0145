//! The limits on samples between this host and one identity, by topic: `[[limit]]` of the access rules and
//! `max_hz` of `[[topic]]`.

mod egress;
mod flow_queue;
mod interfaces;
mod rate_bucket;

use std::{
    cell::{Cell, RefCell},
    collections::HashMap,
    rc::Rc,
    sync::Arc,
    time::Duration,
};

use axon_shm::ids::Gid;
use axon_transport::{
    access::{Overflow, Permissions, PlacedLimit, RateLimit, Verb},
    config::Config,
    status::{LimitStatus, LinkStatus},
};

pub(crate) use self::{egress::Egress, interfaces::InterfaceLimits};
use self::{egress::EgressCap, flow_queue::FlowQueue, rate_bucket::RateBucket};

/// The most limits that status lists.
const MAX_LISTED_LIMITS: usize = 64;
/// Topics whose limits are remembered while no route has them. Otherwise a route that is requested again, or
/// a new link, would start with a full bucket.
const MAX_IDLE_TOPICS: usize = 1024;
/// The longest time, per flow before it, after which a waiting flow asks again.
const ASK_AGAIN: Duration = Duration::from_millis(20);
/// The name in status of a limit on all topics together.
const ALL_TOPICS: &str = "(all topics)";
/// Characters in status for the topics that share a limit.
const SHOWN: usize = 80;

/// The scope of a limit.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
struct LimitScope {
    verb: Verb,
    topics: Topics,
}

#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
enum Topics {
    One(Arc<str>),
    /// All topics of an entry together; the text lists their names.
    Together(Arc<str>),
}

impl Topics {
    /// Returns the topics as status shows them.
    fn text(&self) -> String {
        match self {
            Self::One(topic) => topic.to_string(),
            Self::Together(names) if &**names == "**" => ALL_TOPICS.to_owned(),
            Self::Together(names) => {
                let cut = names.chars().nth(SHOWN).map_or("", |_| "…");
                format!("({}{cut} together)", names.chars().take(SHOWN).collect::<String>())
            }
        }
    }
}

/// One limit on one topic, or on several together, with counters.
#[derive(Debug)]
pub(crate) struct Limit {
    rate: RateLimit,
    scope: LimitScope,
    /// The place of the limit in the settings.
    place: RefCell<String>,
    /// The cause under which dropped samples are counted.
    cause: &'static str,
    bucket: RefCell<RateBucket>,
    /// The flows that wait for the limit.
    line: RefCell<FlowQueue>,
    passed: Cell<u64>,
    dropped: Cell<u64>,
}

/// The limits of one identity, over all of its daemon IDs and links.
#[derive(Debug, Default)]
pub(crate) struct IdentityLimits {
    uses: RefCell<HashMap<LimitScope, Vec<Rc<Limit>>>>,
    /// The number of topics that were left when limits without a route were last forgotten.
    kept: Cell<usize>,
    egress: RefCell<Vec<Rc<EgressCap>>>,
}

impl IdentityLimits {
    /// Returns the limits on a peer's use of a topic or service. Existing limits keep their fill level.
    pub(crate) fn of(
        &self,
        verb: Verb,
        topic: &str,
        permissions: &Permissions,
        config: &Config,
    ) -> Vec<Rc<Limit>> {
        let placed = permissions.limits(verb, topic);
        let found = placed.map(|placed| {
            let PlacedLimit { limit, names, file, line, .. } = placed;
            let topics = match limit.together {
                true => Topics::Together(Arc::clone(names)),
                false => Topics::One(topic.into()),
            };
            self.find(LimitScope { verb, topics }, limit, "limit", || {
                format!("line {line} of {file}")
            })
        });
        let max_hz = config.topic_limit(topic).filter(|_| verb == Verb::Subscribe).map(|limit| {
            let scope = LimitScope { verb, topics: Topics::One(topic.into()) };
            self.find(scope, &limit, "max_hz", || "max_hz of [[topic]]".into())
        });
        let mut limits: Vec<Rc<Limit>> = Vec::new();
        for limit in found.chain(max_hz) {
            // Two identical entries count once.
            if !limits.iter().any(|other| Rc::ptr_eq(other, &limit)) {
                limits.push(limit);
            }
        }
        limits
    }

    fn find(
        &self,
        scope: LimitScope,
        rate: &RateLimit,
        cause: &'static str,
        place: impl Fn() -> String,
    ) -> Rc<Limit> {
        let mut all = self.uses.borrow_mut();
        let in_use =
            |limits: &Vec<Rc<Limit>>| limits.iter().any(|limit| Rc::strong_count(limit) > 1);
        if all.len() >= MAX_IDLE_TOPICS.max(2 * self.kept.get()) && !all.contains_key(&scope) {
            all.retain(|_, limits| in_use(limits));
            self.kept.set(all.len());
        }
        let limits = all.entry(scope.clone()).or_default();
        if let Some(known) = limits.iter().find(|limit| limit.rate == *rate && limit.cause == cause)
        {
            *known.place.borrow_mut() = place();
            return Rc::clone(known);
        }
        // Limits that are no longer in force are removed.
        limits.retain(|limit| Rc::strong_count(limit) > 1);
        let limit = Rc::new(Limit {
            bucket: RefCell::new(RateBucket::new(rate)),
            line: RefCell::default(),
            rate: rate.clone(),
            scope,
            place: RefCell::new(place()),
            cause,
            passed: Cell::default(),
            dropped: Cell::default(),
        });
        limits.push(Rc::clone(&limit));
        limit
    }

    /// Applies the limits on everything that is sent to the peer to a connection.
    pub(crate) fn limit_egress(&self, egress: &mut Egress, permissions: &Permissions) {
        let mut all = self.egress.borrow_mut();
        let mut caps: Vec<Rc<EgressCap>> = Vec::new();
        for limit in permissions.egress() {
            let known = all.iter().find(|cap| cap.is(limit)).cloned();
            let cap = known.unwrap_or_else(|| Rc::new(EgressCap::of_peer(limit)));
            if !caps.iter().any(|other| Rc::ptr_eq(other, &cap)) {
                caps.push(cap);
            }
        }
        all.clone_from(&caps);
        egress.set_peer(caps);
    }

    /// Adds the limits to the link's status. The limits that dropped the most come first.
    pub(crate) fn fill(&self, status: &mut LinkStatus) {
        let all = self.uses.borrow();
        let in_force = |limit: &&Rc<Limit>| Rc::strong_count(limit) > 1;
        let mut limits: Vec<_> = all.values().flatten().filter(in_force).collect();
        limits.sort_by(|one, other| {
            let key = |of: &Limit| (of.scope.topics.clone(), of.scope.verb);
            other.dropped.cmp(&one.dropped).then_with(|| key(one).cmp(&key(other)))
        });
        status.limits.extend(self.egress.borrow().iter().map(|cap| cap.status()));
        status.more_limits = limits.len().saturating_sub(MAX_LISTED_LIMITS);
        status.limits.extend(limits.iter().take(MAX_LISTED_LIMITS).map(|limit| {
            let mut of = LimitStatus::default();
            of.verb = limit.scope.verb.name().to_owned();
            of.name = limit.scope.topics.text();
            of.limit = limit.rate.to_string();
            of.place.clone_from(&limit.place.borrow());
            (of.passed, of.dropped) = (limit.passed.get(), limit.dropped.get());
            of
        }));
    }
}

/// The limits on one route. Clones share them: [`set`](Self::set) applies to all.
#[derive(Clone, Debug, Default)]
pub(crate) struct RouteLimit(Rc<RefCell<Vec<Rc<Limit>>>>);

/// A limit that the next sample exceeds.
#[derive(Clone, Debug)]
pub(crate) struct Exceeded {
    limit: Rc<Limit>,
    /// Time until the sample may pass.
    pub(crate) wait: Duration,
}

impl Exceeded {
    /// Returns what happens to the sample.
    pub(crate) fn overflow(&self) -> Overflow {
        self.limit.rate.overflow
    }

    /// Returns the cause under which a dropped sample is counted.
    pub(crate) fn cause(&self) -> &'static str {
        self.limit.cause
    }

    /// Counts samples that were dropped because of the limit.
    pub(crate) fn dropped(&self, samples: u64) {
        self.limit.dropped.set(self.limit.dropped.get() + samples);
    }
}

impl RouteLimit {
    /// Creates the limits of a route.
    pub(crate) fn new(limits: Vec<Rc<Limit>>) -> Self {
        Self(Rc::new(RefCell::new(limits)))
    }

    /// Replaces the limits.
    pub(crate) fn set(&self, limits: Vec<Rc<Limit>>) {
        *self.0.borrow_mut() = limits;
    }

    /// Returns whether the route has no limit.
    pub(crate) fn is_none(&self) -> bool {
        self.0.borrow().is_empty()
    }

    /// Returns the limit that the next sample of a flow exceeds. If it exceeds several, the limit that opens
    /// last counts. Flows that wait for a limit pass one after the other. The flow joins that queue if it
    /// `may_wait` for the limit.
    pub(crate) fn exceeded_by(
        &self,
        flow: &Gid,
        may_wait: impl Fn(Overflow) -> bool,
        now: Duration,
    ) -> Option<Exceeded> {
        let limits = self.0.borrow();
        let waits = limits.iter().map(|limit| (limit.wait_of(flow, now), limit));
        let (wait, last) = waits.max_by_key(|(wait, _)| *wait).filter(|(w, _)| !w.is_zero())?;
        for limit in limits.iter() {
            let mut line = limit.line.borrow_mut();
            // Otherwise the flow would keep others from limits that it cannot use yet.
            match Rc::ptr_eq(limit, last) && may_wait(limit.rate.overflow) {
                true => line.wait(flow, now + wait),
                false => line.leave(flow),
            }
        }
        Some(Exceeded { limit: Rc::clone(last), wait })
    }

    /// Returns how many samples of a flow may pass now, if they are as long as the last one.
    pub(crate) fn passes(&self, flow: &Gid, now: Duration) -> usize {
        let limits = self.0.borrow();
        limits.iter().map(|limit| limit.passes(flow, now)).min().unwrap_or(usize::MAX)
    }

    /// Counts a sample of a flow that passes.
    pub(crate) fn pass(&self, flow: &Gid, length: usize, now: Duration) {
        for limit in &*self.0.borrow() {
            limit.bucket.borrow_mut().pass(length, now);
            limit.line.borrow_mut().leave(flow);
            limit.passed.set(limit.passed.get() + 1);
        }
    }
}

impl Limit {
    /// Returns how many samples of a flow may pass in addition to those of the flows before it.
    fn passes(&self, flow: &Gid, now: Duration) -> usize {
        let ahead = self.line.borrow_mut().ahead_of(flow, now);
        self.bucket.borrow().passes(now).saturating_sub(ahead)
    }

    /// Returns how long the next sample of a flow must wait.
    fn wait_of(&self, flow: &Gid, now: Duration) -> Duration {
        if self.passes(flow, now) > 0 {
            return Duration::ZERO;
        }
        let ahead = self.line.borrow_mut().ahead_of(flow, now);
        let ahead = u32::try_from(ahead).unwrap_or(u32::MAX);
        let bucket = self.bucket.borrow();
        // Earlier samples may be shorter than the last one, so the flow asks again in time.
        let turn = bucket.interval().min(ASK_AGAIN).saturating_mul(ahead);
        (bucket.open_at().saturating_sub(now) + turn).max(Duration::from_nanos(1))
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use axon_transport::access::{AccessRules, Principal};

    use super::*;

    const OF: Gid = Gid([1; 16]);

    /// Returns the permissions that rules give a peer.
    pub(crate) fn permissions(rules: &str) -> Permissions {
        AccessRules::parse(rules, "access.toml").unwrap().permissions(Principal::Name("base"))
    }

    /// Returns the limits that the text of a `[[limit]]` sets on a peer's subscriptions to a topic.
    pub(crate) fn limits(text: &str) -> Vec<Rc<Limit>> {
        let rules = format!("[[limit]]\npeer = \"*\"\n{text}");
        IdentityLimits::default().of(
            Verb::Subscribe,
            "/t",
            &permissions(&rules),
            &Config::default(),
        )
    }

    fn of(all: &IdentityLimits, verb: Verb, topic: &str, rules: &str) -> RouteLimit {
        RouteLimit::new(all.of(verb, topic, &permissions(rules), &Config::default()))
    }

    #[test]
    fn each_topic_and_each_direction_has_a_bucket_unless_they_are_together() {
        let each = "[[limit]]\npeer = \"b*\"\ntopic = \"/**\"\nrate = 1\nburst = 1";
        let together = "[[limit]]\npeer = \"b*\"\nrate = 1\nburst = 1";
        for (rules, same) in [(each, false), (together, true)] {
            let all = IdentityLimits::default();
            let one = of(&all, Verb::Publish, "/a", rules);
            one.pass(&OF, 1, Duration::ZERO);
            let is_full = |verb, topic| {
                of(&all, verb, topic, rules).exceeded_by(&OF, |_| false, Duration::ZERO).is_none()
            };
            assert!(!is_full(Verb::Publish, "/a"));
            assert_eq!(is_full(Verb::Publish, "/b"), !same, "{rules}");
            assert!(is_full(Verb::Subscribe, "/a"));
            assert!(is_full(Verb::Call, "/a"), "no limit on calls");
        }
    }

    #[test]
    fn entries_of_other_topics_share_no_bucket_though_their_numbers_are_the_same() {
        let entry = |topics: &str| {
            format!("[[limit]]\npeer = \"b*\"\n{topics}rate = 1\nburst = 1\ntogether = true\n")
        };
        let entries = ["", "topic = [\"/b\", \"/c\"]\n", "topic = \"/d\"\n"].map(entry);
        let rules = entries.concat();
        let all = IdentityLimits::default();
        let limits = |topic| all.of(Verb::Publish, topic, &permissions(&rules), &Config::default());
        let [b, c, d] = ["/b", "/c", "/d"].map(limits);
        assert!(Rc::ptr_eq(&b[0], &c[0]) && Rc::ptr_eq(&b[0], &d[0]), "the entry of all topics");
        assert!(Rc::ptr_eq(&b[1], &c[1]) && !Rc::ptr_eq(&b[1], &d[1]));
        let mut names: Vec<_> = b.iter().chain(&d).map(|limit| limit.scope.topics.text()).collect();
        names.sort();
        names.dedup();
        assert_eq!(names, ["(/b, /c together)", "(/d together)", "(all topics)"]);
        // The same topics in another order are the same entry.
        let turned = rules.replace("\"/b\", \"/c\"", "\"/c\", \"/b\"");
        let again = all.of(Verb::Publish, "/c", &permissions(&turned), &Config::default());
        assert!(Rc::ptr_eq(&again[1], &c[1]), "it stays as full as it is");
        let long = Topics::Together(["/x", &"y".repeat(200)].concat().into()).text();
        assert!(long.ends_with("… together)") && long.chars().count() < 100, "{long}");
    }

    #[test]
    fn every_limit_that_fits_counts_and_the_longest_wait_decides() {
        let rules = "[[limit]]\npeer = \"*\"\ntopic = \"/a\"\nrate = 10\nburst = 1\nover = \"hold\"\n\
                     [[limit]]\npeer = \"*\"\ntopic = \"/**\"\nrate = 2\nburst = 1\nover = \"drop-newest\"";
        let limit = of(&IdentityLimits::default(), Verb::Subscribe, "/a", rules);
        limit.pass(&OF, 1, Duration::ZERO);
        let exceeded = limit.exceeded_by(&OF, |_| false, Duration::ZERO).unwrap();
        assert_eq!(exceeded.overflow(), Overflow::DropNewest);
        assert_eq!(exceeded.wait.as_millis(), 500);
        let at = Duration::from_millis(501);
        assert!(limit.exceeded_by(&OF, |_| false, at).is_none());
        assert_eq!(limit.passes(&OF, at), 1);
    }

    #[test]
    fn a_limit_stays_as_full_as_it_is_when_its_rule_is_read_again() {
        let rules = "[[limit]]\npeer = \"*\"\ntopic = \"/a\"\nrate = 1\nburst = 1";
        let all = IdentityLimits::default();
        let limit = of(&all, Verb::Subscribe, "/a", rules);
        limit.pass(&OF, 1, Duration::ZERO);
        limit.set(all.of(Verb::Subscribe, "/a", &permissions(rules), &Config::default()));
        assert!(limit.exceeded_by(&OF, |_| false, Duration::ZERO).is_some());
        let more = rules.replace("rate = 1\n", "rate = 2\n");
        limit.set(all.of(Verb::Subscribe, "/a", &permissions(&more), &Config::default()));
        assert!(limit.exceeded_by(&OF, |_| false, Duration::ZERO).is_none());
    }

    #[test]
    fn new_route_inherits_the_bucket_of_the_old_one_within_bounded_memory() {
        let rules = "[[limit]]\npeer = \"*\"\ntopic = \"/**\"\nrate = 1\nburst = 1";
        let all = IdentityLimits::default();
        of(&all, Verb::Subscribe, "/a", rules).pass(&OF, 1, Duration::ZERO);
        assert!(
            of(&all, Verb::Subscribe, "/a", rules)
                .exceeded_by(&OF, |_| false, Duration::ZERO)
                .is_some()
        );
        for number in 0..100_000 {
            of(&all, Verb::Subscribe, &format!("/{number}"), rules);
        }
        assert!(all.uses.borrow().len() <= MAX_IDLE_TOPICS, "{}", all.uses.borrow().len());
    }

    #[test]
    fn two_entries_that_say_the_same_count_once() {
        let one = "[[limit]]\npeer = \"*\"\ntopic = \"/a\"\nrate = 10\nburst = 1\n";
        let limit = of(&IdentityLimits::default(), Verb::Subscribe, "/a", &one.repeat(2));
        limit.pass(&OF, 1, Duration::ZERO);
        assert_eq!(
            limit.exceeded_by(&OF, |_| false, Duration::ZERO).unwrap().wait.as_millis(),
            100
        );
    }

    /// Runs flows that share a limit of samples a second for ten seconds. Each flow has a sample every
    /// `every` milliseconds, and asks when it has one and when its turn comes. Returns how many samples of
    /// each flow pass.
    fn share(flows: &[u64], text: &str) -> Vec<u64> {
        let rules = format!("[[limit]]\npeer = \"*\"\ntogether = true\n{text}");
        let all = IdentityLimits::default();
        let limit = of(&all, Verb::Subscribe, "/a", &rules);
        let mut passed = vec![0; flows.len()];
        let mut waits: Vec<Option<Duration>> = vec![None; flows.len()];
        for tick in 0..100_000_u64 {
            let now = Duration::from_micros(100 * tick);
            for (number, every) in flows.iter().enumerate() {
                let comes = tick % (every * 10) == 0;
                if !comes && waits[number].is_none_or(|turn| turn > now) {
                    continue;
                }
                let flow = Gid([number as u8; 16]);
                waits[number] = limit.exceeded_by(&flow, |_| true, now).map(|e| now + e.wait);
                if waits[number].is_none() {
                    limit.pass(&flow, 1, now);
                    passed[number] += 1;
                }
            }
        }
        passed
    }

    #[test]
    fn flows_far_below_a_limit_that_they_share_all_pass() {
        let flows: Vec<_> = [1].into_iter().chain([100; 30]).collect();
        let passed = share(&flows, "topic = \"/**\"\nrate = 100000\nburst = 1000");
        assert_eq!(passed[0], 10_000);
        assert!(passed[1..].iter().all(|one| *one == 100), "{passed:?}");
    }

    #[test]
    fn forty_flows_that_share_a_limit_have_equal_parts_of_it() {
        let passed = share(&[100; 40], "topic = \"/**\"\nrate = 20");
        assert!(passed.iter().all(|one| (4..=6).contains(one)), "{passed:?}");
        let busy: Vec<_> = [1].into_iter().chain([1000; 30]).collect();
        let passed = share(&busy, "topic = \"/**\"\nrate = 500");
        assert!(passed[1..].iter().all(|one| *one == 10), "{passed:?}");
        assert!(passed[0] > 4500, "who waits for nobody has the rest: {passed:?}");
    }

    #[test]
    fn a_flow_that_another_limit_holds_takes_nothing_of_a_limit_that_it_shares() {
        let rules = "[[limit]]\npeer = \"*\"\nsubscribe = \"/**\"\nrate = 100\nburst = 1\ntogether = true\n\
                     [[limit]]\npeer = \"*\"\nsubscribe = \"/imu\"\nrate = 1\nburst = 1";
        let all = IdentityLimits::default();
        let [imu, camera] =
            ["/imu", "/camera"].map(|topic| of(&all, Verb::Subscribe, topic, rules));
        let flows = [1, 2].map(|n| Gid([n; 16]));
        let mut passed = [0, 0];
        for tick in 0..10_000 {
            let now = Duration::from_millis(tick);
            for (number, limit) in [&imu, &camera].into_iter().enumerate() {
                if limit.exceeded_by(&flows[number], |_| true, now).is_none() {
                    limit.pass(&flows[number], 1, now);
                    passed[number] += 1;
                }
            }
        }
        assert!((9..=11).contains(&passed[0]) && passed[1] > 960, "{passed:?}");
    }

    #[test]
    fn status_names_those_first_that_dropped_most() {
        let rules =
            "[[limit]]\npeer = \"*\"\ntopic = \"/**\"\nrate = 1.5\nburst = 1\nbytes = \"4 MB/s\"";
        let all = IdentityLimits::default();
        let routes: Vec<_> =
            (0..70).map(|n| of(&all, Verb::Subscribe, &format!("/{n}"), rules)).collect();
        routes[42].pass(&OF, 1, Duration::ZERO);
        routes[42].exceeded_by(&OF, |_| false, Duration::ZERO).unwrap().dropped(7);
        let mut status = LinkStatus::default();
        all.fill(&mut status);
        assert_eq!((status.limits.len(), status.more_limits), (64, 6));
        let LimitStatus { verb, name, limit, place, passed, dropped, .. } = &status.limits[0];
        assert_eq!((&**verb, &**name, *passed, *dropped), ("subscribe", "/42", 1, 7));
        assert_eq!(limit, "1.5 a second, 4 MB/s, drop-oldest");
        assert_eq!(place, "line 1 of access.toml");
    }
}
