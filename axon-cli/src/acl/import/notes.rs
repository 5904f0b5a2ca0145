//! Differences between a document and the rules that are made from it.

use std::collections::{BTreeMap, BTreeSet};

use crate::text::printable;

/// The effect of a difference.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Effect {
    /// The rules allow more than the document.
    More,
    /// The rules allow less than the document.
    Less,
    /// The rules allow as much as the document.
    None,
}

/// Differences, each with the lines of the document that it concerns.
#[derive(Debug, Default)]
pub(super) struct Notes(BTreeMap<(Effect, String), BTreeSet<u32>>);

impl Notes {
    /// Adds a difference. Line 0 stands for the whole document.
    pub(super) fn add(&mut self, effect: Effect, line: u32, what: impl Into<String>) {
        self.0.entry((effect, what.into())).or_default().insert(line);
    }

    /// Returns one line for each difference. Names are escaped, so no name can end the line.
    pub(super) fn lines(&self) -> impl Iterator<Item = String> {
        self.0.iter().map(|((effect, what), lines)| {
            let effect = match effect {
                Effect::More => "allows more",
                Effect::Less => "allows less",
                Effect::None => "note",
            };
            let shown: Vec<_> = lines.iter().take(5).map(u32::to_string).collect();
            let place = match (lines.len() - shown.len(), lines.contains(&0)) {
                (_, true) => String::new(),
                (0, _) => format!("line {}: ", shown.join(", ")),
                (more, _) => format!("line {} and {more} more: ", shown.join(", ")),
            };
            printable(&format!("{effect}: {place}{what}"))
        })
    }
}
