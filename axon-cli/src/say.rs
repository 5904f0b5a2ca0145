//! Lines for people on standard error.

use std::{fmt::Display, io::Write as _};

use crate::text::printable;

/// Writes a line, or several, to standard error. They may quote a peer or a file: what could steer a
/// terminal is escaped.
///
/// A standard error that is closed or full loses the line and ends nothing: `eprintln!` would panic.
pub(crate) fn say(line: impl Display) {
    let text = line.to_string();
    let lines: Vec<String> = text.split('\n').map(printable).collect();
    let _ = writeln!(std::io::stderr().lock(), "{}", lines.join("\n"));
}
