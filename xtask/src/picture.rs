//! Draws `docs/architecture.svg`: the crates, and the rooms of the crates whose rooms stand on floors, with arrows
//! for what they import.
//!
//! An arrow that follows from two others is left out: what a room imports by way of a room in between it may
//! import itself, too.

use std::collections::{BTreeMap, BTreeSet};
use std::env;
use std::fmt::Write as _;
use std::fs;
use std::path::Path;
use std::process::Command;

use crate::floors::{self, House};

/// Where it stands.
const FILE: &str = "docs/architecture.svg";
/// The crates that somebody may depend on, or start.
const CRATES: [&str; 9] = [
    "rmw-axon-core",
    "axon-cli",
    "axon-daemon",
    "axon-transport",
    "axon-shm",
    "axon-tls",
    "axon-envelope",
    "etsi-qkd014",
    "rustls-axon",
];

/// Pixels.
const WIDTH: f64 = 1000.0;
const ROW: f64 = 78.0;
const BOX: f64 = 30.0;
const HEADING: f64 = 46.0;
/// By which floors stand to the right of each other: an arrow past a floor seldom runs behind its boxes.
const ASIDE: f64 = 85.0;
/// Of a letter, about.
const LETTER: f64 = 7.7;

type Arrows = BTreeSet<(String, String)>;

/// A part of the picture.
struct Panel {
    title: String,
    /// From the top.
    floors: Vec<Vec<String>>,
    arrows: Arrows,
}

/// Writes the picture anew.
///
/// # Errors
/// What cannot be read or written.
pub(crate) fn draw(root: &Path) -> Result<String, String> {
    let file = root.join(FILE);
    fs::write(&file, picture(root)?).map_err(|e| format!("{}: {e}", file.display()))?;
    Ok(format!("{FILE} is drawn"))
}

fn picture(root: &Path) -> Result<String, String> {
    let mut panels = vec![crates(root)?];
    for house in floors::of_page(root)?.into_iter().filter(House::is_crate) {
        panels.push(rooms(root, &house)?);
    }
    Ok(svg(&panels))
}

/// The crates and what they depend on, by their manifests.
fn crates(root: &Path) -> Result<Panel, String> {
    let output = Command::new(env::var_os("CARGO").unwrap_or_else(|| "cargo".into()))
        .current_dir(root)
        .args(["metadata", "--no-deps", "--format-version=1", "--offline"])
        .output()
        .map_err(|e| format!("cargo metadata: {e}"))?;
    let metadata: serde_json::Value =
        serde_json::from_slice(&output.stdout).map_err(|e| format!("cargo metadata: {e}"))?;
    let text = |value: &serde_json::Value| value.as_str().unwrap_or_default().to_owned();
    let is_drawn = |name: &String| CRATES.contains(&name.as_str());
    let mut arrows = Arrows::new();
    for package in metadata["packages"].as_array().into_iter().flatten() {
        let from = text(&package["name"]);
        let dependencies = package["dependencies"].as_array().into_iter().flatten();
        let normal = dependencies.filter(|dependency| dependency["kind"].is_null());
        let to = normal.map(|dependency| text(&dependency["name"]));
        arrows.extend(to.filter(is_drawn).map(|to| (from.clone(), to)));
    }
    arrows.retain(|(from, to)| is_drawn(from) && from != to);
    let floors = floors_of(CRATES.map(str::to_owned), &arrows);
    Ok(Panel { title: "Crates".into(), floors, arrows: without_detours(&arrows) })
}

/// The rooms of a crate, on the floors of its table.
fn rooms(root: &Path, house: &House) -> Result<Panel, String> {
    let arrows = floors::arrows(root, house)?;
    let mut floors = Vec::new();
    for (room, floor) in &house.floors {
        floors.resize_with(floors.len().max(floor + 1), Vec::new);
        floors[*floor].push(room.clone());
    }
    let folder = house.folder.trim_end_matches("/src");
    let title = format!("Rooms of {folder}");
    Ok(Panel { title, floors, arrows: without_detours(&arrows) })
}

/// Each on the highest floor that is below all that point to it.
fn floors_of(names: impl IntoIterator<Item = String>, arrows: &Arrows) -> Vec<Vec<String>> {
    let mut depth: BTreeMap<String, usize> = names.into_iter().map(|name| (name, 0)).collect();
    // As often as there are names: then an arrow can only be one of a circle, which cargo refuses.
    for _ in 0..depth.len() {
        for (from, to) in arrows {
            let below = depth[from] + 1;
            depth.entry(to.clone()).and_modify(|floor| *floor = below.max(*floor));
        }
    }
    let mut floors = vec![Vec::new(); depth.values().max().map_or(0, |most| most + 1)];
    for (name, floor) in depth {
        floors[floor].push(name);
    }
    floors
}

/// The arrows that do not follow from others.
fn without_detours(arrows: &Arrows) -> Arrows {
    let next = |from: &String| {
        let of = arrows.iter().filter(move |(other, _)| other == from);
        of.map(|(_, to)| to.clone()).collect::<Vec<_>>()
    };
    let reaches = |from: &String, goal: &String| {
        let (mut left, mut seen) = (next(from), BTreeSet::new());
        while let Some(room) = left.pop() {
            if room == *goal {
                return true;
            }
            if seen.insert(room.clone()) {
                left.extend(next(&room));
            }
        }
        false
    };
    let is_needed = |(from, to): &&(String, String)| {
        !next(from).iter().any(|between| between != to && reaches(between, to))
    };
    arrows.iter().filter(is_needed).cloned().collect()
}

/// Where each box of a panel is: its middle, and its width.
fn places(panel: &Panel, top: f64) -> BTreeMap<&str, (f64, f64, f64)> {
    let mut places: BTreeMap<&str, (f64, f64, f64)> = BTreeMap::new();
    for (floor, names) in panel.floors.iter().enumerate() {
        // Below what points to it, as far as its neighbours let it.
        let mut wanted: Vec<(f64, &str)> = names
            .iter()
            .map(|name| {
                let above = panel.arrows.iter().filter(|(_, to)| to == name);
                let above: Vec<f64> =
                    above.filter_map(|(from, _)| Some(places.get(from.as_str())?.0)).collect();
                let middle = above.iter().sum::<f64>() / above.len().max(1) as f64;
                (if above.is_empty() { WIDTH / 2.0 } else { middle }, name.as_str())
            })
            .collect();
        wanted.sort_by(|one, other| one.0.total_cmp(&other.0).then(one.1.cmp(other.1)));
        let share = (WIDTH - 2.0 * ASIDE) / wanted.len() as f64;
        let aside = ASIDE * (floor % 3) as f64;
        let y = top + HEADING + floor as f64 * ROW;
        for (index, (_, name)) in wanted.into_iter().enumerate() {
            let width = name.len() as f64 * LETTER + 24.0;
            places.insert(name, (aside + share * (index as f64 + 0.5), y, width));
        }
    }
    places
}

fn svg(panels: &[Panel]) -> String {
    let mut body = String::new();
    let mut top = 10.0;
    for panel in panels {
        draw_panel(&mut body, panel, top);
        top += HEADING + panel.floors.len() as f64 * ROW;
    }
    format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {top}\" font-family=\"sans-serif\">\n\
         <!-- Made by cargo xtask picture. -->\n\
         <defs><marker id=\"tip\" viewBox=\"0 0 8 8\" refX=\"7\" refY=\"4\" markerWidth=\"7\" \
         markerHeight=\"7\" orient=\"auto\"><path d=\"M0 0 8 4 0 8z\" fill=\"#557\"/></marker></defs>\n\
         <rect width=\"{WIDTH}\" height=\"{top}\" fill=\"#fff\"/>\n{body}</svg>\n"
    )
}

fn draw_panel(body: &mut String, panel: &Panel, top: f64) {
    let places = places(panel, top);
    // Writing to a String cannot fail.
    let _ = writeln!(
        body,
        "<text x=\"16\" y=\"{:.0}\" font-size=\"17\" font-weight=\"bold\" fill=\"#223\">{}</text>",
        top + 20.0,
        panel.title
    );
    for (from, to) in &panel.arrows {
        let (Some((x1, y1, _)), Some((x2, y2, _))) =
            (places.get(from.as_str()), places.get(to.as_str()))
        else {
            continue;
        };
        let (y1, y2) = (y1 + BOX, y2 - 1.0);
        let bend = ((y2 - y1) / 2.0).min(ROW);
        let _ = writeln!(
            body,
            "<path d=\"M{x1:.0} {y1:.0}C{x1:.0} {:.0} {x2:.0} {:.0} {x2:.0} {y2:.0}\" fill=\"none\" \
             stroke=\"#557\" stroke-opacity=\"0.65\" marker-end=\"url(#tip)\"/>",
            y1 + bend,
            y2 - bend
        );
    }
    for (name, (x, y, width)) in &places {
        let _ = writeln!(
            body,
            "<rect x=\"{:.0}\" y=\"{y:.0}\" width=\"{width:.0}\" height=\"{BOX}\" rx=\"5\" \
             fill=\"#eef2fb\" stroke=\"#446\"/><text x=\"{x:.0}\" y=\"{:.0}\" font-size=\"14\" \
             text-anchor=\"middle\" fill=\"#113\">{name}</text>",
            x - width / 2.0,
            y + 20.0
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rustls_axon::workspace;

    fn arrows(pairs: &[(&str, &str)]) -> Arrows {
        pairs.iter().map(|(from, to)| ((*from).to_owned(), (*to).to_owned())).collect()
    }

    #[test]
    fn the_picture_shows_the_current_imports() {
        let drawn = fs::read_to_string(workspace().join(FILE)).unwrap();
        let today = picture(workspace()).unwrap();
        assert!(drawn == today, "{FILE} is out of date: cargo xtask picture draws it anew");
        for room in ["axon-shm", "reactor", "registry"] {
            assert!(drawn.contains(&format!(">{room}</text>")), "{room}");
        }
    }

    #[test]
    fn an_arrow_that_follows_from_others_is_left_out() {
        let all = arrows(&[("a", "b"), ("b", "c"), ("c", "d"), ("a", "d"), ("a", "c"), ("e", "d")]);
        let needed = arrows(&[("a", "b"), ("b", "c"), ("c", "d"), ("e", "d")]);
        assert_eq!(without_detours(&all), needed);
        let names = ["a", "b", "c", "d", "e"].map(str::to_owned);
        let expected = [vec!["a", "e"], vec!["b"], vec!["c"], vec!["d"]];
        assert_eq!(floors_of(names, &all), expected);
    }
}
