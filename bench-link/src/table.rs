//! A table that shows each row as soon as it is measured.

use std::io::{self, Write};

use crate::Result;

/// A table of text. Its columns are as wide as their headers, and no narrower than eight.
pub(crate) struct Table {
    /// Width, and whether it is set to the right, as numbers are.
    columns: Vec<(usize, bool)>,
}

impl Table {
    /// Prints the header. One that starts with `>` sets its column to the right.
    pub(crate) fn new(header: &[&str]) -> Self {
        let column =
            |name: &&str| (name.trim_start_matches('>').len().max(8), name.starts_with('>'));
        let mut columns: Vec<(usize, bool)> = header.iter().map(column).collect();
        // The first one names the row.
        columns[0].0 = columns[0].0.max(18);
        let table = Self { columns };
        let names = header.iter().map(|name| name.trim_start_matches('>').to_owned());
        let _ = table.row(names);
        let _ = table.row(table.columns.iter().map(|(width, _)| "-".repeat(*width)));
        table
    }

    pub(crate) fn row(&self, cells: impl IntoIterator<Item = String>) -> Result<()> {
        let mut line = String::new();
        for ((width, is_right), cell) in self.columns.iter().zip(cells) {
            line +=
                &if *is_right { format!("{cell:>width$}  ") } else { format!("{cell:<width$}  ") };
        }
        let mut out = io::stdout().lock();
        writeln!(out, "{}", line.trim_end())?;
        Ok(out.flush()?)
    }
}
