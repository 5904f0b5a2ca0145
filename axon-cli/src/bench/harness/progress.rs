//! Shows progress on standard error: a bar on a terminal, otherwise a line for each step.

use std::io::IsTerminal;

use indicatif::{ProgressBar, ProgressStyle};

use crate::say::say;

/// The progress of a run. The display does not change during a measurement.
pub(crate) struct Progress {
    bar: ProgressBar,
    lines: bool,
}

impl Progress {
    /// Starts the display of a run with this number of loads.
    pub(crate) fn new(loads: usize) -> Self {
        let bar = ProgressBar::new(loads as u64);
        if let Ok(style) =
            ProgressStyle::with_template("{msg:48!} [{bar:30}] {pos}/{len} {elapsed}")
        {
            bar.set_style(style.progress_chars("=> "));
        }
        Self { bar, lines: !std::io::stderr().is_terminal() }
    }

    /// Shows the measurement that begins now.
    pub(crate) fn step(&self, what: &str) {
        if self.lines {
            say(what);
        }
        self.bar.set_message(what.to_owned());
    }

    /// Counts a load as measured.
    pub(crate) fn advance(&self) {
        self.bar.inc(1);
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        self.bar.finish_and_clear();
    }
}
