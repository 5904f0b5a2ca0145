//! Progress on standard error: a bar on a terminal, else a line a step.

use std::io::IsTerminal;

use indicatif::{ProgressBar, ProgressStyle};

use crate::say::say;

/// A run's progress. Nothing moves while something is measured.
pub(crate) struct Progress {
    bar: ProgressBar,
    lines: bool,
}

impl Progress {
    /// Over so many loads.
    pub(crate) fn new(loads: usize) -> Self {
        let bar = ProgressBar::new(loads as u64);
        if let Ok(style) =
            ProgressStyle::with_template("{msg:48!} [{bar:30}] {pos}/{len} {elapsed}")
        {
            bar.set_style(style.progress_chars("=> "));
        }
        Self { bar, lines: !std::io::stderr().is_terminal() }
    }

    /// What is measured from now on.
    pub(crate) fn step(&self, what: &str) {
        if self.lines {
            say(what);
        }
        self.bar.set_message(what.to_owned());
    }

    /// A load is over.
    pub(crate) fn advance(&self) {
        self.bar.inc(1);
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        self.bar.finish_and_clear();
    }
}
