//! A path whose rate falls, and comes back.

use std::{thread, time::Duration};

use serde_json::{Value, json};

use super::{MS, Options, ms, quantile};
use crate::{
    Result,
    part::{Arrival, Stream, now_ns},
    place::Place,
    table::Table,
};

/// Bits a second.
const SLOW: f64 = 2e6;
/// Time from a change of the rate until ages count.
const AFTER: u64 = 2_000 * MS;

/// Measures messages of 64 KB at 30 Hz with a depth of 1, while the path's rate falls to 2 Mbit/s and comes back.
pub(crate) fn slow(options: &Options) -> Result<Value> {
    println!(
        "\n64 KB at 30 Hz, RELIABLE, depth 1; the rate falls to 2 Mbit/s and comes back. Ages from 2 s after.\n"
    );
    let table = Table::new(&["rate", "carrier", ">arrive", ">median age", ">longest"]);
    let mut figures = Vec::new();
    let place = Place::new(options.path, &options.plan)?;
    for carrier in options.carriers().iter().copied() {
        let stream = Stream {
            topic: "/map".to_owned(),
            bytes: 64_000,
            every: Duration::from_secs(1) / 30,
            is_reliable: true,
            depth: Some(1),
        };
        let mut streams = place.streams(carrier, &[stream])?;
        streams.begin()?;
        thread::sleep(Duration::from_secs(3));
        let fell = now_ns();
        place.relay().set(|settings| settings.rate = SLOW);
        thread::sleep(options.time());
        let returned = now_ns();
        place.relay().set(|settings| settings.rate = options.path.rate);
        thread::sleep(Duration::from_secs(6));
        let end = now_ns();
        let outcome = &streams.end()?[0];
        for (rate, from, to) in [(SLOW, fell, returned), (options.path.rate, returned, end)] {
            let is_counted = |a: &&Arrival| (from + AFTER..to).contains(&a.arrived);
            let counted = outcome.taken.arrivals.iter().filter(is_counted);
            let mut ages: Vec<u64> = counted.map(|a| a.arrived - a.sent).collect();
            ages.sort_unstable();
            let [median, longest] = [50, 100].map(|percent| quantile(&ages, percent));
            let name = format!("{:.0} Mbit/s", rate / 1e6);
            table.row([
                name,
                carrier.name().to_owned(),
                ages.len().to_string(),
                ms(median),
                ms(longest),
            ])?;
            figures.push(json!({
                "rate": rate,
                "carrier": carrier.name(),
                "arrived": ages.len(),
                "median_age_ms": median,
                "longest_age_ms": longest,
            }));
        }
    }
    Ok(json!(figures))
}
