//! A grant that is completely understood, and its decisions.

use super::{
    date,
    document::{self, UnknownElement},
    expression::Expression,
    names::TopicUse,
};

/// A grant that can decide.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct CompiledGrant {
    pub(super) line: u32,
    pub(super) validity: document::Validity,
    not_before: i64,
    not_after: i64,
    rules: Vec<CompiledRule>,
    allows_by_default: bool,
    default_line: u32,
}

#[derive(Clone, Debug, PartialEq, Eq)]
struct CompiledRule {
    allows: bool,
    /// The first and the last domain of each range.
    domains: Vec<(u32, u32)>,
    publish: Vec<(Expression, u32)>,
    subscribe: Vec<(Expression, u32)>,
}

/// The decision of a grant; a denial has the line that decides.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum GrantDecision {
    Allowed,
    DeniedByRule(u32),
    DeniedByDefault(u32),
}

impl CompiledGrant {
    /// Compiles a grant.
    ///
    /// # Errors
    /// A part of the grant is missing or not understood. Such a part might be a denial.
    pub(super) fn new(read: document::SubjectGrant) -> Result<Self, String> {
        let of_grant = |what: &str| format!("line {}: the grant has no <{what}>", read.line);
        known(&read.unknown)?;
        let validity = read.validity.ok_or_else(|| of_grant("validity"))?;
        let (default, default_line) = read.default.ok_or_else(|| of_grant("default"))?;
        let seconds = |text: &str, what| {
            let line = validity.line;
            date::seconds(text).ok_or_else(|| {
                format!("line {line}: {what} is {text:?}; accepted: a date as 2036-01-31T12:00:00")
            })
        };
        Ok(Self {
            line: read.line,
            not_before: seconds(&validity.not_before, "not_before")?,
            not_after: seconds(&validity.not_after, "not_after")?,
            validity,
            rules: read.rules.into_iter().map(CompiledRule::new).collect::<Result<_, _>>()?,
            allows_by_default: default,
            default_line,
        })
    }

    /// Returns whether the grant is valid at a time in seconds since 1970.
    pub(super) fn is_valid(&self, now: i64) -> bool {
        (self.not_before..=self.not_after).contains(&now)
    }

    /// Returns whether anything may be allowed in a domain.
    pub(super) fn counts_in(&self, domain: u32) -> bool {
        self.allows_by_default || self.rules.iter().any(|rule| rule.allows && rule.is_for(domain))
    }

    /// Returns the domains in which something may be allowed, for people.
    pub(super) fn domains(&self) -> String {
        let ranges = self.rules.iter().filter(|rule| rule.allows).flat_map(|rule| &rule.domains);
        let mut shown: Vec<_> = ranges
            .map(|&range| match range {
                (first, last) if first == last => first.to_string(),
                (first, u32::MAX) => format!("{first} and above"),
                (first, last) => format!("{first} to {last}"),
            })
            .collect();
        shown.dedup();
        shown.truncate(20);
        if shown.is_empty() { "none".to_owned() } else { shown.join(", ") }
    }

    /// Decides by the first rule for the domain that fits, or else by the default.
    pub(super) fn decide(&self, domain: u32, does: TopicUse, topic: &str) -> GrantDecision {
        let rules = self.rules.iter().filter(|rule| rule.is_for(domain));
        for rule in rules {
            let expressions = match does {
                TopicUse::Publish => &rule.publish,
                TopicUse::Subscribe => &rule.subscribe,
            };
            if let Some((_, line)) = expressions.iter().find(|(one, _)| one.fits(topic)) {
                return if rule.allows {
                    GrantDecision::Allowed
                } else {
                    GrantDecision::DeniedByRule(*line)
                };
            }
        }
        if self.allows_by_default {
            GrantDecision::Allowed
        } else {
            GrantDecision::DeniedByDefault(self.default_line)
        }
    }
}

impl CompiledRule {
    fn new(read: document::SubjectRule) -> Result<Self, String> {
        known(&read.unknown)?;
        let mut rule = Self {
            allows: read.allows,
            domains: domains(&read.domains, read.line)?,
            publish: Vec::new(),
            subscribe: Vec::new(),
        };
        for criteria in read.criteria {
            let line = criteria.line;
            if criteria.has_data_tags {
                return Err(format!("line {line}: data_tags, which AXON has not"));
            }
            if criteria.topics.is_empty() {
                return Err(format!("line {line}: no topic"));
            }
            let mut expressions = Vec::with_capacity(criteria.topics.len());
            for topic in criteria.topics {
                let line = topic.line;
                let expression = Expression::new(&topic.text)
                    .map_err(|why| format!("line {line}: a topic's expression {why}"))?;
                expressions.push((expression, line));
            }
            if !has_own_partition(criteria.partitions.as_deref(), line)? {
                continue;
            }
            match criteria.does {
                TopicUse::Publish => rule.publish.append(&mut expressions),
                TopicUse::Subscribe => rule.subscribe.append(&mut expressions),
            }
        }
        Ok(rule)
    }

    fn is_for(&self, domain: u32) -> bool {
        self.domains.iter().any(|&(first, last)| (first..=last).contains(&domain))
    }
}

/// Returns whether criteria apply to the partition without a name, which contains the endpoints of ROS 2. Without
/// partitions they do: an `allow_rule` then applies to that partition, and a `deny_rule` to all.
fn has_own_partition(partitions: Option<&[String]>, line: u32) -> Result<bool, String> {
    let Some(partitions) = partitions else { return Ok(true) };
    if partitions.is_empty() {
        return Err(format!("line {line}: no partition"));
    }
    let mut fits = false;
    for partition in partitions {
        let expression = Expression::new(partition)
            .map_err(|why| format!("line {line}: a partition's expression {why}"))?;
        fits |= expression.fits("");
    }
    Ok(fits)
}

fn domains(all: &[document::Domains], line: u32) -> Result<Vec<(u32, u32)>, String> {
    let [domains] = all else {
        return Err(format!(
            "line {line}: a rule has its domains in one <domains>, and not in {}",
            all.len()
        ));
    };
    let line = domains.line;
    if domains.ranges.is_empty() {
        return Err(format!("line {line}: no domain"));
    }
    let number = |text: &str| {
        text.parse::<u32>()
            .map_err(|_| format!("line {line}: domain {text:?}; accepted: numbers from 0 on"))
    };
    let mut ranges = Vec::with_capacity(domains.ranges.len());
    for (first, last) in &domains.ranges {
        if first.is_none() && last.is_none() {
            return Err(format!("line {line}: an id_range without min and max"));
        }
        let first = first.as_deref().map_or(Ok(0), number)?;
        ranges.push((first, last.as_deref().map_or(Ok(u32::MAX), number)?));
    }
    Ok(ranges)
}

/// Checks that there are no unknown elements.
///
/// # Errors
/// There is an unknown element.
fn known(unknown: &[UnknownElement]) -> Result<(), String> {
    match unknown.first() {
        None => Ok(()),
        Some(UnknownElement { name, line }) => {
            Err(format!("line {line}: element <{name}> is not known"))
        }
    }
}
