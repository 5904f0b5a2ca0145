//! Formats text for users: tables, times, sizes, and the beginning of payloads.

use std::fmt::Write as _;

use axon_transport::internal::text::{escaped, is_plain};

/// A text table with a header and rows. Each column is as wide as its widest cell.
pub(crate) struct TextTable {
    header: Vec<&'static str>,
    /// Whether each column is aligned to the right, as numbers are.
    right: Vec<bool>,
    rows: Vec<Vec<String>>,
}

impl TextTable {
    /// Creates an empty table. A header that starts with `>` aligns its column to the right.
    pub(crate) fn new(header: &[&'static str]) -> Self {
        Self {
            header: header.iter().map(|h| h.trim_start_matches('>')).collect(),
            right: header.iter().map(|h| h.starts_with('>')).collect(),
            rows: Vec::new(),
        }
    }

    /// Adds a row. Cells may come from a peer, so characters that could control a terminal are
    /// escaped.
    pub(crate) fn row(&mut self, cells: impl IntoIterator<Item = String>) {
        self.rows.push(cells.into_iter().map(|cell| printable(&cell)).collect());
    }

    /// Returns whether there are no rows.
    pub(crate) fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// Returns the lines of the table. Each is indented by `indent` spaces and ends with a newline.
    pub(crate) fn render(&self, indent: usize) -> String {
        let header: Vec<String> = self.header.iter().map(|h| (*h).to_owned()).collect();
        let width = |column: usize| {
            let cells = self.rows.iter().filter_map(|row| row.get(column));
            cells.chain(header.get(column)).map(|c| c.chars().count()).max().unwrap_or(0)
        };
        let widths: Vec<usize> = (0..header.len()).map(width).collect();
        let rule: Vec<String> = widths.iter().map(|w| "-".repeat(*w)).collect();
        let mut out = String::new();
        for row in [&header, &rule].into_iter().chain(&self.rows) {
            let mut line = " ".repeat(indent);
            for (column, width) in widths.iter().copied().enumerate() {
                let cell = row.get(column).map_or("", String::as_str);
                let gap = if column == 0 { "" } else { "  " };
                let _ = if self.right[column] {
                    write!(line, "{gap}{cell:>width$}")
                } else {
                    write!(line, "{gap}{cell:<width$}")
                };
            }
            out.push_str(line.trim_end());
            out.push('\n');
        }
        out
    }
}

/// Returns `text` with all characters escaped that could control a terminal.
pub(crate) fn printable(text: &str) -> String {
    escaped(text)
}

/// Returns a JSON text in which all characters are escaped that could control a terminal. Its
/// meaning does not change.
pub(crate) fn printable_json(json: &str) -> String {
    json.chars().fold(String::with_capacity(json.len()), |mut out, c| {
        if c == '\n' || is_plain(c) {
            out.push(c);
        } else {
            for unit in c.encode_utf16(&mut [0; 2]) {
                let _ = write!(out, "\\u{unit:04x}");
            }
        }
        out
    })
}

/// Formats an integer with its digits in groups of three.
pub(crate) fn grouped(number: u64) -> String {
    let digits = number.to_string();
    let mut out = String::with_capacity(digits.len() + digits.len() / 3);
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            out.push(',');
        }
        out.push(digit);
    }
    out
}

/// Formats a duration in a suitable unit with three digits.
pub(crate) fn duration(nanoseconds: u64) -> String {
    scaled(nanoseconds, &[(1_000_000_000, "s"), (1_000_000, "ms"), (1_000, "us"), (1, "ns")])
}

/// Formats a number of bytes in a suitable unit with three digits.
pub(crate) fn bytes(count: u64) -> String {
    scaled(count, &[(1_000_000_000, "GB"), (1_000_000, "MB"), (1_000, "kB"), (1, "B")])
}

fn scaled(value: u64, units: &[(u64, &str)]) -> String {
    let (unit, name) =
        units.iter().find(|(unit, _)| value >= *unit).or(units.last()).copied().unwrap_or((1, ""));
    let scaled = value as f64 / unit as f64;
    let decimals = match scaled {
        _ if unit == 1 => 0,
        s if s < 10.0 => 2,
        s if s < 100.0 => 1,
        _ => 0,
    };
    format!("{scaled:.decimals$} {name}")
}

/// Formats a time, given in nanoseconds since the Unix epoch, as RFC 3339 in UTC with microseconds.
pub(crate) fn instant(nanoseconds: i64) -> String {
    let seconds = nanoseconds.div_euclid(1_000_000_000);
    let micros = nanoseconds.rem_euclid(1_000_000_000) / 1_000;
    let (days, second) = (seconds.div_euclid(86_400), seconds.rem_euclid(86_400));
    let (year, month, day) = date(days);
    let (hour, minute, second) = (second / 3_600, second / 60 % 60, second % 60);
    format!("{year:04}-{month:02}-{day:02}T{hour:02}:{minute:02}:{second:02}.{micros:06}Z")
}

/// Returns the Gregorian date that is `days` after 1970-01-01.
///
/// The calculation uses years that begin in March, so that the leap day ends a year and the lengths
/// of months follow one linear rule.
fn date(days: i64) -> (i64, i64, i64) {
    const FROM_0000_03_01_TO_1970: i64 = 719_468;
    const DAYS_IN_400_YEARS: i64 = 146_097;
    let days = days + FROM_0000_03_01_TO_1970;
    let (cycle, in_cycle) =
        (days.div_euclid(DAYS_IN_400_YEARS), days.rem_euclid(DAYS_IN_400_YEARS));
    let leap_days = |day: i64| day / 1_460 - day / 36_524 + day / 146_096;
    let year_of_cycle = (in_cycle - leap_days(in_cycle)) / 365;
    let in_year = in_cycle - (year_of_cycle * 365 + year_of_cycle / 4 - year_of_cycle / 100);
    let march_month = (5 * in_year + 2) / 153;
    let day = in_year - (153 * march_month + 2) / 5 + 1;
    let month = if march_month < 10 { march_month + 3 } else { march_month - 9 };
    let year = cycle * 400 + year_of_cycle + i64::from(month <= 2);
    (year, month, day)
}

/// Formats the first bytes of a payload in hexadecimal.
pub(crate) fn hex(payload: &[u8], at_most: usize) -> String {
    let mut out = String::new();
    for (i, byte) in payload.iter().take(at_most).enumerate() {
        let gap = if i == 0 { "" } else { " " };
        let _ = write!(out, "{gap}{byte:02x}");
    }
    out
}

/// Formats the first bytes of a payload as ASCII, with a dot for each other byte.
pub(crate) fn ascii(payload: &[u8], at_most: usize) -> String {
    let visible = |b: &u8| if (0x20..0x7f).contains(b) { char::from(*b) } else { '.' };
    payload.iter().take(at_most).map(visible).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cell_cannot_steer_the_terminal() {
        let mut table = TextTable::new(&["topic", ">count"]);
        table.row(["\x1b[2Jgone\r\n".to_owned(), "7".to_owned()]);
        let text = table.render(2);
        assert!(!text.contains('\x1b') && !text.contains('\r'), "{text:?}");
        assert_eq!(text.lines().count(), 3);
    }

    #[test]
    fn bidirectional_marks_are_escaped_in_cells_and_in_json() {
        let name = "/a\u{2066}b\u{2069}\u{61c}\u{e0041}";
        assert_eq!(printable(name), "/a\\u{2066}b\\u{2069}\\u{61c}\\u{e0041}");
        let value = serde_json::json!({ "topic": name, "quoted": "\"\\" });
        let json = printable_json(&serde_json::to_string_pretty(&value).expect("serializable"));
        assert!(json.chars().all(|c| c == '\n' || is_plain(c)), "{json:?}");
        assert_eq!(serde_json::from_str::<serde_json::Value>(&json).expect("JSON"), value);
    }

    #[test]
    fn columns_line_up_and_a_short_row_is_filled() {
        let mut table = TextTable::new(&["name", ">n"]);
        table.row(["a".to_owned(), "1,234".to_owned()]);
        table.row(["longer".to_owned()]);
        let expected = "name        n\n------  -----\na       1,234\nlonger\n";
        assert_eq!(table.render(0), expected);
    }

    #[test]
    fn numbers_read_well() {
        let groups = [0, 999, 1_000, 1_234_567].map(grouped);
        assert_eq!(groups, ["0", "999", "1,000", "1,234,567"]);
        let times = [0, 999, 1_500, 12_345_678, 61_000_000_000].map(duration);
        assert_eq!(times, ["0 ns", "999 ns", "1.50 us", "12.3 ms", "61.0 s"]);
        assert_eq!([0, 1_000_000, 250_000_000].map(bytes), ["0 B", "1.00 MB", "250 MB"]);
    }

    #[test]
    fn instants_agree_with_known_dates() {
        for (seconds, text) in [
            (0, "1970-01-01T00:00:00.000000Z"),
            (-1, "1969-12-31T23:59:59.000000Z"),
            (951_782_400, "2000-02-29T00:00:00.000000Z"),
            (1_078_012_800, "2004-02-29T00:00:00.000000Z"),
            (1_735_689_599, "2024-12-31T23:59:59.000000Z"),
            (4_107_542_400, "2100-03-01T00:00:00.000000Z"),
        ] {
            assert_eq!(instant(seconds * 1_000_000_000), text);
        }
        assert_eq!(instant(i64::MAX), "2262-04-11T23:47:16.854775Z");
        assert_eq!(instant(i64::MIN), "1677-09-21T00:12:43.145224Z");
    }

    #[test]
    fn payload_heads_are_bounded_and_visible() {
        assert_eq!(hex(b"\x00A\xff and more", 3), "00 41 ff");
        assert_eq!(ascii(b"\x00A\xff~ more", 5), ".A.~ ");
        assert_eq!((hex(b"", 8), ascii(b"", 8)), (String::new(), String::new()));
    }
}
