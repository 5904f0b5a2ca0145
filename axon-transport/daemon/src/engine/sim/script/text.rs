//! A script as text: one line for the run, one for each fault.
//!
//! ```text
//! seed=42 hosts=5
//! 1500ms partition hosts=0,2 for=800ms
//! 2s kill host=1 orderly=no for=1s
//! 2500us path from=0 to=1 delay=20ms jitter=5ms loss=400 duplicate=0 reorder=10 rate=125000
//! ```
//!
//! Empty lines and lines that begin with `#` are skipped. Order of the fields does not matter; none may be
//! left out but `for` and `rate`, none may be unknown.

use std::{collections::BTreeMap, fmt, str::FromStr, time::Duration};

use super::{Fault, Kind, KmeFailure, PathChange, Qos, Script};

impl fmt::Display for Script {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "seed={} hosts={}", self.seed, self.hosts)?;
        self.faults.iter().try_for_each(|fault| writeln!(f, "{fault}"))
    }
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {}", Time(self.at), self.kind)?;
        self.lasts.map_or(Ok(()), |lasts| write!(f, " for={}", Time(lasts)))
    }
}

impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Partition { hosts } => {
                let hosts: Vec<String> = hosts.iter().map(usize::to_string).collect();
                write!(f, "partition hosts={}", hosts.join(","))
            }
            Self::Cut { from, to } => write!(f, "cut from={from} to={to}"),
            Self::Kill { host, orderly } => {
                write!(f, "kill host={host} orderly={}", if *orderly { "yes" } else { "no" })
            }
            Self::Pause { host } => write!(f, "pause host={host}"),
            Self::Path { from, to, change } => {
                let PathChange { delay, jitter, loss, duplicate, reorder, rate } = change;
                write!(f, "path from={from} to={to} delay={}", Time(*delay))?;
                write!(f, " jitter={} loss={loss}", Time(*jitter))?;
                write!(f, " duplicate={duplicate} reorder={reorder}")?;
                rate.map_or(Ok(()), |rate| write!(f, " rate={rate}"))
            }
            Self::Rebind { host } => write!(f, "rebind host={host}"),
            Self::Move { host, interface } => write!(f, "move host={host} interface={interface}"),
            Self::InterfaceDown { host, interface } => {
                write!(f, "interface-down host={host} interface={interface}")
            }
            Self::Kme { host, failure } => write!(f, "kme host={host} failure={}", failure.name()),
            Self::Publisher { host, topic, qos } => {
                write!(f, "publisher host={host} topic={topic} qos={}", qos.name())
            }
            Self::Subscription { host, topic, qos } => {
                write!(f, "subscription host={host} topic={topic} qos={}", qos.name())
            }
            Self::Publish { host, topic, count, size, every } => {
                write!(f, "publish host={host} topic={topic} count={count} size={size}")?;
                write!(f, " every={}", Time(*every))
            }
        }
    }
}

impl FromStr for Script {
    type Err = String;

    /// # Errors
    /// Which line cannot be read, and why.
    fn from_str(text: &str) -> Result<Self, String> {
        let lines = text.lines().map(str::trim).enumerate();
        let mut lines = lines.filter(|(_, line)| !line.is_empty() && !line.starts_with('#'));
        let at_line = |n: usize| move |error: String| format!("line {}: {error}", n + 1);
        let (n, first) = lines.next().ok_or("the script is empty")?;
        let mut fields = Fields::new(first).map_err(at_line(n))?;
        let mut head = || {
            let head = (fields.number("seed")?, fields.number("hosts")?);
            fields.end().map(|()| head)
        };
        let (seed, hosts) = head().map_err(at_line(n))?;
        let mut script = Self { seed, hosts, faults: Vec::new() };
        for (n, line) in lines {
            script.faults.push(fault(line, hosts).map_err(at_line(n))?);
        }
        Ok(script)
    }
}

fn fault(line: &str, hosts: usize) -> Result<Fault, String> {
    let (at, rest) = line.split_once(' ').ok_or("a fault needs a time and a kind")?;
    let (kind, rest) = rest.trim_start().split_once(' ').ok_or("a fault needs fields")?;
    let mut fields = Fields::new(rest)?;
    let mut kind = kind_of(kind, &mut fields)?;
    let lasts = fields.optional("for", time)?;
    fields.end()?;
    if let Some(host) = kind.hosts_mut().into_iter().find(|host| **host >= hosts) {
        return Err(format!("host {host} of {hosts}"));
    }
    Ok(Fault { at: time(at)?, lasts, kind })
}

fn kind_of(kind: &str, fields: &mut Fields<'_>) -> Result<Kind, String> {
    Ok(match kind {
        "partition" => Kind::Partition {
            hosts: fields.read("hosts", |list| {
                let hosts = list.split(',').filter(|host| !host.is_empty());
                hosts.map(parsed).collect()
            })?,
        },
        "cut" => Kind::Cut { from: fields.number("from")?, to: fields.number("to")? },
        "kill" => Kind::Kill {
            host: fields.number("host")?,
            orderly: fields.read("orderly", |word| match word {
                "yes" => Ok(true),
                "no" => Ok(false),
                _ => Err(format!("`{word}` is not yes or no")),
            })?,
        },
        "pause" => Kind::Pause { host: fields.number("host")? },
        "path" => Kind::Path {
            from: fields.number("from")?,
            to: fields.number("to")?,
            change: PathChange {
                delay: fields.read("delay", time)?,
                jitter: fields.read("jitter", time)?,
                loss: fields.read("loss", thousandths)?,
                duplicate: fields.read("duplicate", thousandths)?,
                reorder: fields.read("reorder", thousandths)?,
                rate: fields.optional("rate", parsed)?,
            },
        },
        "rebind" => Kind::Rebind { host: fields.number("host")? },
        "move" => {
            Kind::Move { host: fields.number("host")?, interface: fields.number("interface")? }
        }
        "interface-down" => Kind::InterfaceDown {
            host: fields.number("host")?,
            interface: fields.number("interface")?,
        },
        "kme" => Kind::Kme {
            host: fields.number("host")?,
            failure: fields.read("failure", |name| named(name, &KmeFailure::ALL, |f| f.name()))?,
        },
        "publisher" => Kind::Publisher {
            host: fields.number("host")?,
            topic: fields.number("topic")?,
            qos: fields.read("qos", |name| named(name, &Qos::ALL, |q| q.name()))?,
        },
        "subscription" => Kind::Subscription {
            host: fields.number("host")?,
            topic: fields.number("topic")?,
            qos: fields.read("qos", |name| named(name, &Qos::ALL, |q| q.name()))?,
        },
        "publish" => Kind::Publish {
            host: fields.number("host")?,
            topic: fields.number("topic")?,
            count: fields.number("count")?,
            size: fields.number("size")?,
            every: fields.read("every", time)?,
        },
        _ => return Err(format!("`{kind}` is no kind of fault")),
    })
}

impl KmeFailure {
    /// All failures.
    pub(crate) const ALL: [Self; 6] =
        [Self::Unreachable, Self::Silent, Self::Slow, Self::Error, Self::Exhausted, Self::WrongKey];

    fn name(self) -> &'static str {
        match self {
            Self::Unreachable => "unreachable",
            Self::Silent => "silent",
            Self::Slow => "slow",
            Self::Error => "error",
            Self::Exhausted => "exhausted",
            Self::WrongKey => "wrong-key",
        }
    }
}

impl Qos {
    /// All profiles.
    pub(crate) const ALL: [Self; 4] =
        [Self::BestEffort, Self::ReliableKeepLast, Self::ReliableKeepAll, Self::TransientLocal];

    fn name(self) -> &'static str {
        match self {
            Self::BestEffort => "best-effort",
            Self::ReliableKeepLast => "reliable-keep-last",
            Self::ReliableKeepAll => "reliable-keep-all",
            Self::TransientLocal => "transient-local",
        }
    }
}

/// The `name=value` fields of a line that have not been read.
struct Fields<'a>(BTreeMap<&'a str, &'a str>);

impl<'a> Fields<'a> {
    fn new(line: &'a str) -> Result<Self, String> {
        let mut fields = BTreeMap::new();
        for word in line.split_whitespace() {
            let (name, value) = word.split_once('=').ok_or(format!("`{word}` has no `=`"))?;
            if fields.insert(name, value).is_some() {
                return Err(format!("`{name}` stands there twice"));
            }
        }
        Ok(Self(fields))
    }

    fn optional<T>(
        &mut self,
        name: &str,
        read: impl FnOnce(&str) -> Result<T, String>,
    ) -> Result<Option<T>, String> {
        let value = self.0.remove(name).map(read).transpose();
        value.map_err(|error| format!("{name}: {error}"))
    }

    fn read<T>(
        &mut self,
        name: &str,
        read: impl FnOnce(&str) -> Result<T, String>,
    ) -> Result<T, String> {
        self.optional(name, read)?.ok_or(format!("`{name}` is missing"))
    }

    fn number<T: FromStr<Err: fmt::Display>>(&mut self, name: &str) -> Result<T, String> {
        self.read(name, parsed)
    }

    fn end(&self) -> Result<(), String> {
        self.0.keys().next().map_or(Ok(()), |name| Err(format!("`{name}` is unknown here")))
    }
}

fn parsed<T: FromStr<Err: fmt::Display>>(value: &str) -> Result<T, String> {
    value.parse().map_err(|error| format!("`{value}`: {error}"))
}

fn thousandths(value: &str) -> Result<u16, String> {
    let number = parsed(value)?;
    if number <= 1_000 {
        Ok(number)
    } else {
        Err(format!("{number} thousandths are more than all"))
    }
}

fn named<T: Copy>(name: &str, all: &[T], name_of: impl Fn(T) -> &'static str) -> Result<T, String> {
    let found = all.iter().find(|one| name_of(**one) == name);
    found.copied().ok_or(format!("`{name}` is unknown"))
}

/// Prints a time in the largest unit that leaves a whole number.
struct Time(Duration);

const UNITS: [(&str, u128); 4] =
    [("ns", 1), ("us", 1_000), ("ms", 1_000_000), ("s", 1_000_000_000)];

impl fmt::Display for Time {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let nanos = self.0.as_nanos();
        let unit = UNITS.iter().rev().find(|(_, unit)| nanos.is_multiple_of(*unit));
        let (name, unit) = unit.expect("1 ns divides every time");
        write!(f, "{}{name}", nanos / unit)
    }
}

fn time(text: &str) -> Result<Duration, String> {
    let digits = text.find(|c: char| !c.is_ascii_digit()).unwrap_or(text.len());
    let (number, name) = text.split_at(digits);
    let unit = UNITS.iter().find(|(unit, _)| *unit == name);
    let (_, unit) = unit.ok_or(format!("`{text}` has no unit of s, ms, us, ns"))?;
    let nanos = parsed::<u64>(number)?.checked_mul(*unit as u64);
    nanos.map(Duration::from_nanos).ok_or(format!("`{text}` is too long"))
}
