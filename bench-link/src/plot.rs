//! A chart of what arrives at which loss, as SVG.

use std::{collections::BTreeMap, path::Path};

use plotters::{
    chart::ChartBuilder,
    coord::Shift,
    element::{PathElement, Text},
    prelude::{DashedLineSeries, DrawingArea, IntoDrawingArea, IntoFont, LineSeries, SVGBackend},
    style::{Color, Palette, Palette99, WHITE},
};
use serde_json::{Map, Value};

use crate::Result;

/// Of the chart of one mode, in pixels.
const SIZE: (u32, u32) = (960, 440);
/// The names of the lines, beside the chart: their width, and the height of each.
const NAMES: (i32, i32) = (270, 22);

/// Points of one line: loss and share, in percent.
type Line = Vec<(f64, f64)>;

/// Draws a chart for each mode: one line for each message over AXON, and a dashed one for it over TCP.
pub(crate) fn losses(file: &Path, figures: &Map<String, Value>) -> Result<()> {
    let height = SIZE.1 * u32::try_from(figures.len())?;
    let root = SVGBackend::new(file, (SIZE.0, height)).into_drawing_area();
    root.fill(&WHITE)?;
    let areas = root.split_evenly((figures.len(), 1));
    for (area, (mode, of_mode)) in areas.iter().zip(figures) {
        draw(area, mode, &lines(&of_mode["losses"]))?;
    }
    Ok(root.present()?)
}

/// The lines by message and carrier.
fn lines(rows: &Value) -> BTreeMap<(String, bool), Line> {
    let mut lines = BTreeMap::<_, Line>::new();
    for row in rows.as_array().into_iter().flatten() {
        let name = format!(
            "{} within {} ms",
            row["message"].as_str().unwrap_or_default(),
            row["within_percent"][0]["ms"]
        );
        let share = row["within_percent"][0]["percent"].as_f64();
        if let (Some(loss), Some(share)) = (row["loss"].as_f64(), share) {
            let is_tcp = row["carrier"] == "TCP";
            lines.entry((name, is_tcp)).or_default().push((100.0 * loss, share));
        }
    }
    lines
}

fn draw(
    area: &DrawingArea<SVGBackend<'_>, Shift>,
    mode: &str,
    lines: &BTreeMap<(String, bool), Line>,
) -> Result<()> {
    let most = lines.values().flatten().map(|(loss, _)| *loss).fold(1.0, f64::max);
    let mut chart = ChartBuilder::on(area)
        .caption(format!("What arrives, AXON in {mode}"), ("sans-serif", 18).into_font())
        .margin(12)
        .margin_right(NAMES.0)
        .x_label_area_size(40)
        .y_label_area_size(50)
        .build_cartesian_2d(0.0..most, 0.0..100.0)?;
    chart
        .configure_mesh()
        .max_light_lines(0)
        .x_desc("lost both ways, %")
        .y_desc("arrives in time, %")
        .draw()?;
    let mut names: Vec<&String> = lines.keys().map(|(name, _)| name).collect();
    names.dedup();
    for (y, ((name, is_tcp), line)) in (2..).map(|row| row * NAMES.1).zip(lines) {
        let colour = Palette99::pick(names.iter().position(|one| *one == name).unwrap_or(0));
        let style = colour.stroke_width(2);
        let points = line.iter().copied();
        let label = match is_tcp {
            false => {
                chart.draw_series(LineSeries::new(points, style))?;
                name.clone()
            }
            true => {
                chart.draw_series(DashedLineSeries::new(points, 6, 4, style))?;
                format!("{name}, TCP (dashed)")
            }
        };
        let x = SIZE.0.cast_signed() - NAMES.0;
        area.draw(&PathElement::new([(x, y), (x + 16, y)], style))?;
        area.draw(&Text::new(label, (x + 22, y - 6), ("sans-serif", 12).into_font()))?;
    }
    Ok(())
}
