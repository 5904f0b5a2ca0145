//! The result of a case: a line of the table.

use std::fmt;

#[derive(Clone, Debug)]
pub(crate) struct Report {
    pub(crate) name: String,
    /// The process that dies.
    pub(crate) dies: String,
    /// The number of instructions, or of other steps.
    pub(crate) instructions: String,
    pub(crate) states: String,
    pub(crate) kills: usize,
    /// Number of kills after which the operation's sample was visible.
    pub(crate) shown: usize,
    /// The reason why there were no kills.
    pub(crate) skipped: String,
}

impl Report {
    pub(crate) fn skipped(name: &str, why: &str) -> Self {
        let empty = String::new;
        Self {
            name: name.to_owned(),
            dies: empty(),
            instructions: empty(),
            states: empty(),
            kills: 0,
            shown: 0,
            skipped: why.to_owned(),
        }
    }

    pub(crate) fn heading() -> String {
        format!(
            "{:<46} {:>9} {:>14} {:>7} {:>7} {:>7}",
            "operation", "dies", "instructions", "states", "kills", "shown"
        )
    }

    /// Returns the line in which a worker sends the report.
    pub(crate) fn line(&self) -> String {
        let Self { name, dies, instructions, states, kills, shown, skipped } = self;
        format!("done\t{name}\t{dies}\t{instructions}\t{states}\t{kills}\t{shown}\t{skipped}")
    }

    pub(crate) fn parse(line: &str) -> Option<Self> {
        let fields: Vec<&str> = line.strip_prefix("done\t")?.split('\t').collect();
        let [name, dies, instructions, states, kills, shown, skipped] = fields[..] else {
            return None;
        };
        let [name, dies, instructions, states, skipped] =
            [name, dies, instructions, states, skipped].map(str::to_owned);
        let (kills, shown) = (kills.parse().ok()?, shown.parse().ok()?);
        Some(Self { name, dies, instructions, states, kills, shown, skipped })
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { name, dies, instructions, states, kills, shown, skipped } = self;
        if !skipped.is_empty() {
            return write!(f, "{name:<46} skipped: {skipped}");
        }
        write!(f, "{name:<46} {dies:>9} {instructions:>14} {states:>7} {kills:>7} {shown:>7}")
    }
}
