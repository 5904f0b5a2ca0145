//! The results as charts.

use super::{
    Compared, KINDS, Results, STREAMS,
    harness::{Chart, Line, Rounds, page, words},
    readers::READERS,
};
use crate::text;

/// All of them on one page.
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
    let by_readers = |cost: &super::Cost| Line {
        name: words::size(cost.size),
        points: READERS
            .iter()
            .zip(&cost.by_readers)
            .map(|(readers, rounds)| (*readers as f64, rounds.best().p50()))
            .collect(),
    };
    charts.push(Chart {
        title: "A publish, by reader processes".to_owned(),
        // As many as there are colours.
        lines: results.publish.iter().take(5).map(by_readers).collect(),
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
