//! Formats the results as text and as JSON.

use std::fmt::Write as _;

use serde_json::{Value, json};

use super::{Measured, Paced, Results, Streams, stream::Streamed};
use crate::{
    bench::{
        budgets::{self, verdict},
        harness::words,
    },
    text::{self, TextTable},
};

/// Explains in every output how figures are obtained.
const REPORTED: &str = "AXON between two hosts on one machine's loopback, and one stream of bare \
                        quinn, take turns. Latency is one way (half a round trip), of the round \
                        with the least median; of streams the best of the turns counts. Messages at a \
                        pace are timed one way, and the median of the rounds' medians counts: AXON may \
                        take bare quinn's and two wake-ups, one of each daemon. In a stream \
                        quinn is written and read 64 KiB at a time, and runs in the application's \
                        thread or in one of its own, whichever is faster. CPU is the processor time of \
                        a message in all processes: both applications, AXON's two daemons, and in \
                        qkd the KMEs.";

pub(super) fn text(results: &Results) -> String {
    let mut out = results.run.heading(REPORTED);
    for measured in &results.modes {
        let _ = writeln!(out, "\nLatency, {}.\n", measured.mode.route());
        out += &latency(measured);
        if !measured.paced.is_empty() {
            let _ = writeln!(out, "\nLatency at a pace, {}.\n", measured.mode.route());
            out += &paced(measured);
        }
        let _ = writeln!(out, "\nStreams, {}, in messages a second.\n", measured.mode.route());
        out += &streams(measured);
    }
    out
}

fn latency(measured: &Measured) -> String {
    let header =
        [">size", ">bare p50", ">p99", ">AXON p50", ">p99", ">CPU: bare", ">AXON", ">ratio of p50"];
    let mut table = TextTable::new(&header);
    for row in &measured.latency {
        let times = [&row.bare, &row.axon].map(|rounds| {
            let all = rounds.all();
            [rounds.best().p50(), all.tail(99.0).unwrap_or(all.at[9])].map(words::nanoseconds)
        });
        let mut cells = vec![words::size(row.size)];
        cells.extend(times.into_iter().flatten());
        cells.extend([&row.bare, &row.axon].map(|rounds| words::nanoseconds(rounds.cpu())));
        cells.push(format!("{:.2}", row.axon.to(&row.bare).best));
        table.row(cells);
    }
    table.render(0)
}

fn paced(measured: &Measured) -> String {
    let header = [
        ">size",
        ">pace",
        ">wake-up",
        ">bare p50",
        ">p99",
        ">AXON p50",
        ">p99",
        ">CPU: bare",
        ">AXON",
        ">bare and two wake-ups",
        "at most",
    ];
    let mut table = TextTable::new(&header);
    for row in &measured.paced {
        let Paced { load, wake_up, bare, axon } = row;
        let pace = load.pace.map_or_else(String::new, words::pace);
        let mut cells = vec![words::size(load.size), pace, words::nanoseconds(wake_up.typical())];
        for rounds in [bare, axon] {
            cells.push(words::nanoseconds(rounds.typical()));
            cells.push(rounds.all().tail(99.0).map_or("-".to_owned(), words::nanoseconds));
        }
        cells.extend([bare, axon].map(|rounds| words::nanoseconds(rounds.cpu())));
        cells.push(words::nanoseconds(row.allowed()));
        cells.push(verdict(axon.typical() / row.allowed(), 1.0).to_owned());
        table.row(cells);
    }
    table.render(0)
}

/// Returns the rate of messages with KEEP_ALL, divided by that of bare quinn.
fn goodput(row: &Streams) -> f64 {
    row.waits.per_second() / row.bare.per_second()
}

/// Returns the processor time of a message with KEEP_ALL, divided by that of bare quinn.
fn cpu_by_bare(row: &Streams) -> f64 {
    row.waits.cpu_us_a_message() / row.bare.cpu_us_a_message().max(1e-9)
}

fn streams(measured: &Measured) -> String {
    let header = [
        ">size",
        ">bare",
        ">KEEP_ALL",
        "",
        ">ratio",
        "at least 0.85",
        ">KEEP_LAST sent",
        ">taken",
        ">CPU: bare",
        ">KEEP_ALL",
        ">KEEP_LAST",
        ">KEEP_ALL by bare",
        "at most 1.25",
    ];
    let mut table = TextTable::new(&header);
    for row in &measured.streams {
        let rate = |streamed: &Streamed| text::grouped(streamed.per_second() as u64);
        let sent = row.overtakes.sent as f64 / row.overtakes.seconds.max(1e-9);
        let mut cells = vec![
            words::size(row.size),
            rate(&row.bare),
            rate(&row.waits),
            format!("{}/s", text::bytes((row.waits.per_second() * row.size as f64) as u64)),
            format!("{:.2}", goodput(row)),
            verdict(budgets::OF_QUINN, goodput(row)).to_owned(),
            text::grouped(sent as u64),
            rate(&row.overtakes),
        ];
        let cpu = [&row.bare, &row.waits, &row.overtakes];
        cells.extend(cpu.map(|streamed| words::nanoseconds(streamed.cpu_us_a_message() * 1e3)));
        cells.push(format!("{:.2}", cpu_by_bare(row)));
        cells.push(verdict(cpu_by_bare(row), budgets::CPU_BY_QUINN).to_owned());
        table.row(cells);
    }
    table.render(0)
}

pub(super) fn json(results: &Results) -> String {
    let streamed = |of: &Streamed| -> Value {
        json!({
            "sent": of.sent,
            "taken": of.taken,
            "seconds": of.seconds,
            "per_second": of.per_second(),
            "cpu_us_a_message": of.cpu_us_a_message(),
        })
    };
    let modes = results.modes.iter().map(|measured| {
        let latency = measured.latency.iter().map(|row| {
            json!({
                "bytes": row.size,
                "bare": row.bare.json(),
                "axon": row.axon.json(),
                "ratio": row.axon.to(&row.bare).best,
            })
        });
        let paced = measured.paced.iter().map(|row| {
            json!({
                "bytes": row.load.size,
                "pace_ns": row.load.pace.map(|pace| pace.as_nanos() as u64),
                "wake_up": row.wake_up.json(),
                "bare": row.bare.json(),
                "axon": row.axon.json(),
                "allowed_ns": row.allowed(),
            })
        });
        let streams = measured.streams.iter().map(|row| {
            json!({
                "bytes": row.size,
                "bare": streamed(&row.bare),
                "keep_all": streamed(&row.waits),
                "keep_last": streamed(&row.overtakes),
                "ratio_of_keep_all": goodput(row),
                "cpu_ratio_of_keep_all": cpu_by_bare(row),
            })
        });
        json!({
            "mode": measured.mode.stem(),
            "latency": latency.collect::<Vec<_>>(),
            "paced": paced.collect::<Vec<_>>(),
            "streams": streams.collect::<Vec<_>>(),
        })
    });
    results.run.document("net", REPORTED, [("modes", modes.collect())])
}
