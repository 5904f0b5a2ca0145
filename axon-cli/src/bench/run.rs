//! Describes the run in every report: the machine, and how the figures were obtained.

use serde_json::{Value, json};

use super::harness::{self, Effort, Machine};

/// A run of one benchmark.
pub(super) struct Run {
    pub(super) machine: Machine,
    pub(super) effort: Effort,
    quick: bool,
}

impl Run {
    pub(super) fn start(quick: bool) -> harness::Result<Self> {
        let effort = if quick { Effort::QUICK } else { Effort::FULL };
        Ok(Self { machine: Machine::look()?, effort, quick })
    }

    /// Returns the text above the tables. `reported` explains how figures are obtained.
    pub(super) fn heading(&self, reported: &str) -> String {
        let mut out = format!("{}\n{reported}\n", self.machine.line());
        if self.quick {
            out += "A quick run: its figures are good for nothing.\n";
        }
        out
    }

    /// Returns the results of `axon bench NAME` as JSON: the description of the run, and `figures`.
    pub(super) fn document<const N: usize>(
        &self,
        name: &str,
        reported: &str,
        figures: [(&str, Value); N],
    ) -> String {
        let mut document = json!({
            "benchmark": format!("axon bench {name}"),
            "version": env!("CARGO_PKG_VERSION"),
            "optimized": !cfg!(debug_assertions),
            "quick": self.quick,
            "reported": reported,
            "machine": self.machine,
            "rounds": self.effort.rounds,
        });
        for (name, value) in figures {
            document[name] = value;
        }
        format!("{document:#}\n")
    }
}
