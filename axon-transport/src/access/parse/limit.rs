//! Parses `[[limit]]`.

use std::{collections::BTreeSet, num::NonZeroU32, ops::Range, sync::Arc};

use toml::de::{DeTable, DeValue};

use super::{AccessError, RuleFileReader, Value};
use crate::access::{
    TopicPattern, Verb,
    limit::{EgressLimit, InterfaceLimit, LimitKind, LimitRule, Overflow, PlacedLimit, RateLimit},
    party::PartyPattern,
};

/// The lowest and the highest rate, per second.
const RATES: (f64, f64) = (0.01, 1e6);
/// The lowest and the highest number of bytes per second.
const BYTES: (f64, f64) = (1.0, 1e12);
/// Maximum number of patterns in all limits. A route is compared with each of them.
const MOST_LIMITED: usize = 1024;
/// The lowest egress limit, in bytes per second.
const LEAST_EGRESS: f64 = 1e4;
/// Units of `bytes`, in bytes.
const UNITS: [(&str, f64); 10] = [
    ("B/s", 1.0),
    ("kB/s", 1e3),
    ("MB/s", 1e6),
    ("GB/s", 1e9),
    ("KiB/s", 1024.0),
    ("MiB/s", 1_048_576.0),
    ("GiB/s", 1_073_741_824.0),
    ("kbit/s", 125.0),
    ("Mbit/s", 125e3),
    ("Gbit/s", 125e6),
];
/// The default burst of a limit. Samples of a topic that keeps to the rate do not arrive at exact times.
const TWO: NonZeroU32 = NonZeroU32::MIN.saturating_add(1);
const NO_USER: &str = "names of hosts: samples within a host have no limits";

/// Parses bytes per second, such as `4 MB/s`.
///
/// # Errors
/// The accepted values.
pub(crate) fn bytes_a_second(text: &str) -> Result<f64, &'static str> {
    const ACCEPTED: &str = "a number and B/s, kB/s, MB/s, GB/s, KiB/s, MiB/s, GiB/s, kbit/s, Mbit/s or Gbit/s, from \
                            1 B/s to 1000 GB/s";
    let at = text.find(|c: char| c.is_ascii_alphabetic()).ok_or(ACCEPTED)?;
    let (number, unit) = text.split_at(at);
    let of_unit = UNITS.iter().find(|(known, _)| *known == unit).ok_or(ACCEPTED)?.1;
    let number = number.trim_end();
    let is_plain = number.chars().all(|c| c.is_ascii_digit() || c == '.');
    let value: f64 = number.parse().ok().filter(|_| is_plain).ok_or(ACCEPTED)?;
    let bytes = value * of_unit;
    (BYTES.0..=BYTES.1).contains(&bytes).then_some(bytes).ok_or(ACCEPTED)
}

/// Parses a rate, written as an integer or a float of TOML.
///
/// # Errors
/// The accepted values.
pub(crate) fn rate(text: &str) -> Result<f64, &'static str> {
    let rate = text.replace('_', "").parse().ok();
    let rate = rate.filter(|rate| (RATES.0..=RATES.1).contains(rate));
    rate.ok_or("a number from 0.01 to 1000000")
}

/// The longest name of an interface, in bytes (IFNAMSIZ without its NUL).
const LONGEST_NAME: usize = 15;
/// Maximum number of interfaces that an entry names.
const MOST_INTERFACES: usize = 64;

/// All `[[limit]]` entries of a file.
#[derive(Default)]
pub(super) struct Entries {
    /// The limits of peers.
    pub(super) peers: Vec<LimitRule>,
    /// The limits of interfaces.
    pub(super) interfaces: Vec<InterfaceLimit>,
}

impl Entries {
    pub(super) fn is_empty(&self) -> bool {
        self.peers.is_empty() && self.interfaces.is_empty()
    }
}

/// One `[[limit]]` entry.
enum LimitEntry {
    Peer(LimitRule),
    Interface(InterfaceLimit),
}

/// The values of an entry by key.
#[derive(Default)]
struct Parts {
    peers: Vec<PartyPattern>,
    interfaces: Vec<String>,
    uses: Vec<(Verb, TopicPattern)>,
    rate: Option<f64>,
    bytes: Option<f64>,
    burst: Option<NonZeroU32>,
    over: Option<Overflow>,
    together: Option<bool>,
    egress: Option<f64>,
}

impl RuleFileReader<'_> {
    pub(super) fn limits(&mut self, value: &Value<'_>) -> Result<Entries, AccessError> {
        let mut entries = Entries::default();
        for (table, span) in self.tables(value, "[[limit]]")? {
            match self.limit(table, span)? {
                LimitEntry::Peer(rule) => entries.peers.push(rule),
                LimitEntry::Interface(limit) => entries.interfaces.push(limit),
            }
        }
        Ok(entries)
    }

    fn limit(
        &mut self,
        table: &DeTable<'_>,
        span: Range<usize>,
    ) -> Result<LimitEntry, AccessError> {
        let mut parts = Parts::default();
        for (key, value) in table {
            let (key_span, key) = (key.span(), &**key.get_ref());
            let wrong = |read: &dyn std::fmt::Display, what: &str| {
                self.wrong(value.span(), format!("{key} = {read}; accepted: {what}"))
            };
            match (key, value.get_ref()) {
                ("peer", _) => {
                    for (text, value) in self.strings(key, value)? {
                        let peer = PartyPattern::parse(text).and_then(|peer| match peer {
                            PartyPattern::Users | PartyPattern::User(_) => Err(NO_USER),
                            peer => Ok(peer),
                        });
                        let wrong = |what| {
                            self.wrong(value.span(), format!("peer {text:?}; accepted: {what}"))
                        };
                        parts.peers.push(peer.map_err(wrong)?);
                    }
                }
                ("interface", _) => {
                    for (text, value) in self.strings(key, value)? {
                        let wrong = |what| {
                            self.wrong(
                                value.span(),
                                format!("interface {text:?}; accepted: {what}"),
                            )
                        };
                        parts.interfaces.push(interface(text).map_err(wrong)?);
                    }
                    if parts.interfaces.len() > MOST_INTERFACES {
                        let what = format!("at most {MOST_INTERFACES} interfaces in a [[limit]]");
                        return Err(self.wrong(value.span(), what));
                    }
                }
                ("topic" | "publish" | "subscribe" | "call", _) => {
                    let verbs: &[Verb] = match key {
                        "topic" => &[Verb::Publish, Verb::Subscribe],
                        "publish" => &[Verb::Publish],
                        "subscribe" => &[Verb::Subscribe],
                        _ => &[Verb::Call],
                    };
                    let mut uses = Vec::new();
                    for (text, value) in self.strings(key, value)? {
                        let wrong = |what| {
                            self.wrong(value.span(), format!("{key} {text:?}; accepted: {what}"))
                        };
                        let pattern = TopicPattern::new(text).map_err(wrong)?;
                        uses.extend(verbs.iter().map(|verb| (*verb, pattern.clone())));
                    }
                    self.count_patterns(uses.len(), value)?;
                    self.limited += uses.len();
                    if self.limited > MOST_LIMITED {
                        let what = format!("at most {MOST_LIMITED} patterns in all [[limit]]");
                        return Err(self.wrong(value.span(), what));
                    }
                    parts.uses.append(&mut uses);
                }
                ("rate", DeValue::Integer(number)) if number.radix() == 10 => {
                    let text = number.as_str();
                    parts.rate = Some(rate(text).map_err(|what| wrong(&text, what))?);
                }
                ("rate", DeValue::Float(number)) => {
                    let text = number.as_str();
                    parts.rate = Some(rate(text).map_err(|what| wrong(&text, what))?);
                }
                ("bytes", DeValue::String(text)) => {
                    let bytes = bytes_a_second(text);
                    parts.bytes = Some(bytes.map_err(|what| wrong(&format!("{text:?}"), what))?);
                }
                ("egress", DeValue::String(text)) => {
                    let bytes = bytes_a_second(text);
                    // Below this rate, a handshake that follows would not complete.
                    let bytes = bytes.and_then(|bytes| match bytes >= LEAST_EGRESS {
                        true => Ok(bytes),
                        false => Err("10 kB/s at least"),
                    });
                    parts.egress = Some(bytes.map_err(|what| wrong(&format!("{text:?}"), what))?);
                }
                ("burst", DeValue::Integer(number)) if number.radix() == 10 => {
                    let text = number.as_str();
                    let burst = text.parse::<NonZeroU32>().ok();
                    let burst = burst.filter(|burst| burst.get() <= 100_000);
                    let accepted = "a whole number from 1 to 100000";
                    parts.burst = Some(burst.ok_or_else(|| wrong(&text, accepted))?);
                }
                ("over", DeValue::String(text)) => {
                    let over = Overflow::ALL.into_iter().find(|over| over.name() == text);
                    let accepted = "drop-oldest, drop-newest, hold";
                    let wrong = || wrong(&format!("{text:?}"), accepted);
                    parts.over = Some(over.ok_or_else(wrong)?);
                }
                ("together", DeValue::Boolean(together)) => parts.together = Some(*together),
                ("rate", _) => return Err(wrong(&"something else", "a number, in decimal")),
                ("burst", _) => return Err(wrong(&"something else", "a whole number, in decimal")),
                ("bytes" | "egress", _) => {
                    return Err(wrong(&"something else", "a string, such as \"4 MB/s\""));
                }
                ("over", _) => return Err(wrong(&"something else", "a string")),
                ("together", _) => return Err(wrong(&"something else", "true, false")),
                _ => {
                    let what = format!(
                        "unknown key {key:?}; accepted: peer, interface, topic, publish, subscribe, call, rate, bytes, burst, \
                         over, together, egress"
                    );
                    return Err(self.wrong(key_span, what));
                }
            }
        }
        let line = self.wrong(span.clone(), "").line;
        self.whole(parts, line).map_err(|what| self.wrong(span, what))
    }

    /// Builds an entry from its values.
    ///
    /// # Errors
    /// A value is missing, or values exclude each other.
    fn whole(&self, parts: Parts, line: u32) -> Result<LimitEntry, &'static str> {
        let Parts { peers, interfaces, mut uses, rate, bytes, burst, over, together, egress } =
            parts;
        let is_of_interfaces = !interfaces.is_empty();
        if is_of_interfaces && (!peers.is_empty() || egress.is_none()) {
            return Err(
                "[[limit]] of an interface: it is about all that leaves there, write interface and egress alone",
            );
        }
        if peers.is_empty() && !is_of_interfaces {
            return Err("[[limit]] without peer: write the names it is about, or peer = \"*\"");
        }
        if let Some(egress) = egress {
            let others = [rate.is_some(), bytes.is_some(), burst.is_some(), over.is_some()];
            if !uses.is_empty() || together.is_some() || others.contains(&true) {
                return Err(
                    "[[limit]] of egress: it is about all that is sent, write egress with peer or interface alone",
                );
            }
            let limit = EgressLimit { bytes: egress, file: Arc::clone(&self.file), line };
            return Ok(match is_of_interfaces {
                true => LimitEntry::Interface(InterfaceLimit { interfaces, limit }),
                false => LimitEntry::Peer(LimitRule { peers, limits: LimitKind::Egress(limit) }),
            });
        }
        if rate.is_none() && bytes.is_none() {
            return Err("[[limit]] without rate, bytes and egress: write at least one of them");
        }
        let calls = uses.iter().any(|(verb, _)| *verb == Verb::Call);
        if calls
            && (over != Some(Overflow::Hold) || uses.iter().any(|(verb, _)| *verb != Verb::Call))
        {
            return Err(
                "[[limit]] of call: write over = \"hold\", since no request is dropped, and no topic",
            );
        }
        // Without topics, the limit applies to all samples that the peer sends and receives.
        let is_of_peer = uses.is_empty();
        if is_of_peer {
            let all = TopicPattern::new("**").map_err(|_| "** is a pattern")?;
            uses = vec![(Verb::Publish, all.clone()), (Verb::Subscribe, all)];
        }
        let limit = RateLimit {
            rate,
            bytes,
            burst: burst.unwrap_or(TWO),
            overflow: over.unwrap_or_default(),
            together: together.unwrap_or(is_of_peer),
        };
        let names: BTreeSet<_> = uses.iter().map(|(_, pattern)| pattern.to_string()).collect();
        let names = names.into_iter().collect::<Vec<_>>().join(", ").into();
        let limit = PlacedLimit { limit, names, file: Arc::clone(&self.file), line };
        Ok(LimitEntry::Peer(LimitRule { peers, limits: LimitKind::Uses(uses, limit) }))
    }
}

/// Returns `text` if it is the name of an interface, or a pattern of names.
///
/// # Errors
/// The accepted values.
fn interface(text: &str) -> Result<String, &'static str> {
    let is_name = |c: char| c.is_ascii_graphic() && c != '/';
    let fits = (1..=LONGEST_NAME).contains(&text.len()) && text.chars().all(is_name);
    fits.then(|| text.to_owned())
        .ok_or("the name of a network interface as `ip link` shows it, of 1 to 15 bytes, in which * stands for any characters")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_a_second_have_a_unit() {
        for (text, bytes) in [
            ("4 MB/s", 4e6),
            ("1.5kB/s", 1500.0),
            ("2 MiB/s", 2_097_152.0),
            ("54 Mbit/s", 6.75e6),
            ("1 B/s", 1.0),
        ] {
            assert_eq!(bytes_a_second(text), Ok(bytes), "{text}");
        }
        for text in [
            "",
            "4",
            "4 MB",
            "MB/s",
            "-1 MB/s",
            "0 B/s",
            "inf MB/s",
            "nan B/s",
            "1e3 B/s",
            "4 mb/s",
            "4 MB/s ",
            " 4 MB/s",
            "1001 GB/s",
            "0.5 B/s",
            "1..2 MB/s",
            "४ MB/s",
        ] {
            assert!(bytes_a_second(text).is_err(), "{text:?}");
        }
    }

    #[test]
    fn a_rate_is_a_number_within_bounds() {
        assert_eq!((rate("30"), rate("0.5"), rate("1_000")), (Ok(30.0), Ok(0.5), Ok(1000.0)));
        for text in ["0", "-1", "inf", "nan", "0.001", "1000001", "0x10", "1e400"] {
            assert!(rate(text).is_err(), "{text}");
        }
    }
}
