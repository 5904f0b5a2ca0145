//! Records what other hosts and users did with topics and services of this host, and writes the rules that allow it.

use std::{
    collections::{BTreeMap, BTreeSet, HashMap},
    fmt::Write as _,
};

use axon_transport::{
    access::{Principal, TopicPattern, Verb},
    internal::graph::other_end,
};

use crate::{
    acl::write::{Uses, quoted, verify},
    text::printable,
};

/// The most lines of each kind in a comment.
const LISTED: usize = 100;

/// The most `[[expect]]` in a rules file.
const MOST_EXPECTATIONS: usize = 4096;

/// The use of a topic or service by a host or user.
pub(super) type Use = (Verb, String);

/// The owner of an endpoint.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Owner<'a> {
    /// The daemon's user. No rule applies to this user.
    Own,
    /// Another user of this host.
    User(u32),
    /// Another host, by the name that rules have for it.
    Host(&'a str),
}

/// An endpoint at the time of an observation.
#[derive(Clone, Copy, Debug)]
pub(super) struct Observed<'a> {
    pub(super) owner: Owner<'a>,
    /// The bytes that the GIDs of all endpoints of a session share.
    pub(super) session: [u8; 12],
    pub(super) verb: Verb,
    pub(super) name: &'a str,
}

/// The name of a host or user. The name of a host may mean something else in a rule.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Name {
    Host(String),
    User(u32),
}

impl Name {
    /// Returns the name as a rule writes it in `peer`.
    fn text(&self) -> String {
        match self {
            Self::Host(name) => name.clone(),
            Self::User(uid) => format!("uid:{uid}"),
        }
    }

    /// Returns whether a rule can name this host or user and nobody else.
    fn is_sayable(&self) -> bool {
        let text = self.text();
        let is = match Principal::parse(&text) {
            Ok(Principal::User(_)) => matches!(self, Self::User(_)),
            Ok(_) => matches!(self, Self::Host(_)),
            Err(_) => false,
        };
        is && verify(&Uses::default().toml("allow", &text)).is_ok()
    }
}

/// What one host or user did.
#[derive(Debug, Default)]
struct PartySeen {
    /// Uses for which an endpoint of this host was at the other end.
    used: BTreeSet<Use>,
    /// Uses for which no endpoint of this host was at the other end.
    alone: BTreeSet<Use>,
    /// Uses that the rules in force deny, each with the reason.
    denied: BTreeMap<Use, String>,
    /// The number of denied uses that the status does not list.
    more_denied: usize,
}

/// All observations so far.
#[derive(Debug, Default)]
pub(super) struct Seen {
    parties: BTreeMap<Name, PartySeen>,
}

impl Seen {
    /// Returns the number of hosts and users, and the number of their uses.
    pub(super) fn counts(&self) -> (usize, usize) {
        (self.parties.len(), self.parties.values().map(|seen| seen.used.len()).sum())
    }

    /// Returns whether no use was observed that a rule could concern.
    pub(super) fn is_empty(&self) -> bool {
        self.parties.values().all(|seen| seen.used.is_empty() && seen.denied.is_empty())
    }

    /// Records all endpoints that exist at one time.
    pub(super) fn observe(&mut self, all: &[Observed<'_>]) {
        let mut ends: HashMap<(Verb, &str), Vec<&Observed<'_>>> = HashMap::new();
        for end in all {
            ends.entry((end.verb, end.name)).or_default().push(end);
        }
        for end in all {
            let party = match end.owner {
                Owner::Own => continue,
                Owner::User(uid) => Name::User(uid),
                Owner::Host(name) => Name::Host(name.to_owned()),
            };
            let others = ends.get(&(other_end(end.verb), end.name));
            let meets = others.into_iter().flatten().any(|other| meet(end, other));
            let seen = self.parties.entry(party).or_default();
            let used = (end.verb, end.name.to_owned());
            if meets {
                seen.alone.remove(&used);
                seen.used.insert(used);
            } else if !seen.used.contains(&used) {
                seen.alone.insert(used);
            }
        }
    }

    /// Records what the rules in force deny a host, as the status lists it.
    pub(super) fn observe_denied(
        &mut self,
        party: &str,
        denied: &BTreeMap<String, String>,
        more: usize,
    ) {
        let of_peer = denied.iter().filter_map(|(what, why)| {
            let (verb, name) = what.strip_suffix(" (the peer's)")?.split_once(' ')?;
            let verb = Verb::ALL.into_iter().find(|known| known.name() == verb)?;
            Some(((verb, name.to_owned()), why.clone()))
        });
        let of_peer: Vec<_> = of_peer.collect();
        if of_peer.is_empty() && more == 0 {
            return;
        }
        let seen = self.parties.entry(Name::Host(party.to_owned())).or_default();
        seen.denied.extend(of_peer);
        seen.more_denied = seen.more_denied.max(more);
    }

    /// Returns the rules as the text of a rules file.
    ///
    /// # Errors
    /// The rules do not say what was seen; this is a defect of this tool.
    pub(super) fn rules(&self, sees_all: bool) -> Result<String, String> {
        let mut text = String::from(
            "# Written by axon acl learn: what other hosts and users did here while it watched. Read it before you\n\
             # use it: a use that did not come up in that time is denied.\n\n\
             default = \"deny\"\n",
        );
        let mut expectations = Vec::new();
        for (name, seen) in &self.parties {
            seen.write(name, sees_all, &mut text, &mut expectations);
        }
        let omitted = expectations.len().saturating_sub(MOST_EXPECTATIONS);
        expectations.iter().take(MOST_EXPECTATIONS).for_each(|expected| text.push_str(expected));
        if omitted > 0 {
            let _ = writeln!(
                text,
                "\n# {omitted} more uses are expected: a file has {MOST_EXPECTATIONS} [[expect]] at most"
            );
        }
        self.check(&text)?;
        Ok(text)
    }

    /// Checks that the rules allow what was seen and deny what was denied.
    fn check(&self, text: &str) -> Result<(), String> {
        let rules = verify(text)?;
        for (name, seen) in self.parties.iter().filter(|(name, _)| name.is_sayable()) {
            let name = name.text();
            let Ok(party) = Principal::parse(&name) else { continue };
            let permissions = rules.permissions(party);
            let sayable = |uses: &&Use| is_literal(&uses.1);
            let lost = seen.used().find(|(verb, topic)| !permissions.allows(*verb, topic));
            let gained = seen
                .denied
                .keys()
                .filter(sayable)
                .find(|used| permissions.allows(used.0, &used.1) && !seen.used.contains(used));
            if let Some((verb, topic)) = lost.or(gained) {
                return Err(format!(
                    "the rules do not say what was seen of {name}: {verb} {topic}"
                ));
            }
        }
        Ok(())
    }
}

impl PartySeen {
    /// Returns the uses that a rule can name and that were not denied.
    fn used(&self) -> impl Iterator<Item = &Use> {
        self.used.iter().filter(|used| is_literal(&used.1) && !self.denied.contains_key(*used))
    }

    fn write(
        &self,
        name: &Name,
        sees_all: bool,
        text: &mut String,
        expectations: &mut Vec<String>,
    ) {
        text.push('\n');
        let (is_sayable, name) = (name.is_sayable(), &*name.text());
        if !is_sayable {
            let name = printable(name);
            let _ =
                writeln!(text, "# {name}: no rule can name this peer alone. Give it another name.");
            return self.comment("it did", self.used.iter(), text);
        }
        let uses = self.uses(sees_all);
        if uses.is_empty() {
            let _ = writeln!(text, "# {}: nothing is allowed.", printable(name));
        } else {
            text.push_str(&uses.toml("allow", name));
        }
        for (used, why) in self.denied.iter().take(LISTED) {
            let _ = writeln!(text, "# denied before: {} ({})", shown(used), printable(why));
        }
        let more = self.denied.len().saturating_sub(LISTED) + self.more_denied;
        if more > 0 {
            let _ = writeln!(text, "# denied before: {more} more");
        }
        let unsayable = self.used.iter().filter(|used| !is_literal(&used.1));
        self.comment("no rule can name this alone", unsayable, text);
        self.comment("nothing here is at the other end", self.alone.iter(), text);
        let mut expect = |(verb, topic): &Use, allowed: bool| {
            let (name, topic) = (quoted(name), quoted(topic));
            expectations.push(format!(
                "\n[[expect]]\npeer = {name}\n{verb} = {topic}\nallowed = {allowed}\n"
            ));
        };
        self.used().for_each(|used| expect(used, true));
        let denied = self.denied.keys().filter(|used| is_literal(&used.1));
        denied.for_each(|used| expect(used, false));
    }

    fn uses(&self, sees_all: bool) -> Uses {
        let mut uses = Uses::default();
        for (verb, name) in self.used() {
            let names = match verb {
                Verb::Publish => &mut uses.publish,
                Verb::Subscribe => &mut uses.subscribe,
                Verb::Serve => &mut uses.serve,
                Verb::Call => &mut uses.call,
                Verb::See => &mut uses.see,
            };
            names.insert(name.clone());
        }
        uses.collapse_actions();
        uses.collapse_parameters();
        uses.collapse_lifecycle();
        if sees_all && !uses.is_empty() {
            uses.see.insert("**".to_owned());
        }
        uses
    }

    fn comment<'a>(&self, what: &str, uses: impl Iterator<Item = &'a Use>, text: &mut String) {
        let mut more = 0;
        for (number, used) in uses.enumerate() {
            if number < LISTED {
                let _ = writeln!(text, "# {what}: {}", shown(used));
            } else {
                more += 1;
            }
        }
        if more > 0 {
            let _ = writeln!(text, "# {what}: {more} more");
        }
    }
}

/// Returns whether rules decide about the connection of two endpoints.
fn meet(end: &Observed<'_>, other: &Observed<'_>) -> bool {
    match end.owner {
        Owner::Own => false,
        Owner::Host(_) => !matches!(other.owner, Owner::Host(_)),
        Owner::User(_) => end.session != other.session,
    }
}

/// Returns a use as one line of a comment, with special characters of the name escaped.
fn shown((verb, name): &Use) -> String {
    printable(&format!("{verb} {name}"))
}

/// Returns whether a pattern of this text fits this name and no other.
fn is_literal(name: &str) -> bool {
    !name.contains('*') && TopicPattern::new(name).is_ok()
}

#[cfg(test)]
mod tests {
    use axon_transport::internal::access::{
        ACTION_SERVICES, ACTION_TOPICS, LIFECYCLE_SERVICES, LIFECYCLE_TOPIC,
    };

    use super::*;

    fn end<'a>(owner: Owner<'a>, verb: Verb, name: &'a str) -> Observed<'a> {
        let session = match owner {
            Owner::Own => [0; 12],
            Owner::User(uid) => [uid as u8; 12],
            Owner::Host(_) => [255; 12],
        };
        Observed { owner, session, verb, name }
    }

    /// Returns a use by the base station, and the endpoint of this host at the other end.
    fn pair<'a>(verb: Verb, name: &'a str) -> [Observed<'a>; 2] {
        [end(Owner::Host("base"), verb, name), end(Owner::Own, other_end(verb), name)]
    }

    fn allows(text: &str, name: &str, verb: Verb, topic: &str) -> bool {
        verify(text).unwrap().check(Principal::parse(name).unwrap(), verb, topic).allowed()
    }

    #[test]
    fn learned_rules_allow_endpoints_matched_here_and_comment_out_unmatched_endpoints() {
        let mut seen = Seen::default();
        assert!(seen.is_empty());
        let alone = end(Owner::Host("base"), Verb::Publish, "/unheard");
        seen.observe(
            &[&pair(Verb::Publish, "/cmd_vel")[..], &pair(Verb::Call, "/set")[..], &[alone]]
                .concat(),
        );
        // The endpoint at the other end no longer exists at the second observation.
        seen.observe(&[alone]);
        // These two hosts use the topic with each other, and not with this host.
        let others = [("base", Verb::Publish), ("arm", Verb::Subscribe)];
        seen.observe(&others.map(|(host, verb)| end(Owner::Host(host), verb, "/theirs")));
        assert_eq!(seen.counts(), (2, 2));
        let text = seen.rules(false).unwrap();
        for (verb, topic, is) in [
            (Verb::Publish, "/cmd_vel", true),
            (Verb::Call, "/set", true),
            (Verb::Subscribe, "/cmd_vel", false),
            (Verb::Publish, "/unheard", false),
            (Verb::Publish, "/theirs", false),
            (Verb::See, "/node", false),
        ] {
            assert_eq!(allows(&text, "base", verb, topic), is, "{verb} {topic}\n{text}");
        }
        assert!(text.contains("# nothing here is at the other end: publish /unheard"), "{text}");
        assert_eq!(verify(&text).unwrap().expectations().len(), 2);
        assert!(allows(&seen.rules(true).unwrap(), "base", Verb::See, "/node"));
        assert!(!allows(&seen.rules(true).unwrap(), "arm", Verb::See, "/node"), "it did nothing");
    }

    #[test]
    fn whole_actions_and_lifecycle_nodes_are_one_line_each() {
        let names = |base: &str, parts: &[&str]| -> Vec<String> {
            parts.iter().map(|part| format!("{base}/{part}")).collect()
        };
        let call = [names("/dock", &ACTION_SERVICES), names("/arm", &LIFECYCLE_SERVICES)].concat();
        let read = [names("/dock", &ACTION_TOPICS), names("/arm", &[LIFECYCLE_TOPIC])].concat();
        let mut all = Vec::new();
        call.iter().for_each(|name| all.extend(pair(Verb::Call, name)));
        read.iter().for_each(|name| all.extend(pair(Verb::Subscribe, name)));
        let mut seen = Seen::default();
        seen.observe(&all);
        let text = seen.rules(false).unwrap();
        let rule = text.split("[[expect]]").next().unwrap();
        assert!(rule.contains("act = \"/dock\"\nlifecycle = \"/arm\"\n"), "{rule}");
        assert!(!rule.contains("subscribe") && !rule.contains("call"), "{rule}");
        assert_eq!(verify(&text).unwrap().expectations().len(), 11);
    }

    #[test]
    fn names_are_escaped_and_those_that_no_rule_can_name_alone_are_comments() {
        let odd = ["/a\"b\n[[allow]]\npeer = \"local\"", "/\u{202e}x", "/a*", "no/slash", "/a//b"];
        let mut all = Vec::new();
        odd.iter().for_each(|name| all.extend(pair(Verb::Publish, name)));
        for host in ["*", "local", "uid:7", "a*", "ok \"quoted\""] {
            all.push(end(Owner::Host(host), Verb::Publish, odd[0]));
        }
        let mut seen = Seen::default();
        seen.observe(&all);
        let text = seen.rules(false).unwrap();
        for (name, is) in [(odd[0], true), (odd[1], true), ("/ab", false), ("/a*", false)] {
            assert_eq!(allows(&text, "base", Verb::Publish, name), is, "{name:?}\n{text}");
        }
        assert!(allows(&text, "ok \"quoted\"", Verb::Publish, odd[0]));
        assert!(!allows(&text, "somebody", Verb::Publish, odd[0]), "{text}");
        assert!(text.contains("# no rule can name this alone: publish /a*"), "{text}");
        for host in ["*", "local", "uid:7", "a*"] {
            let line = format!("\n# {host}: no rule can name this peer alone");
            assert!(text.contains(&line), "{text}");
        }
        assert!(!allows(&text, "uid:7", Verb::Publish, odd[0]));
    }

    #[test]
    fn denied_uses_are_comments_and_expected_to_stay_denied() {
        let mut seen = Seen::default();
        seen.observe(&pair(Verb::Publish, "/cmd_vel"));
        let why = "here: denied by line 3 of access.toml".to_owned();
        let denied = BTreeMap::from([
            ("publish /brake (the peer's)".to_owned(), why.clone()),
            ("subscribe /scan (ours)".to_owned(), "by the peer".to_owned()),
        ]);
        seen.observe_denied("base", &denied, 3);
        seen.observe_denied("arm", &BTreeMap::new(), 0);
        let text = seen.rules(false).unwrap();
        assert!(text.contains(&format!("# denied before: publish /brake ({why})")), "{text}");
        assert!(text.contains("# denied before: 3 more") && !text.contains("/scan"), "{text}");
        assert!(!allows(&text, "base", Verb::Publish, "/brake"));
        let rules = verify(&text).unwrap();
        let is = |e: &axon_transport::access::Expectation| (e.name.clone(), e.allowed);
        let expected: Vec<_> = rules.expectations().iter().map(is).collect();
        assert_eq!(expected, [("/cmd_vel".to_owned(), true), ("/brake".to_owned(), false)]);
    }

    #[test]
    fn matches_of_another_user_with_other_owners_are_learned() {
        let mut seen = Seen::default();
        let user = |verb, name| end(Owner::User(7), verb, name);
        seen.observe(&[
            user(Verb::Publish, "/a"),
            end(Owner::Own, Verb::Subscribe, "/a"),
            user(Verb::Publish, "/far"),
            end(Owner::Host("base"), Verb::Subscribe, "/far"),
            user(Verb::Publish, "/own"),
            user(Verb::Subscribe, "/own"),
        ]);
        let text = seen.rules(false).unwrap();
        for (name, topic, is) in
            [("uid:7", "/a", true), ("uid:7", "/far", true), ("uid:7", "/own", false)]
        {
            assert_eq!(allows(&text, name, Verb::Publish, topic), is, "{topic}\n{text}");
        }
        assert!(allows(&text, "base", Verb::Subscribe, "/far"), "a session of this host is there");
    }

    #[test]
    fn thousands_of_topics_make_a_file_that_can_be_used() {
        let names: Vec<String> = (0..5000).map(|number| format!("/t{number}")).collect();
        let all: Vec<_> = names.iter().flat_map(|name| pair(Verb::Subscribe, name)).collect();
        let mut seen = Seen::default();
        seen.observe(&all);
        seen.observe(&all);
        let text = seen.rules(false).unwrap();
        assert_eq!(verify(&text).unwrap().expectations().len(), MOST_EXPECTATIONS);
        assert!(text.contains("# 904 more uses are expected"), "{}", text.len());
        let rules = verify(&text).unwrap().permissions(Principal::Name("base"));
        assert!(names.iter().all(|name| rules.allows(Verb::Subscribe, name)));
    }
}
