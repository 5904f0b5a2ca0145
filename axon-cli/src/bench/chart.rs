//! Draws the results as charts.

use super::{
    Compared, KINDS, Results, STREAMS,
    harness::{Chart, Line, Rounds, page, words},
    readers::{Cost, Until},
};
use crate::text;

/// Returns all charts on one page.
pub(super) fn svg(results: &Results) -> String {
    let mut charts = Vec::new();
    for (wake, motion) in KINDS {
        let rows = || {
            let of_kind = move |c: &&Compared| (c.load.wake, c.load.motion) == (wake, motion);
            results.latency.iter().filter(of_kind)
        };
        charts.push(Chart {
            title: format!("Latency (p50), {}", words::kind(wake, motion)),
            lines: raw_and_axon(rows, |rounds| rounds.best().p50()),
            across: bytes,
            upwards: time,
        });
    }
    for motion in STREAMS {
        let rows = || results.streams.iter().filter(move |c| c.load.motion == motion);
        charts.push(Chart {
            title: format!("Messages a second, {}", words::motion(motion)),
            lines: raw_and_axon(rows, |rounds| 1e9 / rounds.best().p50()),
            across: bytes,
            upwards: |rate| text::grouped(rate as u64),
        });
    }
    let sizes: Vec<usize> = results.publish.iter().map(|cost| cost.size).collect();
    let by_readers = |size: usize, name: &str, of: fn(&Cost) -> &Rounds| Line {
        name: format!("{}, {name}", words::size(size)),
        points: results
            .publish
            .iter()
            .filter(|cost| cost.size == size && cost.until == Until::Woken)
            .map(|cost| (cost.readers as f64, of(cost).all().p50()))
            .collect(),
    };
    // The chart shows the smallest and the largest size, because it has as many colours as these
    // two need.
    let ends = sizes.first().into_iter().chain(sizes.last());
    charts.push(Chart {
        title: "A publish, by processes that sleep and read it".to_owned(),
        lines: ends
            .flat_map(|size| {
                [
                    by_readers(*size, "raw", |cost| &cost.raw.call),
                    by_readers(*size, "AXON", |cost| &cost.axon.call),
                ]
            })
            .collect(),
        across: |readers| format!("{readers}"),
        upwards: time,
    });
    let machine = &results.run.machine;
    let subtitle = format!("{}, {}, {} CPUs", machine.cpu, machine.kernel, machine.cpus);
    page("AXON's shared memory beside the raw limit", &subtitle, &charts)
}

fn raw_and_axon<'a, I: Iterator<Item = &'a Compared>>(
    rows: impl Fn() -> I,
    value: fn(&Rounds) -> f64,
) -> Vec<Line> {
    let line = |name: &str, of: fn(&Compared) -> &Rounds| Line {
        name: name.to_owned(),
        points: rows().map(|c| (c.load.size as f64, value(of(c)).max(1.0))).collect(),
    };
    vec![line("raw", |c| &c.raw), line("AXON", |c| &c.axon)]
}

fn bytes(value: f64) -> String {
    words::size(value as usize)
}

fn time(ns: f64) -> String {
    text::duration(ns as u64)
}
