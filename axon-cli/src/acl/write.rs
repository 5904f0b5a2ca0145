//! Writes rules as text. Names are escaped. The parts of an action, and the services of parameters and of a lifecycle
//! node, become one line.

use std::{collections::BTreeSet, fmt::Write as _};

use axon_transport::{
    access::{AccessRules, TopicPattern},
    internal::access::{
        ACTION_SERVICES, ACTION_TOPICS, LIFECYCLE_SERVICES, LIFECYCLE_TOPIC, PARAMETER_EVENTS,
        PARAMETER_SERVICES,
    },
};

/// Patterns of names, sorted.
pub(super) type Names = BTreeSet<String>;

/// The contents of one `[[allow]]` or `[[deny]]`.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct Uses {
    pub(super) publish: Names,
    pub(super) subscribe: Names,
    pub(super) serve: Names,
    pub(super) call: Names,
    pub(super) act: Names,
    pub(super) see: Names,
    pub(super) parameters: Names,
    pub(super) lifecycle: Names,
}

impl Uses {
    pub(super) fn is_empty(&self) -> bool {
        *self == Self::default()
    }

    /// Replaces all parts of an action by the action's name.
    pub(super) fn collapse_actions(&mut self) {
        for action in complete(&self.call, &ACTION_SERVICES) {
            if has_all(&self.subscribe, &action, &ACTION_TOPICS) {
                remove_all(&mut self.call, &action, &ACTION_SERVICES);
                remove_all(&mut self.subscribe, &action, &ACTION_TOPICS);
                self.act.insert(action);
            }
        }
        for action in complete(&self.serve, &ACTION_SERVICES) {
            if has_all(&self.publish, &action, &ACTION_TOPICS) {
                remove_all(&mut self.serve, &action, &ACTION_SERVICES);
                remove_all(&mut self.publish, &action, &ACTION_TOPICS);
                self.serve.insert(action);
            }
        }
    }

    /// Replaces the parameter services of a node by the node's name, where all are called and the topic of parameter
    /// changes is subscribed to. `parameters` also allows that topic.
    pub(super) fn collapse_parameters(&mut self) {
        let all = |name: &String| name == "/**" || name == "**" || name == PARAMETER_EVENTS;
        if !self.subscribe.iter().any(all) {
            return;
        }
        for node in complete(&self.call, &PARAMETER_SERVICES) {
            remove_all(&mut self.call, &node, &PARAMETER_SERVICES);
            self.subscribe.remove(PARAMETER_EVENTS);
            self.parameters.insert(node);
        }
    }

    /// Replaces the services and the topic of a lifecycle node by the node's name, where all services are called and
    /// the topic is subscribed to.
    pub(super) fn collapse_lifecycle(&mut self) {
        for node in complete(&self.call, &LIFECYCLE_SERVICES) {
            if has_all(&self.subscribe, &node, &[LIFECYCLE_TOPIC]) {
                remove_all(&mut self.call, &node, &LIFECYCLE_SERVICES);
                remove_all(&mut self.subscribe, &node, &[LIFECYCLE_TOPIC]);
                self.lifecycle.insert(node);
            }
        }
    }

    /// Returns the rule as TOML. `header` is `allow` or `deny`.
    pub(super) fn toml(&self, header: &str, peer: &str) -> String {
        let mut text = format!("[[{header}]]\npeer = {}\n", quoted(peer));
        for (key, names) in [
            ("publish", &self.publish),
            ("subscribe", &self.subscribe),
            ("serve", &self.serve),
            ("call", &self.call),
            ("act", &self.act),
            ("parameters", &self.parameters),
            ("lifecycle", &self.lifecycle),
            ("see", &self.see),
        ] {
            let names: Vec<_> = names.iter().map(|name| quoted(name)).collect();
            let _ = match &names[..] {
                [] => Ok(()),
                [one] => writeln!(text, "{key} = {one}"),
                all => writeln!(text, "{key} = [\n  {},\n]", all.join(",\n  ")),
            };
        }
        text
    }
}

/// Returns the names that `names` holds with each of `parts` appended.
fn complete(names: &Names, parts: &[&str]) -> Vec<String> {
    let bases = names.iter().filter_map(|name| name.strip_suffix(parts[0])?.strip_suffix('/'));
    let whole = bases.filter(|base| TopicPattern::new(base).is_ok() && has_all(names, base, parts));
    whole.map(str::to_owned).collect()
}

fn has_all(names: &Names, base: &str, parts: &[&str]) -> bool {
    parts.iter().all(|part| names.contains(&format!("{base}/{part}")))
}

fn remove_all(names: &mut Names, base: &str, parts: &[&str]) {
    for part in parts {
        names.remove(&format!("{base}/{part}"));
    }
}

/// Returns a TOML string. All characters except printable ASCII are escaped.
pub(super) fn quoted(text: &str) -> String {
    let mut out = String::from("\"");
    for c in text.chars() {
        match c {
            '"' | '\\' => out.extend(['\\', c]),
            ' '..='~' => out.push(c),
            _ => drop(write!(out, "\\U{:08X}", u32::from(c))),
        }
    }
    out.push('"');
    out
}

/// Parses the text as a file of rules.
///
/// # Errors
/// The text is not a valid file of rules; the error says why.
pub(super) fn verify(text: &str) -> Result<AccessRules, String> {
    AccessRules::parse(text, "the rules to write").map_err(|error| error.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(all: &[&str]) -> Names {
        all.iter().map(|&name| name.to_owned()).collect()
    }

    fn parts(base: &str, parts: &[&str]) -> Names {
        parts.iter().map(|part| format!("{base}/{part}")).collect()
    }

    #[test]
    fn whole_actions_are_one_name_and_incomplete_ones_are_left_as_they_are() {
        let mut uses = Uses {
            call: parts("/dock", &ACTION_SERVICES),
            subscribe: parts("/dock", &ACTION_TOPICS),
            serve: parts("/go", &ACTION_SERVICES),
            publish: parts("/go", &ACTION_TOPICS[..1]),
            ..Uses::default()
        };
        uses.collapse_actions();
        assert_eq!(uses.act, names(&["/dock"]));
        assert!(uses.call.is_empty() && uses.subscribe.is_empty());
        assert_eq!((uses.serve.len(), uses.publish.len()), (3, 1));
    }

    #[test]
    fn parameters_are_one_name_where_their_topic_is_subscribed_to() {
        let call = parts("/arm", &PARAMETER_SERVICES);
        let mut uses = Uses { call, ..Uses::default() };
        uses.collapse_parameters();
        assert_eq!(uses.call.len(), 6);
        uses.subscribe = names(&[PARAMETER_EVENTS]);
        uses.collapse_parameters();
        assert_eq!(
            (uses.parameters, uses.call, uses.subscribe.len()),
            (names(&["/arm"]), names(&[]), 0)
        );
    }

    #[test]
    fn lifecycle_nodes_are_one_name_where_all_of_their_services_are_called() {
        let (call, subscribe) =
            (parts("/arm", &LIFECYCLE_SERVICES), parts("/arm", &[LIFECYCLE_TOPIC]));
        let mut uses = Uses { call, subscribe, ..Uses::default() };
        uses.collapse_lifecycle();
        assert_eq!(uses, Uses { lifecycle: names(&["/arm"]), ..Uses::default() });
        let some = Uses { call: parts("/arm", &LIFECYCLE_SERVICES[1..]), ..Uses::default() };
        let mut uses = Uses { call: some.call.clone(), ..Uses::default() };
        uses.collapse_lifecycle();
        assert_eq!(uses, some);
    }

    #[test]
    fn each_name_comes_back_as_it_was() {
        for name in ["/a\"b", "/a\\", "/a\n[[deny]]", "/\u{7f}\u{202e}\u{1f916}", "/'''", "/a#b"] {
            let uses = Uses { publish: names(&[name]), ..Uses::default() };
            let text = uses.toml("allow", "base");
            let rules = verify(&text).unwrap();
            let base = axon_transport::access::Principal::Name("base");
            let publish = axon_transport::access::Verb::Publish;
            assert!(rules.check(base, publish, name).allowed(), "{text}");
            assert!(!rules.check(base, publish, "/other").allowed(), "{text}");
        }
    }
}
