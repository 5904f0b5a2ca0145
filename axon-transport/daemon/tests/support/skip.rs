//! Reports tests that cannot run here.

use std::{fmt::Display, io::Write as _};

/// Prints the reason directly: the harness would show it only for a failed test.
pub(crate) fn skip(why: impl Display) {
    let _ = writeln!(std::io::stderr(), "skipped: {why}");
}
