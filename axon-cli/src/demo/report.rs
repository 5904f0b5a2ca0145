//! The demo's report, as tables and as JSON.

use std::fmt::Write as _;

use serde::Serialize;

use super::{kmes::KeysHandedOut, route::Negotiated, tally::RunTally};
use crate::text::{self, TextTable};

/// All results of the demo.
#[derive(Debug, Serialize)]
pub(crate) struct Report {
    /// The log that was replayed.
    pub(crate) log: LogSummary,
    /// One row for each route.
    pub(crate) routes: Vec<Row>,
    /// One entry for each wrong peer.
    pub(crate) wrong_peers: Vec<Attempt>,
    /// Whether every result is as required.
    pub(crate) passed: bool,
    /// The last line of the report.
    pub(crate) verdict: String,
}

/// The log that was replayed.
#[derive(Debug, Serialize)]
pub(crate) struct LogSummary {
    /// The file name.
    pub(crate) file: String,
    /// The topics with their types.
    pub(crate) topics: Vec<(String, String)>,
    /// The number of messages.
    pub(crate) messages: u64,
    /// The number of payload bytes.
    pub(crate) bytes: u64,
    /// The recorded time in seconds.
    pub(crate) seconds: f64,
    /// The speed, as a multiple of the recorded pace.
    pub(crate) rate: f64,
}

/// The result of one route.
#[derive(Debug, Serialize)]
pub(crate) struct Row {
    route: &'static str,
    #[serde(flatten)]
    outcome: RunTally,
    bytes_per_second: f64,
    publisher_waits: u64,
    #[serde(flatten)]
    negotiated: Option<Negotiated>,
    kme_keys: Option<KeysHandedOut>,
}

impl Row {
    /// Makes a row from the outcome of a subscriber and the negotiated properties of the link.
    pub(crate) fn new(
        route: &'static str,
        outcome: RunTally,
        publisher_waits: u64,
        negotiated: Option<Negotiated>,
        kme_keys: Option<KeysHandedOut>,
    ) -> Self {
        let bytes_per_second = outcome.bytes_per_second();
        Self { route, outcome, bytes_per_second, publisher_waits, negotiated, kme_keys }
    }

    fn cells(&self) -> [String; 11] {
        let o = &self.outcome;
        let dash = || "-".to_owned();
        let link = self.negotiated.as_ref();
        [
            self.route.to_owned(),
            text::grouped(o.messages),
            text::grouped(o.bytes),
            text::grouped(o.lost),
            text::grouped(o.out_of_order),
            text::duration(o.latency_p50_ns),
            text::duration(o.latency_p99_ns),
            format!("{}/s", text::bytes(self.bytes_per_second as u64)),
            link.map_or_else(dash, |link| link.key_exchange.clone()),
            link.map_or_else(dash, |link| link.cipher.clone()),
            self.kme_keys.map_or_else(dash, |keys| text::grouped(keys.to_masters)),
        ]
    }

    fn fault(&self) -> Option<String> {
        let o = &self.outcome;
        let counts = [
            (o.lost, "lost"),
            (o.out_of_order, "out of order"),
            (o.duplicates, "twice"),
            (o.different, "different from the log"),
        ];
        let faults: Vec<String> = counts
            .iter()
            .filter(|(count, _)| *count > 0)
            .map(|(count, what)| format!("{} {what}", text::grouped(*count)))
            .collect();
        let whole = o.is_whole();
        (!whole).then(|| match faults.join(", ") {
            none if none.is_empty() => format!("{}: nothing arrived", self.route),
            faults => format!("{}: {faults}", self.route),
        })
    }
}

/// The result of one wrong peer.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Attempt {
    /// The description of the wrong peer.
    pub(crate) peer: &'static str,
    /// Whether it was refused.
    pub(crate) refused: bool,
    /// The reason that the refused side received.
    pub(crate) told: String,
    /// The reason that the daemon recorded. `None` if no daemon was asked.
    pub(crate) recorded: Option<String>,
}

impl Report {
    /// Makes a report with its verdict.
    pub(crate) fn new(log: LogSummary, routes: Vec<Row>, wrong_peers: Vec<Attempt>) -> Self {
        let mut faults: Vec<String> = routes.iter().filter_map(Row::fault).collect();
        let let_in = wrong_peers.iter().filter(|attempt| !attempt.refused);
        faults.extend(let_in.map(|attempt| format!("{}: not refused", attempt.peer)));
        if routes.is_empty() {
            faults.push("no route was tried".to_owned());
        }
        if wrong_peers.is_empty() {
            faults.push("no wrong peer was tried".to_owned());
        }
        let passed = faults.is_empty();
        let verdict = if passed {
            format!(
                "PASS: {} routes, nothing lost, every byte as recorded; {} wrong peers, all refused",
                routes.len(),
                wrong_peers.len()
            )
        } else {
            format!("FAIL: {}", faults.join("; "))
        };
        Self { log, routes, wrong_peers, passed, verdict }
    }

    /// Returns the report as text, which ends with the verdict.
    pub(crate) fn render(&self) -> String {
        let mut out = String::new();
        let log = &self.log;
        let _ = writeln!(
            out,
            "{}: {} messages, {}, {:.0} s recorded, {}; host A (127.0.0.1) to host B (127.0.0.2)\n",
            text::printable(&log.file),
            text::grouped(log.messages),
            text::bytes(log.bytes),
            log.seconds,
            pace(log.rate),
        );
        let mut routes = TextTable::new(&[
            "route",
            ">messages",
            ">bytes",
            ">lost",
            ">out of order",
            ">p50",
            ">p99",
            ">throughput",
            "key exchange",
            "cipher",
            ">KME keys",
        ]);
        self.routes.iter().for_each(|row| routes.row(row.cells()));
        out.push_str(&routes.render(0));
        out.push_str("\nWrong peers\n");
        for attempt in &self.wrong_peers {
            let outcome = if attempt.refused { "refused" } else { "LET IN" };
            let _ = writeln!(out, "  {outcome}  {}", attempt.peer);
            let _ = writeln!(out, "           told:     {}", text::printable(&attempt.told));
            if let Some(recorded) = &attempt.recorded {
                let _ = writeln!(out, "           recorded: {}", text::printable(recorded));
            }
        }
        let _ = writeln!(out, "\n{}", text::printable(&self.verdict));
        out
    }
}

fn pace(rate: f64) -> String {
    if rate == 0.0 { "as fast as possible".to_owned() } else { format!("{rate} times its pace") }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn log() -> LogSummary {
        LogSummary {
            file: "log.mcap".to_owned(),
            topics: vec![("/a".to_owned(), "a/msg/A".to_owned())],
            messages: 4,
            bytes: 8,
            seconds: 1.0,
            rate: 0.0,
        }
    }

    fn row(change: impl FnOnce(&mut RunTally)) -> Row {
        let mut outcome =
            RunTally { expected: 4, messages: 4, bytes: 8, elapsed_ns: 8, ..RunTally::default() };
        change(&mut outcome);
        Row::new("shared memory", outcome, 0, None, None)
    }

    fn attempt(refused: bool) -> Attempt {
        let told = "no\x1b[2J".to_owned();
        Attempt { peer: "wrong PSK", refused, told, recorded: None }
    }

    #[test]
    fn each_fault_fails_the_verdict_and_is_named() {
        type Change = fn(&mut RunTally);
        let faults: [(Change, &str); 5] = [
            (|o| (o.lost, o.messages) = (1, 3), "1 lost"),
            (|o| o.out_of_order = 2, "2 out of order"),
            (|o| o.duplicates = 3, "3 twice"),
            (|o| o.different = 4, "4 different"),
            (|o| *o = RunTally::default(), "nothing arrived"),
        ];
        for (change, text) in faults {
            let report = Report::new(log(), vec![row(change)], vec![attempt(true)]);
            assert!(!report.passed && report.verdict.contains(text), "{}", report.verdict);
        }
        let report = Report::new(log(), vec![row(|_| ())], vec![attempt(false)]);
        assert!(!report.passed && report.verdict.contains("wrong PSK: not refused"));
        assert!(!Report::new(log(), Vec::new(), vec![attempt(true)]).passed);
        assert!(!Report::new(log(), vec![row(|_| ())], Vec::new()).passed);
    }

    #[test]
    fn the_verdict_is_the_last_line_and_nothing_steers_the_terminal() {
        let report = Report::new(log(), vec![row(|_| ())], vec![attempt(true)]);
        assert!(report.passed);
        let text = report.render();
        assert_eq!(text.lines().last(), Some(report.verdict.as_str()));
        assert!(!text.contains('\x1b'));
    }

    #[test]
    fn the_json_has_the_same_as_data() {
        let report = Report::new(log(), vec![row(|_| ())], vec![attempt(true)]);
        let json = serde_json::to_value(&report).expect("serializable");
        assert_eq!(json["passed"], true);
        assert_eq!(json["routes"][0]["messages"], 4);
        assert_eq!(json["routes"][0]["latency_p99_ns"], 0);
        assert_eq!(json["wrong_peers"][0]["refused"], true);
    }
}
