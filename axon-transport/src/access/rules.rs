//! The rules of one file.

use std::{fmt, sync::Arc};

use super::{
    Decision, Permissions, Principal, TopicPattern,
    limit::{InterfaceLimit, LimitRule},
    party::{HostPattern, PartyPattern},
    permissions::{Compiled, DefaultDecision, VerbPatterns},
};

/// An action of a party on a topic, a service or a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Verb {
    /// The party publishes samples of a topic to this host.
    Publish,
    /// The party receives samples of a topic from this host.
    Subscribe,
    /// The party answers requests of clients on this host.
    Serve,
    /// The party sends requests to servers on this host.
    Call,
    /// The party sees the nodes of this name, and the endpoints of topics and services of this name. A party that may
    /// publish, subscribe, serve or call also sees the endpoints that it needs for that. A `[[deny]]` of this verb
    /// also denies the uses that no `[[allow]]` names.
    See,
}

impl Verb {
    /// All verbs.
    pub const ALL: [Self; 5] = [Self::Publish, Self::Subscribe, Self::Serve, Self::Call, Self::See];

    /// Returns the name in rules.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Publish => "publish",
            Self::Subscribe => "subscribe",
            Self::Serve => "serve",
            Self::Call => "call",
            Self::See => "see",
        }
    }
}

impl fmt::Display for Verb {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// The access rules of a daemon. By default there are none, and everything is allowed.
#[derive(Clone, Debug, Default)]
pub struct AccessRules {
    pub(super) rules: Option<Arc<RuleFile>>,
    pub(super) limits: Arc<[Arc<LimitRule>]>,
    pub(super) interface_limits: Arc<[InterfaceLimit]>,
}

#[derive(Debug)]
pub(super) struct RuleFile {
    /// The name of the file in decisions.
    pub(super) file: Arc<str>,
    pub(super) denies_by_default: bool,
    pub(super) allow: Vec<Rule>,
    pub(super) deny: Vec<Rule>,
    pub(super) expectations: Vec<Expectation>,
}

/// One `[[allow]]` or `[[deny]]`.
#[derive(Debug)]
pub(super) struct Rule {
    pub(super) peers: Vec<PartyPattern>,
    /// The uses that the rule names, each with its line.
    pub(super) says: Vec<(Verb, TopicPattern, u32)>,
}

/// One `[[expect]]`: the decision that the author of the rules expects.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Expectation {
    /// The party, as [`Principal::parse`] reads it.
    pub peer: String,
    /// The action.
    pub verb: Verb,
    /// The name of the topic, service or node.
    pub name: String,
    /// True if the rules should allow this.
    pub allowed: bool,
    /// The line of the entry.
    pub line: u32,
}

impl Rule {
    fn names(&self, party: Principal<'_>) -> bool {
        self.peers.iter().any(|peer| peer.fits(party))
    }
}

impl AccessRules {
    /// Returns whether no rules allow or deny anything. There may still be [limits](Self::limits_anything).
    pub fn is_empty(&self) -> bool {
        self.rules.is_none()
    }

    /// Returns whether there is a `[[limit]]`.
    pub fn limits_anything(&self) -> bool {
        !self.limits.is_empty() || !self.interface_limits.is_empty()
    }

    /// Returns the limits on the output by network interfaces. Each limit that names an interface applies to it.
    pub fn interface_limits(&self) -> &[InterfaceLimit] {
        &self.interface_limits
    }

    /// Returns the name of the file in decisions, or `None` without rules and limits.
    pub fn file(&self) -> Option<&str> {
        let peers = || self.limits.first().map(|limit| limit.file());
        let interfaces = || self.interface_limits.first().map(|limit| &*limit.limit.file);
        self.rules.as_ref().map(|rules| &*rules.file).or_else(peers).or_else(interfaces)
    }

    /// Returns the permissions of one party. This takes the time of reading all rules once.
    pub fn permissions(&self, party: Principal<'_>) -> Permissions {
        let limits = self.limits.iter().filter(|limit| limit.names(party)).cloned().collect();
        let Some(rules) = &self.rules else { return Permissions::new(None, limits) };
        let (mut allow, mut deny) = (VerbPatterns::default(), VerbPatterns::default());
        let mut is_named = false;
        for rule in rules.allow.iter().filter(|rule| rule.names(party)) {
            is_named = true;
            insert(&mut allow, rule);
        }
        for rule in rules.deny.iter().filter(|rule| rule.names(party)) {
            insert(&mut deny, rule);
        }
        let otherwise = match (is_named, rules.denies_by_default) {
            (true, _) => DefaultDecision::NotAllowed,
            (false, true) => DefaultDecision::DenyByDefault,
            (false, false) => DefaultDecision::Allow,
        };
        let compiled = Compiled { file: Arc::clone(&rules.file), allow, deny, otherwise };
        Permissions::new(Some(compiled), limits)
    }

    /// Decides whether a party may do this with the topic, service or node of this full name, and by which rule. For
    /// more than one decision about a party, use its [`permissions`](Self::permissions).
    pub fn check(&self, party: Principal<'_>, verb: Verb, name: &str) -> Decision {
        self.permissions(party).check(verb, name)
    }

    /// Returns the entries `[[expect]]` of the file.
    pub fn expectations(&self) -> &[Expectation] {
        self.rules.as_ref().map_or(&[], |rules| &rules.expectations)
    }

    /// Returns the hosts that rules and limits name.
    pub(crate) fn hosts(&self) -> impl Iterator<Item = HostPattern<'_>> {
        let rules = self.rules.iter().flat_map(|rules| rules.allow.iter().chain(&rules.deny));
        let limits = self.limits.iter().flat_map(|limit| &limit.peers);
        rules.flat_map(|rule| &rule.peers).chain(limits).filter_map(PartyPattern::host)
    }
}

fn insert(patterns: &mut VerbPatterns, rule: &Rule) {
    for (verb, pattern, line) in &rule.says {
        patterns.of_mut(*verb).insert(pattern, *line);
    }
}
