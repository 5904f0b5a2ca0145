//! The results as text, and as JSON.

use std::fmt::Write as _;

use serde_json::{Value, json};

use super::{
    Compared, KINDS, Results, STREAMS, budgets,
    harness::{Ratio, Rounds, Wake, words},
    readers::{Cost, READERS},
};
use crate::text::{self, Table};

/// How figures are taken from rounds; in every output.
const REPORTED: &str = "Raw and AXON take turns. Times are one way (half a round trip): p50 of the \
                        round in which it was least, p99 and p99.9 of all rounds together. Ratios: \
                        of these p50, and the median of the rounds' ratios. A budget is judged by \
                        the first.";

pub(super) fn text(results: &Results) -> String {
    let mut out = results.run.heading(REPORTED);
    for (wake, motion) in KINDS {
        let _ = writeln!(
            out,
            "\nLatency, {}. Raw: {}.\n",
            words::kind(wake, motion),
            words::limit(wake, motion)
        );
        let rows = results.latency.iter();
        let rows = rows.filter(|c| (c.load.wake, c.load.motion) == (wake, motion));
        out += &latency_table(rows);
    }
    for motion in STREAMS {
        let _ = writeln!(
            out,
            "\nThroughput, polling, {}. Raw: {}.\n",
            words::motion(motion),
            words::limit(Wake::Poll, motion)
        );
        out += &stream_table(results.streams.iter().filter(|c| c.load.motion == motion));
    }
    out +=
        "\nA publish to 1 to 16 reader processes, which are idle. Raw: a memcpy and a store.\n\n";
    out += &publish_table(&results.publish);
    out
}

fn latency_table<'a>(rows: impl Iterator<Item = &'a Compared>) -> String {
    let mut table = Table::new(&[
        ">size",
        ">raw p50",
        ">p99",
        ">p99.9",
        ">AXON p50",
        ">p99",
        ">p99.9",
        ">ratio",
        ">median",
        ">budget",
        "",
    ]);
    for Compared { load, raw, axon } in rows {
        let ratio = axon.to(raw);
        let mut row = vec![words::size(load.size)];
        for rounds in [raw, axon] {
            let all = rounds.all();
            row.push(words::nanoseconds(rounds.best().p50()));
            row.extend(
                [99.0, 99.9].map(|p| all.tail(p).map_or("-".to_owned(), words::nanoseconds)),
            );
        }
        row.extend(ratio_cells(ratio));
        row.extend(budget_cells(ratio, budgets::latency(load)));
        table.row(row);
    }
    table.render(0)
}

fn stream_table<'a>(rows: impl Iterator<Item = &'a Compared>) -> String {
    let mut table = Table::new(&[
        ">size",
        ">raw messages/s",
        ">bytes/s",
        ">AXON messages/s",
        ">bytes/s",
        ">ratio of times",
        ">median",
    ]);
    for Compared { load, raw, axon } in rows {
        let mut row = vec![words::size(load.size)];
        for rounds in [raw, axon] {
            let rate = 1e9 / rounds.best().p50();
            row.push(text::grouped(rate as u64));
            row.push(words::throughput(load, rate));
        }
        row.extend(ratio_cells(axon.to(raw)));
        table.row(row);
    }
    table.render(0)
}

fn publish_table(costs: &[Cost]) -> String {
    let mut table = Table::new(&[
        ">size",
        ">raw",
        ">1",
        ">2",
        ">4",
        ">8",
        ">16",
        ">1 to raw",
        ">16 to 1",
        ">median",
        ">budget",
        "",
    ]);
    for cost in costs {
        let mut row = vec![words::size(cost.size), words::nanoseconds(cost.raw.best().p50())];
        row.extend(cost.by_readers.iter().map(|rounds| words::nanoseconds(rounds.best().p50())));
        let (one, sixteen) = ends(cost);
        row.push(format!("{:.2}", one.to(&cost.raw).best));
        let ratio = sixteen.to(one);
        row.extend(ratio_cells(ratio));
        row.extend(budget_cells(ratio, Some(budgets::SIXTEEN_READERS)));
        table.row(row);
    }
    table.render(0)
}

/// With the fewest readers, and with the most.
fn ends(cost: &Cost) -> (&Rounds, &Rounds) {
    (&cost.by_readers[0], &cost.by_readers[READERS.len() - 1])
}

fn ratio_cells(ratio: Ratio) -> [String; 2] {
    [format!("{:.2}", ratio.best), format!("{:.2}", ratio.median)]
}

fn budget_cells(ratio: Ratio, budget: Option<f64>) -> [String; 2] {
    budget.map_or_else(Default::default, |budget| {
        [format!("{budget:.2}"), budgets::verdict(ratio.best, budget).to_owned()]
    })
}

pub(super) fn json(results: &Results) -> String {
    let compared = |c: &Compared| {
        json!({
            "bytes": c.load.size,
            "wake": c.load.wake,
            "motion": c.load.motion,
            "window": c.load.window,
            "limit": words::limit(c.load.wake, c.load.motion),
            "raw": c.raw.json(),
            "axon": c.axon.json(),
            "ratio": ratio_json(c.axon.to(&c.raw)),
        })
    };
    let latency = |c: &Compared| {
        let mut row = compared(c);
        row["budget"] = budget_json(c.axon.to(&c.raw), budgets::latency(&c.load));
        row
    };
    let publish = |cost: &Cost| {
        let (one, sixteen) = ends(cost);
        let ratio = sixteen.to(one);
        let readers = READERS.iter().zip(&cost.by_readers);
        json!({
            "bytes": cost.size,
            "raw": cost.raw.json(),
            "readers": readers
                .map(|(readers, rounds)| json!({ "readers": readers, "publish": rounds.json() }))
                .collect::<Vec<_>>(),
            "ratio_of_1_to_raw": ratio_json(one.to(&cost.raw)),
            "ratio_of_16_to_1": ratio_json(ratio),
            "budget": budget_json(ratio, Some(budgets::SIXTEEN_READERS)),
        })
    };
    let figures = [
        ("latency", results.latency.iter().map(latency).collect()),
        ("throughput", results.streams.iter().map(compared).collect()),
        ("publish", results.publish.iter().map(publish).collect()),
    ];
    results.run.document("shm", REPORTED, figures)
}

fn ratio_json(ratio: Ratio) -> Value {
    let round = |value: f64| (value * 1e3).round() / 1e3;
    json!({ "of_best_rounds": round(ratio.best), "median_of_rounds": round(ratio.median) })
}

fn budget_json(ratio: Ratio, budget: Option<f64>) -> Value {
    budget.map_or(Value::Null, |budget| json!({ "at_most": budget, "met": ratio.best <= budget }))
}
