//! Shows progress on standard error: a bar on a terminal, otherwise a line for each step.

use std::{io::IsTerminal, time::Duration};

use indicatif::{ProgressBar, ProgressStyle};

use crate::say::say;

/// The progress of the demo.
pub(crate) struct Progress {
    bar: ProgressBar,
    lines: bool,
    before: std::cell::Cell<u64>,
}

impl Progress {
    /// Starts the display for `total` messages.
    pub(crate) fn new(total: u64) -> Self {
        if !std::io::stderr().is_terminal() {
            return Self { lines: true, ..Self::hidden() };
        }
        let bar = ProgressBar::new(total);
        if let Ok(style) = ProgressStyle::with_template(
            "{spinner} {msg:48!} [{bar:30}] {human_pos}/{human_len} {elapsed_precise}",
        ) {
            bar.set_style(style.progress_chars("=> "));
        }
        bar.enable_steady_tick(Duration::from_millis(120));
        Self { bar, lines: false, before: 0.into() }
    }

    /// Returns a display that shows nothing.
    pub(crate) fn hidden() -> Self {
        Self { bar: ProgressBar::hidden(), lines: false, before: 0.into() }
    }

    /// Shows the current step.
    pub(crate) fn step(&self, what: &str, doing: &str) {
        if self.lines {
            say(format_args!("axon demo: {what}: {doing}"));
        }
        self.bar.set_message(format!("{what}: {doing}"));
    }

    /// Shows how many messages of the current replay have arrived.
    pub(crate) fn received(&self, messages: u64) {
        self.bar.set_position(self.before.get() + messages);
    }

    /// Adds a finished replay of this number of messages.
    pub(crate) fn finished(&self, messages: u64) {
        self.before.set(self.before.get() + messages);
        self.bar.set_position(self.before.get());
    }

    /// Removes the bar from the screen.
    pub(crate) fn clear(&self) {
        self.bar.finish_and_clear();
    }
}
