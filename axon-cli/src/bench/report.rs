//! Formats the results as text and as JSON.

use std::fmt::Write as _;

use serde_json::{Value, json};

use super::{
    Compared, KINDS, Paced, Results, STREAMS, budgets,
    harness::{Ratio, Rounds, Wake, words},
    readers::{Cost, Published, READERS, Until},
};
use crate::text::{self, TextTable};

/// Explains in every output how figures are obtained from rounds.
const REPORTED: &str = "Raw and AXON take turns. Times are one way (half a round trip): p50 of the \
                        round in which it was least, p99 and p99.9 of all rounds together. Ratios: \
                        of those p50, and the median of the rounds' ratios. A budget is judged by \
                        the first; where messages have a pace, and of a publish, p50 is of all \
                        rounds, and budgets are judged by the median. CPU is the processor time \
                        of a message in all processes together.";

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
    out += "\nLatency at 100 Hz and 1 kHz, copied in and out; the receiver sleeps in between.\n\n";
    out += &paced_table(&results.paced);
    for motion in STREAMS {
        let _ = writeln!(
            out,
            "\nThroughput, polling, {}. Raw: {}.\n",
            words::motion(motion),
            words::limit(Wake::Poll, motion)
        );
        out += &stream_table(results.streams.iter().filter(|c| c.load.motion == motion));
    }
    for until in Until::ALL {
        out += match until {
            Until::Told => {
                "\nA publish to processes that read every byte, wake-ups aside. Raw: a memcpy and a store.\n\n"
            }
            Until::Woken => {
                "\nA publish to processes that sleep and read every byte. Raw: a memcpy, a store and \
                 one FUTEX_WAKE for all.\n\n"
            }
        };
        out += &publish_table(results.publish.iter().filter(|cost| cost.until == until));
    }
    out
}

fn latency_table<'a>(rows: impl Iterator<Item = &'a Compared>) -> String {
    let mut table = TextTable::new(&[
        ">size",
        ">raw p50",
        ">p99",
        ">p99.9",
        ">AXON p50",
        ">p99",
        ">p99.9",
        ">CPU: raw",
        ">AXON",
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
        row.extend([raw, axon].map(|rounds| words::nanoseconds(rounds.cpu())));
        row.extend(ratio_cells(ratio));
        row.extend(budget_cells(ratio.best, budgets::latency(load)));
        table.row(row);
    }
    table.render(0)
}

fn paced_table(rows: &[Paced]) -> String {
    let mut table = TextTable::new(&[
        ">size",
        ">pace",
        ">epoll p50",
        ">p99",
        ">futex p50",
        ">p99",
        ">AXON p50",
        ">p99",
        ">CPU: epoll",
        ">futex",
        ">AXON",
        ">to epoll",
        ">to futex",
        ">budget",
        "",
    ]);
    for Paced { load, epoll, futex, axon } in rows {
        let pace = load.pace.map_or_else(String::new, words::pace);
        let mut row = vec![words::size(load.size), pace];
        for rounds in [epoll, futex, axon] {
            let all = rounds.all();
            row.push(words::nanoseconds(all.p50()));
            row.push(all.tail(99.0).map_or("-".to_owned(), words::nanoseconds));
        }
        row.extend([epoll, futex, axon].map(|rounds| words::nanoseconds(rounds.cpu())));
        row.extend([epoll, futex].map(|raw| format!("{:.2}", axon.to(raw).median)));
        row.extend(budget_cells(axon.to(epoll).median, budgets::latency(load)));
        table.row(row);
    }
    table.render(0)
}

fn stream_table<'a>(rows: impl Iterator<Item = &'a Compared>) -> String {
    let mut table = TextTable::new(&[
        ">size",
        ">raw messages/s",
        ">bytes/s",
        ">AXON messages/s",
        ">bytes/s",
        ">CPU: raw",
        ">AXON",
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
        row.extend([raw, axon].map(|rounds| words::nanoseconds(rounds.cpu())));
        row.extend(ratio_cells(axon.to(raw)));
        table.row(row);
    }
    table.render(0)
}

fn publish_table<'a>(costs: impl Iterator<Item = &'a Cost>) -> String {
    let mut table = TextTable::new(&[
        ">size",
        ">readers",
        ">raw",
        ">AXON",
        ">read by all: raw",
        ">AXON",
        ">CPU: raw",
        ">AXON",
        ">AXON to raw",
        ">to 1: raw",
        ">AXON",
        ">budget",
        "",
    ]);
    let mut one = None;
    for cost in costs {
        if cost.readers == 1 {
            one = Some(cost);
        }
        let Cost { raw, axon, .. } = cost;
        let mut row = vec![words::size(cost.size), cost.readers.to_string()];
        let p50 = |rounds: &Rounds| words::nanoseconds(rounds.all().p50());
        row.extend([&raw.call, &axon.call, &raw.read, &axon.read].map(p50));
        row.extend([raw, axon].map(|published| words::nanoseconds(published.call.cpu())));
        row.push(format!("{:.2}", axon.call.to(&raw.call).median));
        if let Some(one) = one {
            let ratios = [raw.call.to(&one.raw.call), axon.call.to(&one.axon.call)];
            row.extend(ratios.map(|ratio| format!("{:.2}", ratio.median)));
            row.extend(budget_cells(ratios[1].median, budget_of(cost)));
        }
        table.row(row);
    }
    table.render(0)
}

/// Returns the budget for the ratio of the most readers to one reader. It does not apply where the
/// publisher wakes the readers.
fn budget_of(cost: &Cost) -> Option<f64> {
    let judged = cost.until == Until::Told && cost.readers == READERS[READERS.len() - 1];
    judged.then_some(budgets::SIXTEEN_READERS)
}

fn ratio_cells(ratio: Ratio) -> [String; 2] {
    [format!("{:.2}", ratio.best), format!("{:.2}", ratio.median)]
}

fn budget_cells(ratio: f64, budget: Option<f64>) -> [String; 2] {
    budget.map_or_else(Default::default, |budget| {
        [format!("{budget:.2}"), budgets::verdict(ratio, budget).to_owned()]
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
        row["budget"] = budget_json(c.axon.to(&c.raw).best, budgets::latency(&c.load));
        row
    };
    let paced = |p: &Paced| {
        let to_epoll = p.axon.to(&p.epoll);
        json!({
            "bytes": p.load.size,
            "hz": p.load.pace.map(|pace| 1.0 / pace.as_secs_f64()),
            "motion": p.load.motion,
            "epoll": p.epoll.json(),
            "futex": p.futex.json(),
            "axon": p.axon.json(),
            "ratio_to_epoll": ratio_json(to_epoll),
            "ratio_to_futex": ratio_json(p.axon.to(&p.futex)),
            "budget": budget_json(to_epoll.median, budgets::latency(&p.load)),
        })
    };
    let publish = |cost: &Cost| {
        let one = results
            .publish
            .iter()
            .find(|one| (one.size, one.until, one.readers) == (cost.size, cost.until, READERS[0]));
        let to_one = one.map(|one| cost.axon.call.to(&one.axon.call));
        let published = |p: &Published| json!({ "call": p.call.json(), "read": p.read.json() });
        json!({
            "bytes": cost.size,
            "readers": cost.readers,
            "woken": cost.until == Until::Woken,
            "raw": published(&cost.raw),
            "axon": published(&cost.axon),
            "ratio_to_raw": ratio_json(cost.axon.call.to(&cost.raw.call)),
            "raw_ratio_to_one": one.map(|one| ratio_json(cost.raw.call.to(&one.raw.call))),
            "ratio_to_one": to_one.map(ratio_json),
            "budget": to_one.map(|ratio| budget_json(ratio.median, budget_of(cost))),
        })
    };
    let figures = [
        ("latency", results.latency.iter().map(latency).collect()),
        ("paced", results.paced.iter().map(paced).collect()),
        ("throughput", results.streams.iter().map(compared).collect()),
        ("publish", results.publish.iter().map(publish).collect()),
    ];
    results.run.document("shm", REPORTED, figures)
}

fn ratio_json(ratio: Ratio) -> Value {
    let [best, median] = [ratio.best, ratio.median].map(budgets::rounded);
    json!({ "of_best_rounds": best, "median_of_rounds": median })
}

fn budget_json(ratio: f64, budget: Option<f64>) -> Value {
    budget.map_or(
        Value::Null,
        |budget| json!({ "at_most": budget, "met": budgets::is_met(ratio, budget) }),
    )
}
