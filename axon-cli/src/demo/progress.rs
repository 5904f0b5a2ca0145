//! Progress on standard error: a bar on a terminal, else a line a step.

use std::{io::IsTerminal, time::Duration};

use indicatif::{ProgressBar, ProgressStyle};

use crate::say::say;

/// The demo's progress.
pub(crate) struct Progress {
    bar: ProgressBar,
    lines: bool,
    before: std::cell::Cell<u64>,
}

impl Progress {
    /// Over `total` messages.
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

    /// None at all.
    pub(crate) fn hidden() -> Self {
        Self { bar: ProgressBar::hidden(), lines: false, before: 0.into() }
    }

    /// What happens now.
    pub(crate) fn step(&self, what: &str, doing: &str) {
        if self.lines {
            say(format_args!("axon demo: {what}: {doing}"));
        }
        self.bar.set_message(format!("{what}: {doing}"));
    }

    /// So many messages of the current replay arrived.
    pub(crate) fn received(&self, messages: u64) {
        self.bar.set_position(self.before.get() + messages);
    }

    /// A replay of so many messages is over.
    pub(crate) fn finished(&self, messages: u64) {
        self.before.set(self.before.get() + messages);
        self.bar.set_position(self.before.get());
    }

    /// Takes the bar off the screen.
    pub(crate) fn clear(&self) {
        self.bar.finish_and_clear();
    }
}
