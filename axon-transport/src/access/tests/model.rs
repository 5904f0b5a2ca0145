//! Compares decisions with a reference model that tries each rule.

use proptest::prelude::*;

use super::{super::ros, *};

/// A rule of the model.
#[derive(Clone, Debug)]
struct ModelRule {
    denies: bool,
    peer: &'static str,
    key: &'static str,
    /// A pattern, or `true` for parameters and lifecycle.
    name: &'static str,
}

const PEERS: [&str; 8] =
    ["base", "op*", "op-1", "*", "local", "uid:7", "address:10.0.0.*", "Host.Example"];
const KEYS: [&str; 8] =
    ["publish", "subscribe", "serve", "call", "see", "act", "parameters", "lifecycle"];
const PATTERNS: [&str; 5] = ["/a", "/a/b", "/a/**", "/**", "true"];
const NAMES: [&str; 9] = [
    "/a",
    "/a/b",
    "/b",
    "/a/set_parameters",
    "/b/get_state",
    "/a/transition_event",
    "/parameter_events",
    "/a/_action/send_goal",
    "/a/_action/status",
];

fn parties() -> [Principal<'static>; 9] {
    [
        Principal::Name("base"),
        Principal::Name("op-1"),
        Principal::Name("op-2"),
        Principal::Name("host.example"),
        Principal::Certificate("host.example"),
        Principal::Address([10, 0, 0, 7].into()),
        Principal::Address([10, 0, 1, 7].into()),
        Principal::User(7),
        Principal::User(8),
    ]
}

impl ModelRule {
    fn names(&self, party: Principal<'_>) -> bool {
        match (self.peer, party) {
            ("*", _) => true,
            ("local", Principal::User(_)) | ("uid:7", Principal::User(7)) => true,
            ("address:10.0.0.*", Principal::Address(ip)) => ip.to_string().starts_with("10.0.0."),
            ("op*", Principal::Name(name)) => name.starts_with("op"),
            (peer, Principal::Name(name)) => peer == name,
            (peer, Principal::Certificate(name)) => peer.eq_ignore_ascii_case(name),
            _ => false,
        }
    }

    fn fits(&self, name: &str) -> bool {
        match self.name {
            "/**" | "true" => true,
            "/a/**" => name == "/a" || name.starts_with("/a/"),
            pattern => pattern == name,
        }
    }

    /// Returns whether a name is one of `parts` below a name that the pattern fits.
    fn fits_part(&self, name: &str, parts: &[&str]) -> bool {
        let base = |part: &&str| name.strip_suffix(*part)?.strip_suffix('/');
        parts.iter().filter_map(base).any(|base| self.fits(base))
    }

    fn says(&self, verb: Verb, name: &str) -> bool {
        let (services, topics) = (&ros::ACTION_SERVICES, &ros::ACTION_TOPICS);
        match (self.key, verb) {
            ("serve", Verb::Serve) => self.fits(name) || self.fits_part(name, services),
            ("serve", Verb::Publish) | ("act", Verb::Subscribe) => self.fits_part(name, topics),
            ("act", Verb::Call) => self.fits_part(name, services),
            ("parameters", Verb::Call) => self.fits_part(name, &ros::PARAMETER_SERVICES),
            ("parameters", Verb::Subscribe) => !self.denies && name == ros::PARAMETER_EVENTS,
            ("lifecycle", Verb::Call) => self.fits_part(name, &ros::LIFECYCLE_SERVICES),
            ("lifecycle", Verb::Subscribe) => self.fits_part(name, &[ros::LIFECYCLE_TOPIC]),
            ("parameters" | "lifecycle", Verb::See) => !self.denies && self.fits(name),
            (key, verb) => key == verb.name() && self.fits(name),
        }
    }

    fn toml(&self) -> String {
        let header = if self.denies { "deny" } else { "allow" };
        let name = if self.name == "true" { "true".to_owned() } else { format!("{:?}", self.name) };
        format!("[[{header}]]\npeer = {:?}\n{} = {name}\n", self.peer, self.key)
    }
}

/// Returns whether a party may do something, and the line that decides. A `[[deny]]` decides first, then an
/// `[[allow]]`. Otherwise, a party that an `[[allow]]` names may do nothing, and neither may others if the default is
/// to deny. All others may do everything that no `[[deny]]` hides.
fn decision(
    rules: &[ModelRule],
    deny: bool,
    party: Principal<'_>,
    verb: Verb,
    name: &str,
) -> (bool, Option<u32>) {
    // The default takes the first line, and each rule takes three lines.
    let named = (1..).zip(rules).filter(|(_, rule)| rule.names(party));
    let named: Vec<_> = named.map(|(number, rule)| (3 * number + 1, rule)).collect();
    let line = |denies, verb| {
        let says = |(_, rule): &&(u32, &ModelRule)| rule.denies == denies && rule.says(verb, name);
        named.iter().find(says).map(|(line, _)| *line)
    };
    if let Some(line) = line(true, verb) {
        return (false, Some(line));
    }
    if let Some(line) = line(false, verb) {
        return (true, Some(line));
    }
    if deny || named.iter().any(|(_, rule)| !rule.denies) {
        return (false, None);
    }
    let hidden = line(true, Verb::See);
    (hidden.is_none(), hidden)
}

fn model_rules() -> impl Strategy<Value = Vec<ModelRule>> {
    let rule = (any::<bool>(), 0..PEERS.len(), 0..KEYS.len(), 0..PATTERNS.len());
    let rule = rule.prop_map(|(denies, peer, key, name)| {
        let (key, mut name) = (KEYS[key], PATTERNS[name]);
        if name == "true" && !["parameters", "lifecycle"].contains(&key) {
            name = "/**";
        }
        ModelRule { denies, peer: PEERS[peer], key, name }
    });
    prop::collection::vec(rule, 0..10)
}

proptest! {
    #[test]
    fn decisions_and_their_lines_are_those_of_the_definition(
        all in model_rules(),
        deny in any::<bool>(),
    ) {
        let default = format!("default = \"{}\"\n", if deny { "deny" } else { "allow" });
        let text = all.iter().fold(default, |text, rule| text + &rule.toml());
        let rules = rules(&text);
        for party in parties() {
            let permissions = rules.permissions(party);
            for (verb, name) in Verb::ALL.into_iter().flat_map(|v| NAMES.map(|n| (v, n))) {
                let (allowed, line) = decision(&all, deny, party, verb, name);
                let is = permissions.check(verb, name);
                let is = (is.allowed(), is.line());
                prop_assert_eq!(is, (allowed, line), "{} {} {}\n{}", party, verb, name, &text);
                prop_assert_eq!(permissions.allows(verb, name), allowed);
            }
        }
    }
}
