//! The results as text, JSON and charts.

use std::fmt::Write as _;

use serde_json::{Value, json};

use crate::{
    Compared, KINDS, Results, STREAMS,
    harness::{Chart, Line, Wake, page, words},
    text::{self, Table},
};

/// How figures are taken from rounds; in every output.
const REPORTED: &str = "All take turns. Times are one way (half a round trip): p50 of the round in \
                        which it was least, p99 and p99.9 of all rounds together. Ratios are of \
                        these p50, to AXON's.";
/// Where AXON is among the media.
const AXON: usize = 1;
const VERSIONS: &str = "iceoryx2 0.10.0, zenoh 1.10.2";

pub(crate) fn text(results: &Results) -> String {
    let mut out = format!("{}\n{VERSIONS}\n{REPORTED}\n", results.machine.line());
    if results.quick {
        out += "A quick run: its figures are good for nothing.\n";
    }
    for (wake, motion) in KINDS {
        let title = words::kind(wake, motion);
        let _ = writeln!(out, "\nLatency, {title}. Raw: {}.\n", words::limit(wake, motion));
        let of_kind = |c: &&Compared| (c.load.wake, c.load.motion) == (wake, motion);
        out += &table(results, results.latency.iter().filter(of_kind), Cell::Time);
    }
    for motion in STREAMS {
        let limit = words::limit(Wake::Poll, motion);
        let title = words::motion(motion);
        let _ = writeln!(out, "\nThroughput, polling, {title}. Raw: {limit}.\n");
        let of_kind = |c: &&Compared| c.load.motion == motion;
        out += &table(results, results.streams.iter().filter(of_kind), Cell::Rate);
    }
    out
}

#[derive(Clone, Copy, PartialEq)]
enum Cell {
    Time,
    Rate,
}

/// p50, p99 and p99.9 of each medium, or messages and bytes a second; then the ratios.
fn table<'a>(results: &Results, rows: impl Iterator<Item = &'a Compared>, cell: Cell) -> String {
    let headers: &[&'static str] = match cell {
        Cell::Time => &[
            ">size",
            ">raw p50",
            ">p99",
            ">p99.9",
            ">AXON p50",
            ">p99",
            ">p99.9",
            ">iceoryx2 p50",
            ">p99",
            ">p99.9",
            ">zenoh p50",
            ">p99",
            ">p99.9",
            ">iceoryx2/AXON",
            ">zenoh/AXON",
        ],
        Cell::Rate => &[
            ">size",
            ">raw msg/s",
            ">B/s",
            ">AXON msg/s",
            ">B/s",
            ">iceoryx2 msg/s",
            ">B/s",
            ">zenoh msg/s",
            ">B/s",
            ">iceoryx2/AXON",
            ">zenoh/AXON",
        ],
    };
    debug_assert_eq!(results.media, ["raw", "AXON", "iceoryx2", "zenoh"]);
    let mut table = Table::new(headers);
    for compared in rows {
        let mut row = vec![words::size(compared.load.size)];
        for rounds in &compared.rounds {
            let best = rounds.best();
            match cell {
                Cell::Time => {
                    row.push(words::nanoseconds(best.p50()));
                    let all = rounds.all();
                    let tail = |p| all.tail(p).map_or("-".to_owned(), words::nanoseconds);
                    row.extend([99.0, 99.9].map(tail));
                }
                Cell::Rate => {
                    let rate = 1e9 / best.p50();
                    row.push(text::grouped(rate as u64));
                    row.push(words::throughput(&compared.load, rate));
                }
            }
        }
        row.extend(ratios(compared).map(|ratio| format!("{ratio:.2}")));
        table.row(row);
    }
    table.render(0)
}

/// How many times AXON's time the others took.
fn ratios(compared: &Compared) -> impl Iterator<Item = f64> {
    let axon = &compared.rounds[AXON];
    compared.rounds[AXON + 1..].iter().map(|rounds| rounds.to(axon).best)
}

pub(crate) fn json(results: &Results) -> String {
    let compared = |c: &Compared| {
        let media = results.media.iter().zip(&c.rounds);
        let media: Vec<Value> =
            media.map(|(name, rounds)| json!({ "medium": name, "times": rounds.json() })).collect();
        json!({
            "bytes": c.load.size, "wake": c.load.wake, "motion": c.load.motion,
            "window": c.load.window, "media": media,
            "times_axon": ratios(c).map(|r| (r * 1e3).round() / 1e3).collect::<Vec<_>>(),
        })
    };
    let document = json!({
        "benchmark": "bench-peers",
        "versions": VERSIONS,
        "optimized": !cfg!(debug_assertions),
        "quick": results.quick,
        "reported": REPORTED,
        "machine": results.machine,
        "rounds": results.effort.rounds,
        "latency": results.latency.iter().map(compared).collect::<Vec<_>>(),
        "throughput": results.streams.iter().map(compared).collect::<Vec<_>>(),
    });
    format!("{document:#}\n")
}

pub(crate) fn svg(results: &Results) -> String {
    let lines = |rows: Vec<&Compared>, value: fn(f64) -> f64| {
        let line = |(index, name): (usize, &&str)| Line {
            name: (*name).to_owned(),
            points: rows
                .iter()
                .map(|c| (c.load.size as f64, value(c.rounds[index].best().p50().max(1.0))))
                .collect(),
        };
        results.media.iter().enumerate().map(line).collect::<Vec<_>>()
    };
    let latency = KINDS.iter().map(|(wake, motion)| {
        let of_kind = |c: &&Compared| (c.load.wake, c.load.motion) == (*wake, *motion);
        Chart {
            title: format!("Latency (p50), {}", words::kind(*wake, *motion)),
            lines: lines(results.latency.iter().filter(of_kind).collect(), |ns| ns),
            across: |bytes| words::size(bytes as usize),
            upwards: |ns| text::duration(ns as u64),
        }
    });
    let streams = STREAMS.iter().map(|motion| Chart {
        title: format!("Messages a second, {}", words::motion(*motion)),
        lines: lines(results.streams.iter().filter(|c| c.load.motion == *motion).collect(), |ns| {
            1e9 / ns
        }),
        across: |bytes| words::size(bytes as usize),
        upwards: |rate| text::grouped(rate as u64),
    });
    let charts: Vec<Chart> = latency.chain(streams).collect();
    let machine = &results.machine;
    let subtitle =
        format!("{VERSIONS}; {}, {}, {} CPUs", machine.cpu, machine.kernel, machine.cpus);
    page("AXON beside iceoryx2 and zenoh in shared memory", &subtitle, &charts)
}
