//! Draws lines over logarithmic axes, in SVG.

use std::fmt::Write as _;

const TEXT: &str = "#24292f";
const MUTED: &str = "#6e7781";
const GRID: &str = "#d8dee4";
const COLORS: [&str; 5] = ["#8c959f", "#0969da", "#cf222e", "#1a7f37", "#9a6700"];

const WIDTH: f64 = 480.0;
const HEIGHT: f64 = 320.0;
const HEADER: f64 = 64.0;
/// The margins around the plot of a chart: left, top, right, bottom.
const MARGINS: [f64; 4] = [64.0, 34.0, 16.0, 40.0];

/// One line of a chart: a name, and points from left to right. Both coordinates are above zero.
pub(crate) struct Line {
    pub(crate) name: String,
    pub(crate) points: Vec<(f64, f64)>,
}

/// A chart.
pub(crate) struct Chart {
    pub(crate) title: String,
    /// The lines. A line's position decides its colour, which is the same in all charts.
    pub(crate) lines: Vec<Line>,
    /// Returns the label of a value on the horizontal axis. Each value that has a point is
    /// labelled.
    pub(crate) across: fn(f64) -> String,
    /// Returns the label of a value on the vertical axis. Powers of ten are labelled.
    pub(crate) upwards: fn(f64) -> String,
}

/// Draws charts, two in a row, under a title and a subtitle.
pub(crate) fn page(title: &str, subtitle: &str, charts: &[Chart]) -> String {
    let (width, height) = (2.0 * WIDTH, HEADER + charts.len().div_ceil(2) as f64 * HEIGHT);
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" \
         viewBox=\"0 0 {width} {height}\" font-family=\"sans-serif\" font-size=\"11\">\n\
         <rect width=\"{width}\" height=\"{height}\" fill=\"#ffffff\"/>\n"
    );
    text(&mut svg, (16.0, 26.0), "start", TEXT, 15, title);
    text(&mut svg, (16.0, 46.0), "start", MUTED, 11, subtitle);
    for (number, chart) in charts.iter().enumerate() {
        let corner = ((number % 2) as f64 * WIDTH, HEADER + (number / 2) as f64 * HEIGHT);
        draw(&mut svg, corner, chart);
    }
    svg + "</svg>\n"
}

/// A logarithmic axis: values from `low` to `high` on a stretch from `from` to `to`.
struct Axis {
    low: f64,
    high: f64,
    from: f64,
    to: f64,
}

impl Axis {
    fn at(&self, value: f64) -> f64 {
        let span = (self.high / self.low).ln().max(1e-9);
        self.from + (value / self.low).ln() / span * (self.to - self.from)
    }
}

fn draw(svg: &mut String, (left, top): (f64, f64), chart: &Chart) {
    let across: Vec<f64> = chart.lines.iter().flat_map(|l| &l.points).map(|p| p.0).collect();
    let upwards: Vec<f64> = chart.lines.iter().flat_map(|l| &l.points).map(|p| p.1).collect();
    if across.is_empty() {
        return;
    }
    let least = |values: &[f64]| values.iter().copied().fold(f64::INFINITY, f64::min);
    let most = |values: &[f64]| values.iter().copied().fold(f64::MIN_POSITIVE, f64::max);
    let decade = least(&upwards).log10().floor();
    let x = Axis {
        low: least(&across),
        high: most(&across),
        from: left + MARGINS[0],
        to: left + WIDTH - MARGINS[2],
    };
    let y = Axis {
        low: 10f64.powf(decade),
        high: 10f64.powf(most(&upwards).log10().ceil().max(decade + 1.0)),
        from: top + HEIGHT - MARGINS[3],
        to: top + MARGINS[1],
    };
    text(svg, (x.from, top + 16.0), "start", TEXT, 13, &chart.title);

    let mut ticks = across;
    ticks.sort_by(f64::total_cmp);
    ticks.dedup();
    for tick in ticks {
        rule(svg, (x.at(tick), y.from), (x.at(tick), y.to));
        let label = (chart.across)(tick);
        text(svg, (x.at(tick), y.from + 16.0), "middle", MUTED, 9, &label);
    }
    let decades = (y.high / y.low).log10().round() as i32;
    for decade in 0..=decades {
        let value = y.low * 10f64.powi(decade);
        rule(svg, (x.from, y.at(value)), (x.to, y.at(value)));
        text(svg, (x.from - 6.0, y.at(value) + 4.0), "end", MUTED, 10, &(chart.upwards)(value));
    }
    for (number, line) in chart.lines.iter().enumerate() {
        let color = COLORS[number % COLORS.len()];
        let mut path = String::new();
        for (across, upwards) in &line.points {
            let _ = write!(path, "{:.1},{:.1} ", x.at(*across), y.at(*upwards));
        }
        let _ = writeln!(
            svg,
            "<polyline points=\"{}\" fill=\"none\" stroke=\"{color}\" stroke-width=\"1.8\"/>",
            path.trim_end()
        );
        for (across, upwards) in &line.points {
            let (cx, cy) = (x.at(*across), y.at(*upwards));
            let _ =
                writeln!(svg, "<circle cx=\"{cx:.1}\" cy=\"{cy:.1}\" r=\"2.4\" fill=\"{color}\"/>");
        }
        let at = (x.from + 10.0, y.to + 14.0 + number as f64 * 15.0);
        text(svg, at, "start", color, 11, &line.name);
    }
}

fn rule(svg: &mut String, from: (f64, f64), to: (f64, f64)) {
    let _ = writeln!(
        svg,
        "<line x1=\"{:.1}\" y1=\"{:.1}\" x2=\"{:.1}\" y2=\"{:.1}\" stroke=\"{GRID}\"/>",
        from.0, from.1, to.0, to.1
    );
}

fn text(svg: &mut String, (x, y): (f64, f64), anchor: &str, fill: &str, size: u32, text: &str) {
    let escaped = text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;");
    let _ = writeln!(
        svg,
        "<text x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\" fill=\"{fill}\" \
         font-size=\"{size}\">{escaped}</text>"
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_page_has_every_line_and_nothing_outside_it() {
        let chart = || Chart {
            title: "a < b".to_owned(),
            lines: vec![
                Line { name: "one".to_owned(), points: vec![(8.0, 90.0), (25e6, 2e6)] },
                Line { name: "two".to_owned(), points: vec![(8.0, 100.0)] },
            ],
            across: |x| format!("{x} B"),
            upwards: |y| format!("{y} ns"),
        };
        let svg = page("title", "of & by", &[chart(), chart(), chart()]);
        assert!(svg.starts_with("<svg") && svg.ends_with("</svg>\n"));
        assert_eq!(svg.matches("<polyline").count(), 6);
        assert_eq!(svg.matches("<circle").count(), 9);
        assert!(svg.contains("a &lt; b") && svg.contains("of &amp; by"));
        for part in svg.split("cy=\"").skip(1) {
            let y: f64 = part.split('"').next().unwrap().parse().unwrap();
            assert!((0.0..=HEADER + 2.0 * HEIGHT).contains(&y), "{y}");
        }
    }

    #[test]
    fn a_chart_without_points_is_left_out() {
        let empty = Chart {
            title: String::new(),
            lines: Vec::new(),
            across: |x| x.to_string(),
            upwards: |y| y.to_string(),
        };
        assert!(!page("", "", &[empty]).contains("<polyline"));
    }
}
