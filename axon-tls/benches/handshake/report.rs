//! The results as tables, and as JSON.

use std::fmt::Write as _;

use axon_tls::Cipher;

use crate::cases::{Case, Traffic, Transport};
use crate::measure::{Measured, least, median};

/// All cases over one transport with one cipher suite.
pub(crate) struct Table {
    pub(crate) transport: Transport,
    pub(crate) cipher: Cipher,
    pub(crate) rows: Vec<Row>,
}

/// One case.
pub(crate) struct Row {
    pub(crate) name: &'static str,
    /// Microseconds of the fastest round, and the median of all.
    pub(crate) micros: [f64; 2],
    /// How many times faster than each of the two stock cases.
    pub(crate) ratios: [Ratio; 2],
    pub(crate) traffic: Traffic,
}

/// A ratio of speeds.
pub(crate) struct Ratio {
    /// Of the fastest rounds.
    pub(crate) of_fastest: f64,
    /// The median of the rounds' ratios.
    pub(crate) median: f64,
}

impl Row {
    /// Of the fastest round.
    pub(crate) fn per_second(&self) -> f64 {
        1e6 / self.micros[0]
    }
}

pub(crate) fn rows(cases: &[Case], measured: &[Measured]) -> Vec<Row> {
    let ratio = |stock: &Measured, case: &Measured| Ratio {
        of_fastest: least(&stock.rounds) / least(&case.rounds),
        median: median(stock.rounds.iter().zip(&case.rounds).map(|(s, c)| s / c).collect()),
    };
    let row = |(case, of): (&Case, &Measured)| Row {
        name: case.name,
        micros: [least(&of.rounds) * 1e6, median(of.rounds.clone()) * 1e6],
        ratios: [ratio(&measured[0], of), ratio(&measured[1], of)],
        traffic: of.traffic,
    };
    cases.iter().zip(measured).map(row).collect()
}

impl Table {
    pub(crate) fn markdown(&self) -> String {
        let mut text = format!("\n{}, {}\n\n", self.transport, self.cipher);
        text += "| | handshakes/s | µs | to stock | to stock, mutual | bytes to server | bytes to client |\n";
        text += "| --- | --: | --: | --: | --: | --: | --: |\n";
        for row in &self.rows {
            let [alone, mutual] = &row.ratios;
            let _ = writeln!(
                text,
                "| {} | {} | {:.0} | {:.2} / {:.2} | {:.2} / {:.2} | {} | {} |",
                row.name,
                grouped(row.per_second() as usize),
                row.micros[0],
                alone.of_fastest,
                alone.median,
                mutual.of_fastest,
                mutual.median,
                grouped(row.traffic.to_server),
                grouped(row.traffic.to_client),
            );
        }
        text
    }
}

pub(crate) fn json(tables: &[Table]) -> String {
    let round = |number: f64| (number * 1e3).round() / 1e3;
    let ratio = |ratio: &Ratio| {
        serde_json::json!({
            "of_fastest_rounds": round(ratio.of_fastest),
            "median_of_rounds": round(ratio.median),
        })
    };
    let tables: Vec<_> = tables
        .iter()
        .map(|table| {
            let rows: Vec<_> = table
                .rows
                .iter()
                .map(|row| {
                    serde_json::json!({
                        "name": row.name,
                        "handshakes_per_second": row.per_second().round(),
                        "microseconds_fastest": round(row.micros[0]),
                        "microseconds_median": round(row.micros[1]),
                        "ratio_to_stock": ratio(&row.ratios[0]),
                        "ratio_to_stock_mutual": ratio(&row.ratios[1]),
                        "bytes_to_server": row.traffic.to_server,
                        "bytes_to_client": row.traffic.to_client,
                    })
                })
                .collect();
            serde_json::json!({
                "transport": table.transport.to_string(),
                "cipher": table.cipher.name(),
                "handshakes": rows,
            })
        })
        .collect();
    serde_json::to_string_pretty(&tables).unwrap() + "\n"
}

/// With a comma before every third digit from the right.
pub(crate) fn grouped(number: usize) -> String {
    let digits = number.to_string();
    let mut text = String::new();
    for (at, digit) in digits.chars().enumerate() {
        if at > 0 && (digits.len() - at).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}
