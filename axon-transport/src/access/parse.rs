//! Parses rules from TOML. Each error has its line and column.

pub(crate) mod limit;

use std::{ops::Range, sync::Arc};

use toml::{
    Spanned,
    de::{DeTable, DeValue},
};

use super::{
    AccessRules, Expectation, Principal, TopicPattern, Verb,
    party::PartyPattern,
    ros,
    rules::{Rule, RuleFile},
};

/// Maximum number of entries of one kind in a file.
const MAX_RULES: usize = 4096;
/// Maximum number of patterns and names in all rules together. Each pattern that an action or a parameter expands to
/// counts.
const MOST_PATTERNS: usize = 65_536;
/// The keys of rules in a file. All other keys are settings of `axon.toml`.
const KEYS: [&str; 5] = ["default", "allow", "deny", "limit", "expect"];

/// An error in access rules, with its place.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("line {line}, column {column} of {file}: {what}")]
#[non_exhaustive]
pub struct AccessError {
    /// The file.
    pub file: String,
    /// The line, counted from 1.
    pub line: u32,
    /// The column in characters, counted from 1.
    pub column: u32,
    /// The fault, and the accepted input.
    pub what: String,
}

impl AccessRules {
    /// Parses a file that contains only rules. `file` is the name of the file in decisions.
    ///
    /// # Errors
    /// The first fault.
    pub fn parse(text: &str, file: &str) -> Result<Self, AccessError> {
        RuleFileReader::new(text, file).read(true)
    }

    /// Parses the rules of an `axon.toml`. Its other keys are ignored.
    ///
    /// # Errors
    /// The first fault of a rule.
    pub fn parse_among_settings(text: &str, file: &str) -> Result<Self, AccessError> {
        RuleFileReader::new(text, file).read(false)
    }

    /// Returns whether a top-level key of an `axon.toml` belongs to rules.
    pub(crate) fn is_key(key: &str) -> bool {
        KEYS.contains(&key)
    }
}

type Value<'i> = Spanned<DeValue<'i>>;

/// A parser of one file.
struct RuleFileReader<'t> {
    text: &'t str,
    file: Arc<str>,
    patterns: usize,
    /// Number of patterns in limits.
    limited: usize,
}

impl<'t> RuleFileReader<'t> {
    fn new(text: &'t str, file: &str) -> Self {
        Self { text, file: file.into(), patterns: 0, limited: 0 }
    }

    fn read(mut self, alone: bool) -> Result<AccessRules, AccessError> {
        let table = DeTable::parse(self.text).map_err(|error| {
            self.wrong(error.span().unwrap_or_default(), error.message().to_owned())
        })?;
        let mut file = RuleFile {
            file: Arc::clone(&self.file),
            denies_by_default: false,
            allow: Vec::new(),
            deny: Vec::new(),
            expectations: Vec::new(),
        };
        let (mut limits, mut found) = (limit::Entries::default(), false);
        for (key, value) in table.get_ref() {
            let key_name = &**key.get_ref();
            found |= ["default", "allow", "deny"].contains(&key_name);
            match key_name {
                "default" => {
                    file.denies_by_default = match value.get_ref().as_str() {
                        Some("deny") => true,
                        Some("allow") => false,
                        _ => {
                            return Err(
                                self.wrong(value.span(), "default is \"allow\" or \"deny\"")
                            );
                        }
                    };
                }
                "allow" => file.allow = self.rules(value, "[[allow]]")?,
                "deny" => file.deny = self.rules(value, "[[deny]]")?,
                "limit" => limits = self.limits(value)?,
                "expect" => file.expectations = self.expectations(value)?,
                other if alone => {
                    let what = format!("unknown key {other:?}; accepted: {}", KEYS.join(", "));
                    return Err(self.wrong(key.span(), what));
                }
                _ => {}
            }
        }
        // A file that is being written is empty for a moment. This must not allow everything.
        if alone && !found && limits.is_empty() {
            let what = "no rules; accepted: default, [[allow]], [[deny]], [[limit]]; to allow all, write \
                        default = \"allow\"";
            return Err(self.wrong(0..0, what));
        }
        let rules = found.then(|| Arc::new(file));
        let limit::Entries { peers, interfaces } = limits;
        let limits = peers.into_iter().map(Arc::new).collect();
        Ok(AccessRules { rules, limits, interface_limits: interfaces.into() })
    }

    fn wrong(&self, span: Range<usize>, what: impl Into<String>) -> AccessError {
        let (line, column) = position(self.text, span.start);
        let number = |n: usize| u32::try_from(n).unwrap_or(u32::MAX);
        let (file, what) = (self.file.to_string(), what.into());
        AccessError { file, line: number(line), column: number(column), what }
    }

    fn line(&self, value: &Value<'_>) -> u32 {
        self.wrong(value.span(), "").line
    }

    /// Returns the entries of an array of tables.
    fn tables<'v, 'i>(
        &self,
        value: &'v Value<'i>,
        header: &str,
    ) -> Result<Vec<(&'v DeTable<'i>, Range<usize>)>, AccessError> {
        let entries = value.get_ref().as_array();
        let entries = entries.ok_or_else(|| self.wrong(value.span(), format!("write {header}")))?;
        if entries.len() > MAX_RULES {
            let what = format!("at most {MAX_RULES} entries {header}");
            return Err(self.wrong(value.span(), what));
        }
        let table = |entry: &'v Value<'i>| {
            let table = entry.get_ref().as_table().map(|table| (table, entry.span()));
            table.ok_or_else(|| self.wrong(entry.span(), format!("write {header}")))
        };
        entries.iter().map(table).collect()
    }

    /// Returns a string, or the strings of an array.
    fn strings<'v>(
        &self,
        key: &str,
        value: &'v Value<'_>,
    ) -> Result<Vec<(&'v str, &'v Value<'v>)>, AccessError> {
        let wrong = |value: &Value<'_>| {
            let what = format!("{key} is a string, or an array of strings");
            self.wrong(value.span(), what)
        };
        let one = |value: &'v Value<'_>| match value.get_ref().as_str() {
            Some(text) => Ok((text, value)),
            None => Err(wrong(value)),
        };
        match value.get_ref() {
            DeValue::Array(values) if values.is_empty() => Err(wrong(value)),
            DeValue::Array(values) => values.iter().map(one).collect(),
            _ => Ok(vec![one(value)?]),
        }
    }

    fn count_patterns(&mut self, more: usize, at: &Value<'_>) -> Result<(), AccessError> {
        self.patterns += more;
        if self.patterns > MOST_PATTERNS {
            let what = format!("at most {MOST_PATTERNS} patterns in all rules");
            return Err(self.wrong(at.span(), what));
        }
        Ok(())
    }

    fn rules(&mut self, value: &Value<'_>, header: &str) -> Result<Vec<Rule>, AccessError> {
        let tables = self.tables(value, header)?;
        tables.into_iter().map(|(table, span)| self.rule(table, span, header)).collect()
    }

    fn rule(
        &mut self,
        table: &DeTable<'_>,
        span: Range<usize>,
        header: &str,
    ) -> Result<Rule, AccessError> {
        let mut rule = Rule { peers: Vec::new(), says: Vec::new() };
        let denies = header == "[[deny]]";
        for (key, value) in table {
            let key_span = key.span();
            let key = &**key.get_ref();
            if key == "peer" {
                for (text, value) in self.strings(key, value)? {
                    let peer = PartyPattern::parse(text);
                    let wrong =
                        |what| self.wrong(value.span(), format!("peer {text:?}; accepted: {what}"));
                    rule.peers.push(peer.map_err(wrong)?);
                }
                continue;
            }
            let expand: fn(&TopicPattern) -> Vec<(Verb, TopicPattern)> = match key {
                "publish" => |name| vec![(Verb::Publish, name.clone())],
                "subscribe" => |name| vec![(Verb::Subscribe, name.clone())],
                "call" => |name| vec![(Verb::Call, name.clone())],
                "see" => |name| vec![(Verb::See, name.clone())],
                "serve" => ros::serve,
                "act" => ros::act,
                "parameters" if denies => ros::parameter_services,
                "parameters" => ros::parameters,
                "lifecycle" if denies => ros::lifecycle_parts,
                "lifecycle" => ros::lifecycle,
                _ => {
                    let what = format!(
                        "unknown key {key:?}; accepted: peer, publish, subscribe, serve, call, act, see, \
                         parameters, lifecycle"
                    );
                    return Err(self.wrong(key_span, what));
                }
            };
            let names = match (key, value.get_ref()) {
                ("parameters" | "lifecycle", DeValue::Boolean(true)) => vec![("**", value)],
                ("parameters" | "lifecycle", DeValue::Boolean(false)) => continue,
                _ => self.strings(key, value)?,
            };
            for (text, value) in names {
                let wrong =
                    |what| self.wrong(value.span(), format!("{key} {text:?}; accepted: {what}"));
                let pattern = TopicPattern::new(text).map_err(wrong)?;
                let (expanded, line) = (expand(&pattern), self.line(value));
                self.count_patterns(expanded.len(), value)?;
                rule.says.extend(expanded.into_iter().map(|(verb, name)| (verb, name, line)));
            }
        }
        if rule.peers.is_empty() {
            let what =
                format!("{header} without peer: write the names it is about, or peer = \"*\"");
            return Err(self.wrong(span, what));
        }
        // An [[allow]] without actions is valid: it denies everything to its peers.
        if rule.says.is_empty() && denies {
            let what = "[[deny]] that denies nothing; to deny all, write \
                        publish, subscribe, serve, call and see = \"**\"";
            return Err(self.wrong(span, what));
        }
        Ok(rule)
    }

    fn expectations(&self, value: &Value<'_>) -> Result<Vec<Expectation>, AccessError> {
        let tables = self.tables(value, "[[expect]]")?;
        tables.into_iter().map(|(table, span)| self.expectation(table, span)).collect()
    }

    fn expectation(
        &self,
        table: &DeTable<'_>,
        span: Range<usize>,
    ) -> Result<Expectation, AccessError> {
        let (mut peer, mut does, mut allowed) = (None, None, None);
        for (key, value) in table {
            let text = value.get_ref().as_str();
            let verb = Verb::ALL.into_iter().find(|verb| verb.name() == key.get_ref());
            match (&**key.get_ref(), verb, text, value.get_ref().as_bool()) {
                ("peer", _, Some(text), _) => {
                    let wrong =
                        |what| self.wrong(value.span(), format!("peer {text:?}; accepted: {what}"));
                    Principal::parse(text).map_err(wrong)?;
                    peer = Some(text.to_owned());
                }
                ("allowed", _, _, Some(whether)) => allowed = Some(whether),
                (_, Some(verb), Some(name), _) if does.is_none() => {
                    does = Some((verb, name.to_owned()));
                }
                _ => break,
            }
        }
        let line = self.wrong(span.clone(), "").line;
        match (peer, does, allowed) {
            (Some(peer), Some((verb, name)), Some(allowed)) if table.len() == 3 => {
                Ok(Expectation { peer, verb, name, allowed, line })
            }
            _ => Err(self.wrong(
                span,
                "[[expect]] has a peer, one of publish, subscribe, serve, call and see with a name, \
                 and allowed = true or false",
            )),
        }
    }
}

/// Returns the line and the column of a byte of a text, both counted from 1. The column counts characters.
pub(crate) fn position(text: &str, byte: usize) -> (usize, usize) {
    let before = text.get(..byte).unwrap_or(text);
    let column = before.rsplit('\n').next().unwrap_or("").chars().count() + 1;
    (before.matches('\n').count() + 1, column)
}
