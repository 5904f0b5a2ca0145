//! Converts the expressions of a grant, which are about DDS topics, into rules for topics, services and actions.

use std::collections::BTreeMap;

use axon_transport::{
    access::TopicPattern,
    internal::sros2::names::{TopicPart, TopicUse},
};

use super::{
    document::{Grant, Says},
    names::parts,
    notes::{Effect, Notes},
};
use crate::acl::write::{Names, Uses};

/// The DDS topic on which ROS 2 announces nodes and their endpoints.
const GRAPH: &str = "ros_discovery_info";

/// The rules of a grant.
#[derive(Debug)]
pub(super) struct Rules {
    /// `None` where the grant allows by default.
    pub(super) allow: Option<Uses>,
    pub(super) deny: Uses,
}

/// The patterns of one topic part and direction, and the line of each.
#[derive(Debug, Default)]
struct Patterns {
    lines: BTreeMap<String, u32>,
    /// The patterns that contain a star.
    starred: Vec<TopicPattern>,
}

impl Patterns {
    fn insert(&mut self, pattern: String, line: u32) {
        if pattern.contains('*') && !self.lines.contains_key(&pattern) {
            self.starred.extend(TopicPattern::new(&pattern));
        }
        self.lines.entry(pattern).or_insert(line);
    }

    /// Returns whether these patterns fit each name that `pattern` fits. It may return `false` although they do.
    fn cover(&self, pattern: &str) -> bool {
        self.lines.contains_key(pattern)
            || ["/**", "**"].iter().any(|all| self.lines.contains_key(*all))
            || !pattern.contains('*') && self.starred.iter().any(|starred| starred.fits(pattern))
    }

    /// Returns whether a name may exist that both `pattern` and one of these patterns fit.
    fn overlap(&self, pattern: &str) -> bool {
        if !pattern.contains('*') {
            return self.cover(pattern);
        }
        let Ok(parsed) = TopicPattern::new(pattern) else { return true };
        let before = |text: &str| text.split('*').next().unwrap_or_default().to_owned();
        let start = before(pattern);
        self.lines.keys().any(|other| match other.contains('*') {
            true => {
                let other = before(other);
                other.starts_with(&start) || start.starts_with(&other)
            }
            false => parsed.fits(other),
        })
    }

    fn names(&self) -> Names {
        self.lines.keys().cloned().collect()
    }
}

/// All patterns that allow, or all that deny.
type Sets = BTreeMap<(TopicUse, TopicPart), Patterns>;

/// Returns the rules that are equivalent to a grant. `notes` receives the differences that rules cannot express.
pub(super) fn convert(grant: &Grant, notes: &mut Notes) -> Rules {
    let (mut allowed, mut denied) = (Sets::new(), Sets::new());
    let mut see = Names::new();
    for says in &grant.says {
        if says.expression == GRAPH {
            graph(says, &mut see, notes);
            continue;
        }
        let parts = match parts(&says.expression) {
            Ok(parts) => parts,
            Err(why) => {
                let effect = if says.allows { Effect::Less } else { Effect::More };
                notes.add(effect, says.line, format!("left out {:?}: {why}", says.expression));
                continue;
            }
        };
        if says.allows && says.does == TopicUse::Subscribe && parts.len() > 1 {
            see.insert("**".into());
        }
        for (part, pattern) in
            parts.into_iter().flat_map(|(part, all)| all.into_iter().map(move |one| (part, one)))
        {
            let key = (says.does, part);
            if says.allows {
                allowed.entry(key).or_default().insert(pattern, says.line);
                continue;
            }
            if allowed.get(&key).is_some_and(|before| before.overlap(&pattern)) {
                let what = "a denial behind a rule that allows some of the same: in DDS the first rule that fits \
                            decides, here the denial does";
                notes.add(Effect::Less, says.line, what);
            }
            // The expression `*` also fits names without a leading slash.
            let all = pattern == "/**" && says.expression.bytes().all(|byte| byte == b'*');
            let pattern = if all { "**".to_owned() } else { pattern };
            denied.entry(key).or_default().insert(pattern, says.line);
        }
    }
    let mut deny = uses(&mut denied, false, notes);
    deny.collapse_actions();
    if !deny.is_empty() {
        let what = "what is denied is denied to all enclaves of the host";
        notes.add(Effect::Less, 0, what);
    }
    let allow = (!grant.allows_by_default).then(|| {
        let mut allow = uses(&mut allowed, true, notes);
        allow.see = see;
        allow.collapse_actions();
        allow.collapse_parameters();
        allow
    });
    Rules { allow, deny }
}

/// Converts an expression for the graph, for which AXON has no topic.
fn graph(says: &Says, see: &mut Names, notes: &mut Notes) {
    match (says.allows, says.does) {
        (true, TopicUse::Subscribe) => {
            see.insert("**".into());
            let what = "ros_discovery_info: written as see = \"**\", for all nodes of the graph";
            notes.add(Effect::None, says.line, what);
        }
        (true, TopicUse::Publish) => {
            let what =
                "ros_discovery_info: a peer tells of its endpoints as far as it may use them";
            notes.add(Effect::None, says.line, what);
        }
        (false, _) => {
            let what = "left out ros_discovery_info: AXON has no topic for the graph; see rules say what is shown";
            notes.add(Effect::More, says.line, what);
        }
    }
}

fn uses(sets: &mut Sets, allows: bool, notes: &mut Notes) -> Uses {
    let mut take = |does, part| sets.remove(&(does, part)).unwrap_or_default();
    let (requests, replies) =
        (take(TopicUse::Publish, TopicPart::Request), take(TopicUse::Subscribe, TopicPart::Reply));
    let call = pair("a call", &requests, &replies, allows, notes);
    let (requests, replies) =
        (take(TopicUse::Subscribe, TopicPart::Request), take(TopicUse::Publish, TopicPart::Reply));
    let serve = pair("a server", &requests, &replies, allows, notes);
    Uses {
        publish: take(TopicUse::Publish, TopicPart::Topic).names(),
        subscribe: take(TopicUse::Subscribe, TopicPart::Topic).names(),
        serve,
        call,
        ..Uses::default()
    }
}

/// Returns the services whose requests and responses are both named. For a denial one of the two is enough.
fn pair(
    what: &str,
    requests: &Patterns,
    replies: &Patterns,
    allows: bool,
    notes: &mut Notes,
) -> Names {
    let mut names = Names::new();
    for (all, others, half) in [(requests, replies, "requests"), (replies, requests, "responses")] {
        for (pattern, &line) in &all.lines {
            let whole = others.cover(pattern);
            if !whole {
                let done = if allows { "left out" } else { "the whole is denied" };
                let what = format!("{pattern:?}: of {what} it names the {half} alone: {done}");
                notes.add(Effect::Less, line, what);
            }
            if whole || !allows {
                names.insert(pattern.clone());
            }
        }
    }
    names
}
