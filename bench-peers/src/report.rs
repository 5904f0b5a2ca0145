//! The results as text, JSON and charts.

use std::fmt::Write as _;

use serde_json::{Value, json};

use crate::{
    Compared, KINDS, MEDIA, PACE, PACED, Results, STREAMS,
    harness::{Chart, Line, Rounds, Wake, page, words},
    text::{self, TextTable},
};

/// How the figures are computed from rounds; every output contains this text.
const REPORTED: &str = "All take turns. Times are one way (half a round trip): p50 of the round in \
                        which it was least, p99 of all rounds together; at a pace both are of \
                        all rounds. Ratios are of these p50, to AXON's. CPU is the processor \
                        time of a message in both processes together.";
/// The index of AXON among the media.
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
        out += &table(results.latency.iter().filter(of_kind), Cell::Time);
    }
    for motion in PACED {
        let title = format!("{}, {}", words::pace(PACE), words::motion(motion));
        let _ =
            writeln!(out, "\nLatency at {title}; the receiver sleeps. Raw: epoll and eventfd.\n");
        out += &table(results.paced.iter().filter(|c| c.load.motion == motion), Cell::Time);
    }
    for motion in STREAMS {
        let limit = words::limit(Wake::Poll, motion);
        let title = words::motion(motion);
        let _ = writeln!(out, "\nThroughput, polling, {title}. Raw: {limit}.\n");
        let of_kind = |c: &&Compared| c.load.motion == motion;
        out += &table(results.streams.iter().filter(of_kind), Cell::Rate);
    }
    out
}

#[derive(Clone, Copy, PartialEq)]
enum Cell {
    Time,
    Rate,
}

/// Returns a table: p50, p99 and processor time of each medium, or messages and bytes a second; then the ratios.
fn table<'a>(rows: impl Iterator<Item = &'a Compared>, cell: Cell) -> String {
    let headers: &[&'static str] = match cell {
        Cell::Time => &[
            ">size",
            ">raw p50",
            ">p99",
            ">CPU",
            ">AXON p50",
            ">p99",
            ">CPU",
            ">iceoryx2 p50",
            ">p99",
            ">CPU",
            ">zenoh p50",
            ">p99",
            ">CPU",
            ">iceoryx2/AXON",
            ">zenoh/AXON",
        ],
        Cell::Rate => &[
            ">size",
            ">raw msg/s",
            ">B/s",
            ">CPU",
            ">AXON msg/s",
            ">B/s",
            ">CPU",
            ">iceoryx2 msg/s",
            ">B/s",
            ">CPU",
            ">zenoh msg/s",
            ">B/s",
            ">CPU",
            ">iceoryx2/AXON",
            ">zenoh/AXON",
        ],
    };
    let mut table = TextTable::new(headers);
    for compared in rows {
        let mut row = vec![words::size(compared.load.size)];
        for rounds in &compared.rounds {
            match cell {
                Cell::Time => {
                    row.push(words::nanoseconds(p50(compared, rounds)));
                    let p99 = rounds.all().tail(99.0);
                    row.push(p99.map_or("-".to_owned(), words::nanoseconds));
                }
                Cell::Rate => {
                    let rate = 1e9 / p50(compared, rounds);
                    row.push(text::grouped(rate as u64));
                    row.push(words::throughput(&compared.load, rate));
                }
            }
            row.push(words::nanoseconds(rounds.cpu()));
        }
        row.extend(ratios(compared).map(|ratio| format!("{ratio:.2}")));
        table.row(row);
    }
    table.render(0)
}

/// Returns the p50 of the round in which it was least; for messages at a pace, the p50 of all rounds.
fn p50(compared: &Compared, rounds: &Rounds) -> f64 {
    match compared.load.pace {
        None => rounds.best().p50(),
        Some(_) => rounds.all().p50(),
    }
}

/// Returns the other media's times as multiples of AXON's.
fn ratios(compared: &Compared) -> impl Iterator<Item = f64> {
    let axon = p50(compared, &compared.rounds[AXON]);
    compared.rounds[AXON + 1..].iter().map(move |rounds| p50(compared, rounds) / axon)
}

pub(crate) fn json(results: &Results) -> String {
    let compared = |c: &Compared| {
        let media = MEDIA.iter().zip(&c.rounds);
        let media: Vec<Value> =
            media.map(|(name, rounds)| json!({ "medium": name, "times": rounds.json() })).collect();
        json!({
            "bytes": c.load.size, "wake": c.load.wake, "motion": c.load.motion,
            "window": c.load.window, "hz": c.load.pace.map(|pace| 1.0 / pace.as_secs_f64()),
            "media": media,
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
        "paced": results.paced.iter().map(compared).collect::<Vec<_>>(),
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
                .map(|c| (c.load.size as f64, value(p50(c, &c.rounds[index]).max(1.0))))
                .collect(),
        };
        MEDIA.iter().enumerate().map(line).collect::<Vec<_>>()
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
    let paced = PACED.iter().map(|motion| Chart {
        title: format!("Latency (p50) at {}, {}", words::pace(PACE), words::motion(*motion)),
        lines: lines(results.paced.iter().filter(|c| c.load.motion == *motion).collect(), |ns| ns),
        across: |bytes| words::size(bytes as usize),
        upwards: |ns| text::duration(ns as u64),
    });
    let streams = STREAMS.iter().map(|motion| Chart {
        title: format!("Messages a second, {}", words::motion(*motion)),
        lines: lines(results.streams.iter().filter(|c| c.load.motion == *motion).collect(), |ns| {
            1e9 / ns
        }),
        across: |bytes| words::size(bytes as usize),
        upwards: |rate| text::grouped(rate as u64),
    });
    let charts: Vec<Chart> = latency.chain(paced).chain(streams).collect();
    let machine = &results.machine;
    let subtitle =
        format!("{VERSIONS}; {}, {}, {} CPUs", machine.cpu, machine.kernel, machine.cpus);
    page("AXON beside iceoryx2 and zenoh in shared memory", &subtitle, &charts)
}
