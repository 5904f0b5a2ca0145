//! A process of one thread that sets scenes, kills, and reports.

use std::{
    collections::BTreeSet,
    fmt,
    io::{Write as _, stdout},
    os::fd::{AsFd, OwnedFd},
};

use nix::unistd::alarm;
use rustix::{
    fs::{SeekFrom, seek},
    io::pread,
};

use crate::{
    operation::{Case, cases},
    survivor::{Outcome, Scene, holdings},
};

/// Kills that a bounded run makes in all, if there are so many instructions.
const BOUNDED: usize = 1000;
/// Instructions of an operation that a bounded run leaves to the full one.
const LONG: u64 = 20_000;
/// Where such an operation is killed in a bounded run.
const BLIND: [u64; 8] = [0, 100, 1000, 5000, 10_000, 20_000, 40_000, u64::MAX];
/// A scene that takes longer is wedged, in seconds.
const PATIENCE: u32 = 60;

/// What a worker is to do.
pub(crate) struct Plan {
    pub(crate) full: bool,
    pub(crate) cases: Vec<usize>,
}

/// What came of a case.
pub(crate) struct Report {
    case: usize,
    instructions: u64,
    states: usize,
    pub(crate) kills: usize,
    shown: usize,
}

pub(crate) fn run(plan: &Plan) {
    let all = cases();
    for &index in &plan.cases {
        let case = &all[index];
        let say = |what: &str| {
            let mut out = stdout().lock();
            writeln!(out, "{what}").and_then(|()| out.flush()).expect("somebody who listens");
        };
        say(&format!("\"{}\", walking", case.name));
        let limit = if plan.full { u64::MAX } else { LONG };
        // A long one is killed at some points all the same; the states are for the full run.
        let walked = walk(case, limit);
        let (instructions, states) = walked.unwrap_or_default();
        let points = match instructions {
            0 => BLIND.into(),
            _ => points(plan.full, instructions, &states, BOUNDED.div_ceil(all.len())),
        };
        let mut outcomes = Vec::with_capacity(points.len());
        for &point in &points {
            say(&format!("\"{}\", instruction {point}", case.name));
            outcomes.push((point, at(case, point)));
        }
        assert!(!outcomes[0].1.shown, "{}: shown before it begins", case.name);
        assert!(outcomes.last().is_some_and(|(_, o)| o.done), "the last point is the end");
        let shown = outcomes.iter().filter(|(_, outcome)| outcome.shown).count();
        let kills = outcomes.len();
        let states = states.len();
        say(&Report { case: index, instructions, states, kills, shown }.line());
    }
}

/// Kills after `point` instructions.
fn at(case: &Case, point: u64) -> Outcome {
    alarm::set(PATIENCE);
    let before = holdings();
    let mut scene = Scene::set(case);
    scene.advance(point);
    let outcome = scene.kill();
    assert_eq!(holdings(), before, "descriptors and maps are left");
    alarm::cancel();
    outcome
}

/// Steps through the operation: its instructions, and those after which a segment had changed.
/// `None` where it has more than `limit`.
fn walk(case: &Case, limit: u64) -> Option<(u64, Vec<u64>)> {
    alarm::set(10 * PATIENCE);
    let mut scene = Scene::set(case);
    let mut last = contents(&scene.written);
    let (mut steps, mut states) = (0, Vec::new());
    while steps < limit {
        let done = scene.advance(1);
        steps += 1;
        scene.look_for_segments();
        let now = contents(&scene.written);
        if now != last {
            states.push(steps);
            last = now;
        }
        if done {
            alarm::cancel();
            return Some((steps, states));
        }
    }
    alarm::cancel();
    None
}

/// What memory backs the segments with. Read without mapping: that would back their holes.
fn contents(segments: &[OwnedFd]) -> Vec<(u64, Vec<u8>)> {
    let mut extents = Vec::new();
    for segment in segments {
        let mut from = 0;
        while let Ok(start) = seek(segment.as_fd(), SeekFrom::Data(from)) {
            let end = seek(segment.as_fd(), SeekFrom::Hole(start)).expect("an extent's end");
            let mut bytes = vec![0; usize::try_from(end - start).expect("an extent")];
            let read = pread(segment.as_fd(), &mut bytes[..], start).expect("a segment");
            assert_eq!(read, bytes.len());
            extents.push((start, bytes));
            from = end;
        }
    }
    extents
}

/// The instructions after which to kill, in order.
fn points(full: bool, instructions: u64, states: &[u64], share: usize) -> Vec<u64> {
    let mut points = BTreeSet::from([0, instructions]);
    // The end may come later in another run: addresses and the allocator's state differ.
    points.insert(2 * instructions + 10_000);
    let mut random = instructions;
    let mut below = |bound: u64| {
        random = random.wrapping_mul(0x5851_f42d_4c95_7f2d).wrapping_add(0x1405_7b7e_f767_814f);
        (random >> 32) % bound
    };
    if full {
        points.extend(0..=instructions);
    } else if 2 * states.len() < share {
        points.extend(states.iter().flat_map(|&state| [state - 1, state]));
    } else {
        // Most of many states are words of a payload that nobody sees yet; the last publish it.
        let last = &states[states.len() - share / 4..];
        points.extend(last.iter().flat_map(|&state| [state - 1, state]));
    }
    let share = share.min(usize::try_from(instructions / 2).unwrap_or(share));
    while points.len() < share && !full {
        points.insert(match states {
            [] => below(instructions),
            _ if below(2) == 0 => below(instructions),
            _ => states[usize::try_from(below(states.len() as u64)).expect("an index")],
        });
    }
    points.into_iter().collect()
}

impl Plan {
    pub(crate) fn parse(text: &str) -> Self {
        let (full, cases) = text.split_once(':').expect("a plan");
        let cases = cases.split(',').filter_map(|n| n.parse().ok()).collect();
        Self { full: full == "full", cases }
    }
}

impl fmt::Display for Plan {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(if self.full { "full:" } else { "bounded:" })?;
        let cases: Vec<String> = self.cases.iter().map(ToString::to_string).collect();
        f.write_str(&cases.join(","))
    }
}

impl Report {
    fn line(&self) -> String {
        let Self { case, instructions, states, kills, shown } = self;
        format!("done {case} {instructions} {states} {kills} {shown}")
    }

    pub(crate) fn parse(line: &str) -> Option<Self> {
        let mut numbers = line.strip_prefix("done ")?.split(' ').map(str::parse::<usize>);
        let mut next = || numbers.next()?.ok();
        let (case, instructions) = (next()?, next()? as u64);
        Some(Self { case, instructions, states: next()?, kills: next()?, shown: next()? })
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let case = &cases()[self.case];
        let dies = if case.operation.kills_publisher() { "publisher" } else { "reader" };
        let Self { instructions, states, kills, shown, .. } = self;
        if *instructions == 0 {
            let long = format!("> {LONG}");
            return write!(
                f,
                "{:<44} {dies:>9} {long:>12} {:>7} {kills:>7} {shown:>7}",
                case.name, ""
            );
        }
        write!(
            f,
            "{:<44} {dies:>9} {instructions:>12} {states:>7} {kills:>7} {shown:>7}",
            case.name
        )
    }
}
