//! How much of which topic may pass between this host and one identity: `[[limit]]` of the access rules and `max_hz` of
//! `[[topic]]`.

mod bucket;
mod egress;
mod line;

use std::{
    cell::{Cell, RefCell},
    collections::HashMap,
    rc::{Rc, Weak},
    sync::Arc,
    time::Duration,
};

use axon_shm::ids::Gid;
use axon_transport::{
    access::{Over, Permissions, PlacedLimit, RateLimit, Verb},
    config::Config,
    status::{LimitStatus, LinkStatus},
};

pub(crate) use self::egress::Egress;
use self::{bucket::Bucket, egress::EgressCap, line::Line};

/// Limits that status lists.
const LISTED: usize = 64;
/// How status shows the name of a limit of all topics together.
const ALL_TOPICS: &str = "(all topics)";

/// What a limit is about.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
struct Scope {
    verb: Verb,
    /// `None`: all topics together.
    topic: Option<Arc<str>>,
}

/// One limit on one topic, or on several together, and what it let pass.
#[derive(Debug)]
pub(crate) struct Limit {
    rate: RateLimit,
    scope: Scope,
    /// Where it is written.
    place: String,
    /// The cause under which what it drops is counted.
    cause: &'static str,
    bucket: RefCell<Bucket>,
    /// The flows that share it.
    line: RefCell<Line>,
    passed: Cell<u64>,
    dropped: Cell<u64>,
}

/// The limits of one identity, over all of its daemon ids and links.
#[derive(Debug, Default)]
pub(crate) struct Limits {
    uses: RefCell<HashMap<Scope, Vec<Weak<Limit>>>>,
    egress: RefCell<Vec<Weak<EgressCap>>>,
}

impl Limits {
    /// The limits on what a peer does with a topic or service; those that it has already stay as full as they are.
    pub(crate) fn of(
        &self,
        verb: Verb,
        topic: &str,
        permissions: &Permissions,
        config: &Config,
    ) -> Vec<Rc<Limit>> {
        let placed = permissions.limits(verb, topic);
        let mut found: Vec<_> = placed
            .map(|placed| {
                let PlacedLimit { limit, file, line, .. } = placed;
                self.find(verb, topic, limit, "limit", || format!("line {line} of {file}"))
            })
            .collect();
        if verb == Verb::Subscribe
            && let Some(limit) = config.topic_limit(topic)
        {
            found.push(self.find(verb, topic, &limit, "max_hz", || "max_hz of [[topic]]".into()));
        }
        found
    }

    fn find(
        &self,
        verb: Verb,
        topic: &str,
        rate: &RateLimit,
        cause: &'static str,
        place: impl Fn() -> String,
    ) -> Rc<Limit> {
        let topic = (!rate.together).then(|| topic.into());
        let scope = Scope { verb, topic };
        let mut all = self.uses.borrow_mut();
        if !all.contains_key(&scope) && all.len() == all.capacity() {
            // Once for as many as there are.
            all.retain(|_, limits| limits.iter().any(|limit| limit.strong_count() > 0));
        }
        let limits = all.entry(scope.clone()).or_default();
        limits.retain(|limit| limit.strong_count() > 0);
        let place = place();
        let same = |limit: &Rc<Limit>| limit.rate == *rate && limit.place == place;
        if let Some(known) = limits.iter().filter_map(Weak::upgrade).find(same) {
            return known;
        }
        let limit = Rc::new(Limit {
            bucket: RefCell::new(Bucket::new(rate)),
            line: RefCell::default(),
            rate: rate.clone(),
            scope,
            place,
            cause,
            passed: Cell::default(),
            dropped: Cell::default(),
        });
        limits.push(Rc::downgrade(&limit));
        limit
    }

    /// The limits on all that is sent to the peer.
    pub(crate) fn egress(&self, permissions: &Permissions) -> Egress {
        let mut all = self.egress.borrow_mut();
        all.retain(|cap| cap.strong_count() > 0);
        let caps = permissions.egress().map(|limit| {
            if let Some(known) = all.iter().filter_map(Weak::upgrade).find(|cap| cap.is(limit)) {
                return known;
            }
            let cap = Rc::new(EgressCap::new(limit));
            all.push(Rc::downgrade(&cap));
            cap
        });
        Egress::new(caps.collect())
    }

    /// Names the limits in the link's status: those that dropped most come first.
    pub(crate) fn fill(&self, status: &mut LinkStatus) {
        let all = self.uses.borrow();
        let mut limits: Vec<_> = all.values().flatten().filter_map(Weak::upgrade).collect();
        limits.sort_by(|one, other| {
            let key = |of: &Limit| (of.place.clone(), of.scope.topic.clone(), of.scope.verb);
            other.dropped.cmp(&one.dropped).then_with(|| key(one).cmp(&key(other)))
        });
        let egress = self.egress.borrow();
        status.limits.extend(egress.iter().filter_map(Weak::upgrade).map(|cap| cap.status()));
        status.more_limits = limits.len().saturating_sub(LISTED);
        status.limits.extend(limits.iter().take(LISTED).map(|limit| {
            let mut of = LimitStatus::default();
            of.verb = limit.scope.verb.name().to_owned();
            of.name = limit.scope.topic.as_deref().unwrap_or(ALL_TOPICS).to_owned();
            of.limit = limit.rate.to_string();
            of.place.clone_from(&limit.place);
            (of.passed, of.dropped) = (limit.passed.get(), limit.dropped.get());
            of
        }));
    }
}

/// The limits on one route. Its copies are the same: what is [set](Self::set) counts for all.
#[derive(Clone, Debug, Default)]
pub(crate) struct RouteLimit(Rc<RefCell<Vec<Rc<Limit>>>>);

/// The next sample is beyond a limit.
#[derive(Clone, Debug)]
pub(crate) struct Exceeded {
    limit: Rc<Limit>,
    /// How long it is until it may pass.
    pub(crate) wait: Duration,
}

impl Exceeded {
    /// What becomes of it.
    pub(crate) fn over(&self) -> Over {
        self.limit.rate.over
    }

    /// The cause under which it is counted if it is dropped.
    pub(crate) fn cause(&self) -> &'static str {
        self.limit.cause
    }

    /// So many samples were dropped for it.
    pub(crate) fn dropped(&self, samples: u64) {
        self.limit.dropped.set(self.limit.dropped.get() + samples);
    }
}

impl RouteLimit {
    /// With these limits.
    pub(crate) fn new(limits: Vec<Rc<Limit>>) -> Self {
        Self(Rc::new(RefCell::new(limits)))
    }

    /// Replaces the limits.
    pub(crate) fn set(&self, limits: Vec<Rc<Limit>>) {
        *self.0.borrow_mut() = limits;
    }

    /// Whether all samples pass.
    pub(crate) fn is_none(&self) -> bool {
        self.0.borrow().is_empty()
    }

    /// Whether the next sample of this publisher, or client, is beyond a limit. If it is beyond several, the one counts
    /// that it has to wait for longest.
    pub(crate) fn exceeded(&self, of: &Gid, now: Duration) -> Option<Exceeded> {
        let limits = self.0.borrow();
        let open = limits.iter().map(|limit| {
            let behind = limit.line.borrow_mut().behind(of, now);
            (limit.bucket.borrow().open_at() + behind, limit)
        });
        let (at, limit) = open.max_by_key(|(at, _)| *at).filter(|(at, _)| *at > now)?;
        Some(Exceeded { limit: Rc::clone(limit), wait: at - now })
    }

    /// How many samples may pass now, if they are as long as the last one.
    pub(crate) fn passes(&self, now: Duration) -> usize {
        let limits = self.0.borrow();
        limits.iter().map(|limit| limit.bucket.borrow().passes(now)).min().unwrap_or(usize::MAX)
    }

    /// A sample of this publisher, or client, passes.
    pub(crate) fn pass(&self, of: &Gid, length: usize, now: Duration) {
        for limit in &*self.0.borrow() {
            limit.bucket.borrow_mut().pass(length, now);
            limit.line.borrow_mut().pass(of, now);
            limit.passed.set(limit.passed.get() + 1);
        }
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use axon_transport::access::{AccessRules, Party};

    use super::*;

    const OF: Gid = Gid([1; 16]);

    /// The permissions that rules give a peer.
    pub(crate) fn permissions(rules: &str) -> Permissions {
        AccessRules::parse(rules, "access.toml").unwrap().permissions(Party::Name("base"))
    }

    /// The limits that the text of a `[[limit]]` sets on what a peer gets of a topic.
    pub(crate) fn limits(text: &str) -> Vec<Rc<Limit>> {
        let rules = format!("[[limit]]\npeer = \"*\"\n{text}");
        Limits::default().of(Verb::Subscribe, "/t", &permissions(&rules), &Config::default())
    }

    fn of(all: &Limits, verb: Verb, topic: &str, rules: &str) -> RouteLimit {
        RouteLimit::new(all.of(verb, topic, &permissions(rules), &Config::default()))
    }

    #[test]
    fn each_topic_and_each_direction_has_a_bucket_unless_they_are_together() {
        let each = "[[limit]]\npeer = \"b*\"\ntopic = \"/**\"\nrate = 1";
        let together = "[[limit]]\npeer = \"b*\"\nrate = 1";
        for (rules, same) in [(each, false), (together, true)] {
            let all = Limits::default();
            let one = of(&all, Verb::Publish, "/a", rules);
            one.pass(&OF, 1, Duration::ZERO);
            let is_full =
                |verb, topic| of(&all, verb, topic, rules).exceeded(&OF, Duration::ZERO).is_none();
            assert!(!is_full(Verb::Publish, "/a"));
            assert_eq!(is_full(Verb::Publish, "/b"), !same, "{rules}");
            assert!(is_full(Verb::Subscribe, "/a"));
            assert!(is_full(Verb::Call, "/a"), "no limit on calls");
        }
    }

    #[test]
    fn every_limit_that_fits_counts_and_the_longest_wait_decides() {
        let rules = "[[limit]]\npeer = \"*\"\ntopic = \"/a\"\nrate = 10\nover = \"hold\"\n\
                     [[limit]]\npeer = \"*\"\ntopic = \"/**\"\nrate = 2\nover = \"drop-newest\"";
        let limit = of(&Limits::default(), Verb::Subscribe, "/a", rules);
        limit.pass(&OF, 1, Duration::ZERO);
        let exceeded = limit.exceeded(&OF, Duration::ZERO).unwrap();
        assert_eq!(exceeded.over(), Over::DropNewest);
        assert_eq!(exceeded.wait.as_millis(), 500);
        let at = Duration::from_millis(501);
        assert!(limit.exceeded(&OF, at).is_none());
        assert_eq!(limit.passes(at), 1);
    }

    #[test]
    fn a_limit_stays_as_full_as_it_is_when_its_rule_is_read_again() {
        let rules = "[[limit]]\npeer = \"*\"\ntopic = \"/a\"\nrate = 1";
        let all = Limits::default();
        let limit = of(&all, Verb::Subscribe, "/a", rules);
        limit.pass(&OF, 1, Duration::ZERO);
        limit.set(all.of(Verb::Subscribe, "/a", &permissions(rules), &Config::default()));
        assert!(limit.exceeded(&OF, Duration::ZERO).is_some());
        let more = rules.replace("rate = 1", "rate = 2");
        limit.set(all.of(Verb::Subscribe, "/a", &permissions(&more), &Config::default()));
        assert!(limit.exceeded(&OF, Duration::ZERO).is_none());
    }

    #[test]
    fn limits_of_topics_that_are_gone_take_no_memory() {
        let rules = "[[limit]]\npeer = \"*\"\ntopic = \"/**\"\nrate = 1";
        let all = Limits::default();
        for number in 0..10_000 {
            of(&all, Verb::Subscribe, &format!("/{number}"), rules);
        }
        assert!(all.uses.borrow().len() < 100, "{}", all.uses.borrow().len());
    }

    #[test]
    fn status_names_those_first_that_dropped_most() {
        let rules = "[[limit]]\npeer = \"*\"\ntopic = \"/**\"\nrate = 1.5\nbytes = \"4 MB/s\"";
        let all = Limits::default();
        let routes: Vec<_> =
            (0..70).map(|n| of(&all, Verb::Subscribe, &format!("/{n}"), rules)).collect();
        routes[42].pass(&OF, 1, Duration::ZERO);
        routes[42].exceeded(&OF, Duration::ZERO).unwrap().dropped(7);
        let mut status = LinkStatus::default();
        all.fill(&mut status);
        assert_eq!((status.limits.len(), status.more_limits), (64, 6));
        let LimitStatus { verb, name, limit, place, passed, dropped, .. } = &status.limits[0];
        assert_eq!((&**verb, &**name, *passed, *dropped), ("subscribe", "/42", 1, 7));
        assert_eq!(limit, "1.5 a second, 4 MB/s, drop-oldest");
        assert_eq!(place, "line 1 of access.toml");
    }
}
