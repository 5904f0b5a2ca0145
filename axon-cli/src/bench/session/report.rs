//! The results as text, and as JSON.

use std::fmt::Write as _;

use serde_json::{Value, json};

use super::{BUDGET, Compared, KINDS, Results, SERVICE_BUDGET, readers::READERS};
use crate::{
    bench::{budgets::verdict, harness::words},
    text::Table,
};

/// How figures are taken from rounds; in every output.
const REPORTED: &str = "Bare shared memory, sessions and a service take turns. Times are p50 of the \
                        round in which it was least: one way (half a round trip), and for the \
                        service both ways. Ratios are of these.";

/// A session by bare shared memory, and a service's round trip by a session's message.
fn ratios(row: &Compared) -> [(f64, f64); 2] {
    let Compared { bare, session, service, .. } = row;
    [(session.to(bare).best, BUDGET), (2.0 * service.to(session).best, SERVICE_BUDGET)]
}

pub(super) fn text(results: &Results) -> String {
    let mut out = results.run.heading(REPORTED);
    for (wake, motion) in KINDS {
        let _ = writeln!(out, "\nLatency, {}.\n", words::kind(wake, motion));
        let mut table = Table::new(&[
            ">size",
            ">bare",
            ">session",
            ">ratio",
            ">budget",
            "",
            ">service",
            ">by session",
            ">budget",
            "",
        ]);
        let rows = results.latency.iter();
        for row in rows.filter(|c| (c.load.wake, c.load.motion) == (wake, motion)) {
            let [session, service] = ratios(row);
            let time = |ns: f64| words::nanoseconds(ns);
            let judged = |(ratio, budget): (f64, f64)| {
                [format!("{ratio:.2}"), format!("{budget:.2}"), verdict(ratio, budget).to_owned()]
            };
            let mut cells = vec![
                words::size(row.load.size),
                time(row.bare.best().p50()),
                time(row.session.best().p50()),
            ];
            cells.extend(judged(session));
            cells.push(time(2.0 * row.service.best().p50()));
            cells.extend(judged(service));
            table.row(cells);
        }
        out += &table.render(0);
    }
    out += "\nA publish to 1, 4 and 16 subscriptions, each in a process of its own, which is idle.\n\n";
    let mut table = Table::new(&[">size", ">1", ">4", ">16", ">16 to 1"]);
    for cost in &results.publish {
        let mut cells = vec![words::size(cost.size)];
        cells.extend(cost.by_readers.iter().map(|rounds| words::nanoseconds(rounds.best().p50())));
        let (one, most) = (&cost.by_readers[0], &cost.by_readers[READERS.len() - 1]);
        cells.push(format!("{:.2}", most.to(one).best));
        table.row(cells);
    }
    out + &table.render(0)
}

pub(super) fn json(results: &Results) -> String {
    let judged = |(ratio, budget): (f64, f64)| -> Value {
        let ratio = (ratio * 1e3).round() / 1e3;
        json!({ "ratio": ratio, "at_most": budget, "met": ratio <= budget })
    };
    let latency = results.latency.iter().map(|row| {
        let [session, service] = ratios(row);
        json!({
            "bytes": row.load.size,
            "wake": row.load.wake,
            "motion": row.load.motion,
            "bare": row.bare.json(),
            "session": row.session.json(),
            "service_one_way": row.service.json(),
            "session_to_bare": judged(session),
            "service_round_trip_to_session": judged(service),
        })
    });
    let publish = results.publish.iter().map(|cost| {
        let readers = READERS.iter().zip(&cost.by_readers);
        json!({
            "bytes": cost.size,
            "subscriptions": readers
                .map(|(count, rounds)| json!({ "count": count, "publish": rounds.json() }))
                .collect::<Vec<_>>(),
        })
    });
    let figures = [("latency", latency.collect()), ("publish", publish.collect())];
    results.run.document("session", REPORTED, figures)
}
