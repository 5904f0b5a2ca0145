//! Formats the results as text and as JSON.

use std::fmt::Write as _;

use serde_json::{Value, json};

use super::{BUDGET, Compared, KINDS, Results, SERVICE_BUDGET};
use crate::{
    bench::{
        budgets::{is_met, rounded, verdict},
        harness::{Rounds, words},
    },
    text::{self, TextTable},
};

/// Explains in every output how figures are obtained from rounds.
const REPORTED: &str = "Bare shared memory, sessions and a service take turns. Times are p50 of the \
                        round in which it was least: one way (half a round trip), and for the \
                        service both ways. Ratios are of those p50. A service copies requests and \
                        responses, so that it is beside messages that are copied, too. Of a \
                        stream as much is under way as 16 MiB hold, from 4 to 64 messages. CPU is \
                        the processor time of a message in both processes and their daemon.";

/// A ratio and its budget.
type Judged = (f64, f64);
/// Formats rows as a table.
type Tabulate = fn(Vec<&Compared>) -> String;

/// Returns the ratio of a session's time to that of bare shared memory.
fn session_to_bare(row: &Compared) -> Judged {
    (row.session.to(&row.bare).best, BUDGET)
}

/// Returns the ratio of a service's round trip to a session's message one way.
fn service_to_session(row: &Compared, service: &Rounds) -> Judged {
    (2.0 * service.to(&row.session).best, SERVICE_BUDGET)
}

pub(super) fn text(results: &Results) -> String {
    let mut out = results.run.heading(REPORTED);
    let tables: [(&str, &[Compared], Tabulate); 2] = [
        ("Latency", &results.latency, latency_table),
        ("Throughput", &results.streams, stream_table),
    ];
    for (name, figures, table) in tables {
        for (wake, motion) in KINDS {
            let _ = writeln!(out, "\n{name}, {}.\n", words::kind(wake, motion));
            let rows = figures.iter();
            let rows = rows.filter(|c| (c.load.wake, c.load.motion) == (wake, motion));
            out += &table(rows.collect());
        }
    }
    out
}

fn judged((ratio, budget): Judged) -> [String; 3] {
    [format!("{ratio:.2}"), format!("{budget:.2}"), verdict(ratio, budget).to_owned()]
}

fn stream_table(rows: Vec<&Compared>) -> String {
    let mut table = TextTable::new(&[
        ">size",
        ">bare messages/s",
        ">session",
        ">CPU: bare",
        ">session",
        ">ratio of times",
        ">budget",
        "",
    ]);
    for row in rows {
        let mut cells = vec![words::size(row.load.size)];
        let rate = |rounds: &Rounds| text::grouped((1e9 / rounds.best().p50()) as u64);
        cells.extend([&row.bare, &row.session].map(rate));
        cells.extend([&row.bare, &row.session].map(|r| words::nanoseconds(r.cpu())));
        cells.extend(judged(session_to_bare(row)));
        table.row(cells);
    }
    table.render(0)
}

fn latency_table(rows: Vec<&Compared>) -> String {
    let mut header =
        vec![">size", ">bare", ">session", ">CPU: bare", ">session", ">ratio", ">budget", ""];
    if rows.iter().any(|row| row.service.is_some()) {
        header.extend([">service", ">by session", ">budget", ""]);
    }
    let mut table = TextTable::new(&header);
    for row in rows {
        let mut cells = vec![words::size(row.load.size)];
        let both = [&row.bare, &row.session];
        cells.extend(both.map(|r| words::nanoseconds(r.best().p50())));
        cells.extend(both.map(|r| words::nanoseconds(r.cpu())));
        cells.extend(judged(session_to_bare(row)));
        if let Some(service) = &row.service {
            cells.push(words::nanoseconds(2.0 * service.best().p50()));
            cells.extend(judged(service_to_session(row, service)));
        }
        table.row(cells);
    }
    table.render(0)
}

pub(super) fn json(results: &Results) -> String {
    let judged = |(ratio, budget): Judged| -> Value {
        json!({ "ratio": rounded(ratio), "at_most": budget, "met": is_met(ratio, budget) })
    };
    let streams = results.streams.iter().map(|row| {
        json!({
            "bytes": row.load.size,
            "wake": row.load.wake,
            "motion": row.load.motion,
            "under_way": row.load.window,
            "bare": row.bare.json(),
            "session": row.session.json(),
            "session_to_bare": judged(session_to_bare(row)),
        })
    });
    let latency = results.latency.iter().map(|row| {
        let service = row.service.as_ref();
        json!({
            "bytes": row.load.size,
            "wake": row.load.wake,
            "motion": row.load.motion,
            "bare": row.bare.json(),
            "session": row.session.json(),
            "service_one_way": service.map(Rounds::json),
            "session_to_bare": judged(session_to_bare(row)),
            "service_round_trip_to_session": service.map(|s| judged(service_to_session(row, s))),
        })
    });
    let figures = [("latency", latency.collect()), ("throughput", streams.collect())];
    results.run.document("session", REPORTED, figures)
}
