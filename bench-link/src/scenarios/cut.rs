//! A path that is cut, and comes back.

use std::{thread, time::Duration};

use serde_json::{Value, json};

use super::{MS, Options};
use crate::{
    Result,
    part::{Stream, now_ns},
    place::Place,
    table::Table,
};

/// Cuts of 5, 20 and 60 s under messages of 1 KB at 100 Hz, RELIABLE and KEEP_ALL.
pub(crate) fn cut(options: &Options) -> Result<Value> {
    println!("\n1 KB at 100 Hz, RELIABLE, KEEP_ALL, over a path that is cut.\n");
    let header = [
        "cut",
        "carrier",
        ">flows after",
        ">sent",
        ">refused",
        ">arrive",
        ">counted as lost",
        ">twice",
    ];
    let table = Table::new(&header);
    let mut figures = Vec::new();
    for seconds in [5, 20, 60] {
        for carrier in options.carriers().iter().copied() {
            let place = Place::new(options.path, &options.plan)?;
            let stream = Stream {
                topic: "/odometry".to_owned(),
                bytes: 1_000,
                every: Duration::from_millis(10),
                is_reliable: true,
                depth: None,
            };
            let mut streams = place.streams(carrier, &[stream])?;
            streams.begin()?;
            thread::sleep(Duration::from_secs(3));
            place.relay().set(|settings| settings.is_cut = true);
            thread::sleep(Duration::from_secs(seconds));
            let returned = now_ns();
            place.relay().set(|settings| settings.is_cut = false);
            thread::sleep(options.time());
            let outcome = &streams.end()?[0];
            let arrivals = &outcome.taken.arrivals;
            let first = arrivals.iter().find(|a| a.arrived > returned);
            let flows_ms = first.map(|a| (a.arrived - returned) / MS);
            let numbers = outcome.numbers();
            let twice = arrivals.len() - numbers;
            table.row([
                format!("{seconds} s"),
                carrier.name().to_owned(),
                flows_ms.map_or_else(|| "never".to_owned(), |ms| format!("{ms} ms")),
                outcome.sent.messages.to_string(),
                outcome.sent.refused.to_string(),
                numbers.to_string(),
                outcome.taken.lost.to_string(),
                twice.to_string(),
            ])?;
            figures.push(json!({
                "cut_s": seconds,
                "carrier": carrier.name(),
                "flows_after_ms": flows_ms,
                "sent": outcome.sent.messages,
                "refused": outcome.sent.refused,
                "arrived": numbers,
                "lost": outcome.taken.lost,
                "twice": twice,
            }));
        }
    }
    Ok(json!(figures))
}
