//! A command beside a camera that fills the link.

use std::time::Duration;

use serde_json::{Value, json};

use super::{Options, ms, quantile};
use crate::{Result, part::Stream, place::Place, table::Table};

/// Measures a camera of 25 MB/s beside a command at 100 Hz.
pub(crate) fn camera(options: &Options) -> Result<Value> {
    println!(
        "\nA command of 100 B at 100 Hz, RELIABLE, beside a camera of 25 MB/s, RELIABLE, depth 1.\n"
    );
    let table = Table::new(&["topic", "carrier", ">arrives", ">p50", ">p99", ">longest"]);
    let stream = |topic: &str, bytes, every, depth| Stream {
        topic: topic.to_owned(),
        bytes,
        every,
        is_reliable: true,
        depth: Some(depth),
    };
    let streams = [
        stream("/camera", 830_000, Duration::from_secs(1) / 30, 1),
        stream("/cmd_vel", 100, Duration::from_millis(10), 10),
    ];
    let mut figures = Vec::new();
    let place = Place::new(options.path, &options.plan)?;
    for carrier in options.carriers().iter().copied() {
        let outcomes = place.measure(carrier, &streams, options.time())?;
        for (stream, outcome) in streams.iter().zip(&outcomes) {
            let ages = outcome.ages();
            let [p50, p99, longest] = [50, 99, 100].map(|percent| quantile(&ages, percent));
            table.row([
                stream.topic.clone(),
                carrier.name().to_owned(),
                format!("{:.1} %", outcome.arrived()),
                ms(p50),
                ms(p99),
                ms(longest),
            ])?;
            figures.push(json!({
                "topic": stream.topic,
                "carrier": carrier.name(),
                "arrived_percent": outcome.arrived(),
                "p50_ms": p50,
                "p99_ms": p99,
                "longest_ms": longest,
            }));
        }
    }
    Ok(json!(figures))
}
