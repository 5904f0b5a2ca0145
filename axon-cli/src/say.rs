//! Writes lines for users to standard error.

use std::{fmt::Display, io::Write as _};

use crate::text::printable;

/// Writes one or several lines to standard error. They may quote a peer or a file, so characters that could control a
/// terminal are escaped.
///
/// If standard error is closed or full, the line is lost and the process continues; `eprintln!` would panic.
pub(crate) fn say(line: impl Display) {
    let text = line.to_string();
    let lines: Vec<String> = text.split('\n').map(printable).collect();
    let _ = writeln!(std::io::stderr().lock(), "{}", lines.join("\n"));
}
