//! The results of the probe as a table.

use std::fmt;

/// The result of one check.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Verdict {
    Pass,
    Fail,
    /// The answer is against the specification, but a client with these quirks works.
    Tolerated(Vec<&'static str>),
    Skipped(String),
    /// The specification does not require it, or is not clear about it.
    Note,
}

impl fmt::Display for Verdict {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Pass => f.write_str("pass"),
            Self::Fail => f.write_str("FAIL"),
            Self::Tolerated(names) => write!(f, "tolerated by quirk {}", names.join(",")),
            Self::Skipped(why) => write!(f, "skipped: {why}"),
            Self::Note => f.write_str("note"),
        }
    }
}

struct Row {
    clause: &'static str,
    expected: String,
    came: String,
    verdict: Verdict,
}

/// The rows of the table, in the order of the checks.
#[derive(Default)]
pub(super) struct Report {
    rows: Vec<Row>,
}

impl Report {
    pub(super) fn row(
        &mut self,
        clause: &'static str,
        expected: impl Into<String>,
        came: impl AsRef<str>,
        verdict: Verdict,
    ) {
        let came = shown(came.as_ref());
        self.rows.push(Row { clause, expected: expected.into(), came, verdict });
    }

    pub(super) fn check(
        &mut self,
        clause: &'static str,
        expected: impl Into<String>,
        came: impl AsRef<str>,
        passed: bool,
    ) {
        let verdict = if passed { Verdict::Pass } else { Verdict::Fail };
        self.row(clause, expected, came, verdict);
    }

    pub(super) fn skip(&mut self, clause: &'static str, expected: impl Into<String>, why: &str) {
        self.row(clause, expected, "-", Verdict::Skipped(why.to_owned()));
    }

    /// Returns whether no check failed and none needed a quirk.
    pub(super) fn passed(&self) -> bool {
        let bad = |row: &Row| matches!(row.verdict, Verdict::Fail | Verdict::Tolerated(_));
        !self.rows.iter().any(bad)
    }

    fn count(&self, of: impl Fn(&Verdict) -> bool) -> usize {
        self.rows.iter().filter(|row| of(&row.verdict)).count()
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let width = |of: fn(&Row) -> &str, head: &str| {
            let longest = self.rows.iter().map(|row| of(row).chars().count()).max();
            longest.unwrap_or(0).max(head.len())
        };
        let clause = width(|row| row.clause, "clause");
        let expected = width(|row| &row.expected, "expected");
        let came = width(|row| &row.came, "came");
        writeln!(f, "{:clause$}  {:expected$}  {:came$}  verdict", "clause", "expected", "came")?;
        for row in &self.rows {
            let Row { clause: c, expected: e, came: g, verdict } = row;
            writeln!(f, "{c:clause$}  {e:expected$}  {g:came$}  {verdict}")?;
        }
        writeln!(
            f,
            "{} passed, {} failed, {} tolerated, {} skipped, {} noted",
            self.count(|v| *v == Verdict::Pass),
            self.count(|v| *v == Verdict::Fail),
            self.count(|v| matches!(v, Verdict::Tolerated(_))),
            self.count(|v| matches!(v, Verdict::Skipped(_))),
            self.count(|v| *v == Verdict::Note),
        )
    }
}

/// Escapes and truncates a KME's text, so that it is safe for a terminal.
fn shown(text: &str) -> String {
    const MOST: usize = 100;
    let shaped = |c: char| matches!(c, '"' | '\'' | '\\') || c.escape_debug().len() == 1;
    let plain = |c: char| if shaped(c) { c } else { '\u{fffd}' };
    let mut out: String = text.chars().take(MOST).map(plain).collect();
    if text.chars().nth(MOST).is_some() {
        out.push_str("...");
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_pass_passes() {
        for (verdict, passed) in [
            (Verdict::Pass, true),
            (Verdict::Note, true),
            (Verdict::Skipped("x".into()), true),
            (Verdict::Tolerated(vec!["extra-members"]), false),
            (Verdict::Fail, false),
        ] {
            let mut report = Report::default();
            report.row("6.1", "expected", "came", verdict.clone());
            assert_eq!(report.passed(), passed, "{verdict}");
        }
    }

    #[test]
    fn a_kme_cannot_steer_the_terminal() {
        assert_eq!(shown("\x1b[2Jx\n"), "\u{fffd}[2Jx\u{fffd}");
        assert_eq!(shown(&"ä".repeat(200)).chars().count(), 103);
    }
}
