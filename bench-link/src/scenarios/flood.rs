//! Measures which share of the path's rate a stream gets.

use std::time::Duration;

use serde_json::{Value, json};

use super::Options;
use crate::{Result, part::Stream, path::Loss, place::Place, table::Table};

const BYTES: usize = 16 << 10;

/// Measures a KEEP_ALL stream without a rate limit: over the path at each loss, and with a round trip of 100 ms and 1 %
/// loss.
pub(crate) fn flood(options: &Options) -> Result<Value> {
    println!(
        "\nA KEEP_ALL stream of 16 KiB samples as fast as the path takes it, share of the path's rate.\n"
    );
    let table = Table::new(&["round trip", ">loss", "carrier", ">share"]);
    let far = (Duration::from_millis(50), 0.01);
    let near = options.losses.iter().map(|loss| (options.path.delay, *loss));
    let mut figures = Vec::new();
    for (delay, share) in near.chain([far]) {
        let mut path = options.path;
        path.delay = delay;
        path.loss = Loss { share, burst: options.burst };
        let place = Place::new(path, &options.plan)?;
        let stream = Stream {
            topic: "/flood".to_owned(),
            bytes: BYTES,
            every: Duration::ZERO,
            is_reliable: true,
            depth: None,
        };
        for carrier in options.carriers().iter().copied() {
            let outcome =
                &place.measure(carrier, std::slice::from_ref(&stream), options.time())?[0];
            // The first second is the start.
            let begin =
                outcome.taken.arrivals.first().map_or(0, |first| first.arrived) + 1_000_000_000;
            let end = begin + (options.time().as_nanos() as u64).saturating_sub(1_000_000_000);
            let counted =
                outcome.taken.arrivals.iter().filter(|a| (begin..end).contains(&a.arrived));
            let bits = counted.count() as f64 * BYTES as f64 * 8.0;
            let of_rate = bits / ((end - begin) as f64 / 1e9).max(1e-9) / path.rate;
            let round_trip = format!("{:.0} ms", delay.as_secs_f64() * 2e3);
            let loss = format!("{:.0} %", share * 100.0);
            table.row([round_trip, loss, carrier.name().to_owned(), format!("{of_rate:.2}")])?;
            figures.push(json!({
                "round_trip_ms": delay.as_secs_f64() * 2e3,
                "loss": share,
                "carrier": carrier.name(),
                "share_of_rate": of_rate,
                "lost": outcome.taken.lost,
            }));
        }
    }
    Ok(json!(figures))
}
