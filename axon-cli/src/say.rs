//! Lines for people on standard error.

use std::{fmt::Display, io::Write as _};

/// Writes one line to standard error.
///
/// A standard error that is closed or full loses the line and ends nothing: `eprintln!` would panic.
pub(crate) fn say(line: impl Display) {
    let _ = writeln!(std::io::stderr().lock(), "{line}");
}
