//! The results as bars, in SVG.

use std::fmt::Write as _;

use axon_tls::Cipher;

use crate::report::{Row, Table, grouped};

const WIDTH: usize = 960;
const TOP: usize = 78;
const ROW: usize = 24;
const BAR: usize = 15;
/// Between two transports.
const GAP: usize = 40;
/// Where the bars of a panel begin, and how long its longest one is.
const SPEED: (usize, usize) = (270, 220);
const BYTES: (usize, usize) = (585, 250);

const TEXT: &str = "#24292f";
const MUTED: &str = "#6e7781";
const STOCK: &str = "#8c959f";
const OURS: &str = "#0969da";
const TO_SERVER: &str = "#1a7f37";
const TO_CLIENT: &str = "#7bc98f";

/// The default cipher suite over both transports: on the left how many handshakes a second, on the
/// right their bytes.
pub(crate) fn svg(tables: &[Table]) -> String {
    let tables: Vec<&Table> =
        tables.iter().filter(|table| table.cipher == Cipher::default()).collect();
    let height = TOP + tables.iter().map(|table| table.rows.len() * ROW + GAP).sum::<usize>();
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{WIDTH}\" height=\"{height}\" \
         viewBox=\"0 0 {WIDTH} {height}\" font-family=\"sans-serif\" font-size=\"12\">\n\
         <rect width=\"{WIDTH}\" height=\"{height}\" fill=\"#ffffff\"/>\n"
    );
    text(&mut svg, 16, 26, TEXT, "15", "TLS 1.3 handshakes, both ends on one core");
    text(&mut svg, SPEED.0, 52, MUTED, "12", "handshakes per second");
    text(&mut svg, BYTES.0, 52, MUTED, "12", "bytes:");
    for (x, fill, name) in
        [(BYTES.0 + 42, TO_SERVER, "to the server"), (BYTES.0 + 142, TO_CLIENT, "to the client")]
    {
        rect(&mut svg, x, 42, 11, 11, fill);
        text(&mut svg, x + 16, 52, MUTED, "12", name);
    }

    let mut y = TOP;
    for table in tables {
        let title = format!("over {}, {}", table.transport, table.cipher);
        text(&mut svg, 16, y, TEXT, "13", &title);
        y += 12;
        let most = |of: fn(&Row) -> f64| table.rows.iter().map(of).fold(0.0, f64::max);
        let (fastest, largest) = (most(Row::per_second), most(|row| bytes(row) as f64));
        for (number, row) in table.rows.iter().enumerate() {
            let base = y + BAR - 3;
            text(&mut svg, 28, base, TEXT, "12", row.name);

            let long = |value: f64, most: f64, room: usize| (value / most * room as f64) as usize;
            let fill = if number < 2 { STOCK } else { OURS };
            let bar = long(row.per_second(), fastest, SPEED.1).max(1);
            rect(&mut svg, SPEED.0, y, bar, BAR, fill);
            let label = grouped(row.per_second() as usize);
            text(&mut svg, SPEED.0 + bar + 5, base, TEXT, "12", &label);

            let to_server = long(row.traffic.to_server as f64, largest, BYTES.1).max(1);
            let to_client = long(row.traffic.to_client as f64, largest, BYTES.1).max(1);
            rect(&mut svg, BYTES.0, y, to_server, BAR, TO_SERVER);
            rect(&mut svg, BYTES.0 + to_server, y, to_client, BAR, TO_CLIENT);
            let label = grouped(bytes(row));
            text(&mut svg, BYTES.0 + to_server + to_client + 5, base, TEXT, "12", &label);
            y += ROW;
        }
        y += GAP - 12;
    }
    svg + "</svg>\n"
}

fn bytes(row: &Row) -> usize {
    row.traffic.to_server + row.traffic.to_client
}

fn rect(svg: &mut String, x: usize, y: usize, width: usize, height: usize, fill: &str) {
    let _ = writeln!(
        svg,
        "<rect x=\"{x}\" y=\"{y}\" width=\"{width}\" height=\"{height}\" fill=\"{fill}\"/>"
    );
}

/// `text` has no character that XML would read as markup.
fn text(svg: &mut String, x: usize, y: usize, fill: &str, size: &str, text: &str) {
    let _ = writeln!(
        svg,
        "<text x=\"{x}\" y=\"{y}\" fill=\"{fill}\" font-size=\"{size}\">{text}</text>"
    );
}
