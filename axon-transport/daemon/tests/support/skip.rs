//! What cannot be tried here is not passed over in silence.

use std::{fmt::Display, io::Write as _};

/// Says why, past the harness, which would show it only beside a failure.
pub(crate) fn skip(why: impl Display) {
    let _ = writeln!(std::io::stderr(), "skipped: {why}");
}
