//! Measures which messages arrive in time at each loss.

use std::time::Duration;

use serde_json::{Value, json};

use super::{Options, ms, quantile};
use crate::{
    Result,
    part::Stream,
    path::Loss,
    place::{Carrier, Place},
    table::Table,
};

/// A kind of message, and the times within which it is to arrive.
struct Row {
    name: &'static str,
    bytes: usize,
    is_reliable: bool,
    depth: u32,
    within: [u64; 2],
}

const HZ: u32 = 30;

const ROWS: [Row; 4] = [
    Row { name: "1 KB, RELIABLE", bytes: 1_000, is_reliable: true, depth: 10, within: [100, 300] },
    Row {
        name: "64 KB, RELIABLE",
        bytes: 64_000,
        is_reliable: true,
        depth: 10,
        within: [100, 300],
    },
    Row {
        name: "1 KB, BEST_EFFORT",
        bytes: 1_000,
        is_reliable: false,
        depth: 5,
        within: [100, 300],
    },
    Row {
        name: "512 KB, RELIABLE",
        bytes: 512_000,
        is_reliable: true,
        depth: 1,
        within: [250, 1_000],
    },
];

/// Measures messages at 30 Hz, one size after the other, at each loss, both ways.
pub(crate) fn losses(options: &Options) -> Result<Value> {
    println!("\nMessages at {HZ} Hz, each size alone, share of those published that arrives.\n");
    let header = [
        "message",
        ">loss",
        "carrier",
        ">within 0.1 s",
        ">0.25 s",
        ">0.3 s",
        ">1 s",
        ">at all",
        ">median age",
        ">p99",
        ">packets",
        ">lost",
        ">dropped",
    ];
    let table = Table::new(&header);
    let mut figures = Vec::new();
    for share in &options.losses {
        let mut path = options.path;
        path.loss = Loss { share: *share, burst: options.burst };
        let place = Place::new(path, &options.plan)?;
        for row in &ROWS {
            let stream = Stream {
                topic: "/stream".to_owned(),
                bytes: row.bytes,
                every: Duration::from_secs(1) / HZ,
                is_reliable: row.is_reliable,
                depth: Some(row.depth),
            };
            for carrier in options.carriers().iter().copied() {
                // TCP has no best effort.
                if carrier == Carrier::Tcp && !row.is_reliable {
                    continue;
                }
                let before = place.relay().counters();
                let outcome =
                    &place.measure(carrier, std::slice::from_ref(&stream), options.time())?[0];
                let packets = place.relay().counters().since(&before);
                let ages = outcome.ages();
                let within = |ms| outcome.within(Duration::from_millis(ms));
                let cell = |time| {
                    if row.within.contains(&time) {
                        format!("{:.1}", within(time))
                    } else {
                        String::new()
                    }
                };
                table.row([
                    row.name.to_owned(),
                    format!("{:.0} %", share * 100.0),
                    carrier.name().to_owned(),
                    cell(100),
                    cell(250),
                    cell(300),
                    cell(1_000),
                    format!("{:.1}", outcome.arrived()),
                    ms(quantile(&ages, 50)),
                    ms(quantile(&ages, 99)),
                    packets.packets.to_string(),
                    format!("{:.1} %", packets.lost_percent()),
                    packets.overflowed.to_string(),
                ])?;
                figures.push(json!({
                    "message": row.name,
                    "loss": share,
                    "carrier": carrier.name(),
                    "published": outcome.sent.messages,
                    "arrived_percent": outcome.arrived(),
                    "within_percent": row.within.map(|time| json!({ "ms": time, "percent": within(time) })),
                    "median_age_ms": quantile(&ages, 50),
                    "p99_age_ms": quantile(&ages, 99),
                    "lost": outcome.taken.lost,
                    "packets": packets.packets,
                    "packets_lost": packets.lost,
                    "packets_dropped_by_the_queue": packets.overflowed,
                }));
            }
        }
    }
    Ok(json!(figures))
}
