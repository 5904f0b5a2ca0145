//! A process with one thread that prepares scenes, kills, and reports.

use std::{
    collections::BTreeSet,
    fmt,
    io::{Write as _, stdout},
    os::fd::{AsFd, OwnedFd},
};

use nix::{sys::prctl, unistd::alarm};
use rustix::{
    fs::{SeekFrom, seek},
    io::pread,
};

use crate::{
    around::{Around, Tidy},
    cases::cases,
    operation::Case,
    report::Report,
    survivor::{Holdings, Outcome, Scene},
};

/// Number of kills of a bounded run in total, if there are enough instructions.
const BOUNDED: usize = 1000;
/// The instructions at which a bounded run kills a long operation.
const BLIND: [u64; 8] = [0, 100, 1000, 5000, 10_000, 20_000, 40_000, u64::MAX];
/// Default number of steps in which a full run kills an operation at each of its instructions, or
/// at every nth instruction of a long one. The states take about as many steps again.
pub(crate) const STEPS: u64 = 2_000_000;
/// Number of states of a long operation around which a full run kills it. The last states add half
/// as many.
const STATES: u64 = 100;
/// Lower limit of that number, however long the operation is.
const FEW_STATES: u64 = 8;
/// Seconds after which a process is stuck: the limit for [this many steps](STRIDE), for the
/// preparation of a scene, and for the survivor after a death.
const PATIENCE: u32 = 60;
const STRIDE: u64 = 1000;
/// An operation with more instructions is in an endless loop.
const ENDLESS: u64 = 20_000_000;

/// The task of a worker.
pub(crate) struct Plan {
    /// The number of steps of a full run; `None` for a bounded run.
    pub(crate) steps: Option<u64>,
    pub(crate) cases: Vec<usize>,
}

pub(crate) fn run(plan: &Plan) {
    // This process has to reap the forks of a doomed process.
    prctl::set_child_subreaper(true).expect("a subreaper");
    let _tidy = Tidy;
    let all = cases();
    for &index in &plan.cases {
        let case = &all[index];
        let say = |what: &str| {
            let mut out = stdout().lock();
            writeln!(out, "{what}").and_then(|()| out.flush()).expect("somebody who listens");
        };
        if let Some(why) = case.around.refused() {
            say(&Report::skipped(case.name, &why).line());
            continue;
        }
        say(&format!("\"{}\", walking", case.name));
        // A long operation is killed at some points all the same; only the full run looks for its
        // states.
        let (instructions, states) =
            if case.long && plan.steps.is_none() { Default::default() } else { walk(case) };
        let points = match instructions {
            0 => BLIND.into(),
            _ => points(plan.steps, instructions, &states, BOUNDED.div_ceil(all.len())),
        };
        let mut outcomes = Vec::with_capacity(points.len());
        for &point in &points {
            say(&format!("\"{}\", instruction {point}", case.name));
            outcomes.push((point, at(case, point)));
        }
        let begun = outcomes[0].1.shown && case.around != Around::Stopped;
        assert!(!begun, "{}: shown before it begins", case.name);
        assert!(outcomes.last().is_some_and(|(_, o)| o.done), "the last point is the end");
        let shown = outcomes.iter().filter(|(_, outcome)| outcome.shown).count();
        let many = instructions == 0;
        let counted = |count: u64| if many { "many".to_owned() } else { count.to_string() };
        let report = Report {
            name: case.name.to_owned(),
            dies: if case.operation.kills_publisher() { "publisher" } else { "reader" }.to_owned(),
            instructions: counted(instructions),
            states: counted(states.len() as u64),
            kills: outcomes.len(),
            shown,
            skipped: String::new(),
        };
        say(&report.line());
    }
}

/// Kills the process after `point` instructions.
fn at(case: &Case, point: u64) -> Outcome {
    alarm::set(PATIENCE);
    let before = Holdings::now();
    let mut scene = Scene::set(case);
    advance(&mut scene, point);
    let outcome = if case.around == Around::Stopped { scene.stop() } else { scene.kill() };
    assert_eq!(Holdings::now(), before, "something is left");
    alarm::cancel();
    outcome
}

/// Takes up to `count` steps, however slow the machine is.
fn advance(scene: &mut Scene<'_>, count: u64) {
    let (mut taken, mut done) = (0, false);
    while taken < count && !done {
        assert!(taken < ENDLESS, "it goes round in circles");
        alarm::set(PATIENCE);
        let some = STRIDE.min(count - taken);
        done = scene.advance(some);
        taken += some;
    }
    alarm::set(PATIENCE);
}

/// Steps through the operation. Returns the number of its instructions, and the numbers of those
/// that changed a segment.
fn walk(case: &Case) -> (u64, Vec<u64>) {
    alarm::set(PATIENCE);
    let mut scene = Scene::set(case);
    let mut last = contents(&scene.written);
    let (mut steps, mut states, mut done) = (0, Vec::new(), false);
    while !done {
        done = scene.advance(1);
        steps += 1;
        if steps % STRIDE == 0 {
            assert!(steps < ENDLESS, "it goes round in circles");
            alarm::set(PATIENCE);
        }
        scene.look_for_segments();
        let now = contents(&scene.written);
        if now != last {
            states.push(steps);
            last = now;
        }
    }
    alarm::cancel();
    (steps, states)
}

/// Returns the parts of the segments that are backed by memory. Reads without mapping, which would
/// back the holes.
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

/// Returns the numbers of the instructions after which to kill, in ascending order.
fn points(steps: Option<u64>, instructions: u64, states: &[u64], share: usize) -> Vec<u64> {
    let mut points = BTreeSet::from([0, instructions]);
    // The end may come later in another run, because addresses and the allocator's state differ.
    points.insert(2 * instructions + 10_000);
    let around = |state: &u64| [state - 1, *state];
    if let Some(steps) = steps {
        // Each run has to execute all instructions before the kill, so of many instructions only
        // every nth is chosen.
        let every = (instructions * instructions).div_ceil(2 * steps).max(1);
        points.extend((0..=instructions).step_by(usize::try_from(every).expect("a step")));
        // If there are many states, most of them are words of a payload that no reader sees yet.
        let share = (steps / instructions).clamp(FEW_STATES, STATES);
        let share = usize::try_from(share).expect("a number of states");
        let many = states.len().div_ceil(share);
        points.extend(states.iter().step_by(many.max(1)).flat_map(around));
        points.extend(states.iter().rev().take(share / 2).flat_map(around));
        return points.into_iter().collect();
    }
    let mut random = instructions;
    let mut below = |bound: u64| {
        random = random.wrapping_mul(0x5851_f42d_4c95_7f2d).wrapping_add(0x1405_7b7e_f767_814f);
        (random >> 32) % bound
    };
    if 2 * states.len() < share {
        points.extend(states.iter().flat_map(around));
    } else {
        // If there are many states, the last ones publish what the others prepared.
        points.extend(states[states.len() - share / 4..].iter().flat_map(around));
    }
    let share = share.min(usize::try_from(instructions / 2).unwrap_or(share));
    while points.len() < share {
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
        let (steps, cases) = text.split_once(':').expect("a plan");
        let cases = cases.split(',').filter_map(|n| n.parse().ok()).collect();
        Self { steps: steps.parse().ok(), cases }
    }
}

impl fmt::Display for Plan {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.steps {
            Some(steps) => write!(f, "{steps}:")?,
            None => f.write_str("bounded:")?,
        }
        let cases: Vec<String> = self.cases.iter().map(ToString::to_string).collect();
        f.write_str(&cases.join(","))
    }
}
