//! `axon bench`: what AXON costs beside what the machine gives without it, and its sessions beside its
//! own shared memory.

mod budgets;
mod chart;
pub(crate) mod harness;
pub(crate) mod net;
mod readers;
mod report;
mod run;
pub(crate) mod session;

use std::{
    fs,
    io::{self, Write},
};

use self::{
    harness::{Axon, Load, Medium, Motion, Pair, Progress, Raw, Rounds, SIZES, Wake, words},
    readers::{Cost, Crowd},
    run::Run,
};
use crate::{cli, failure::Failure};

/// Sizes of a quick run: inline, copied, in place.
const QUICK_SIZES: [usize; 3] = [8, 4 << 10, 64 << 10];

/// The kinds of latency that are measured, in the order of the tables.
const KINDS: [(Wake, Motion); 6] = [
    (Wake::Poll, Motion::Copy),
    (Wake::Poll, Motion::Fill),
    (Wake::Poll, Motion::Touch),
    (Wake::Event, Motion::Touch),
    (Wake::EventOneCpu, Motion::Touch),
    (Wake::Event, Motion::Copy),
];
/// The kinds of streams.
const STREAMS: [Motion; 3] = [Motion::Copy, Motion::Fill, Motion::Touch];

/// The raw limit first.
const MEDIA: [&dyn Medium; 2] = [&Raw, &Axon];

const ANSWERING: &str = "bench-answer";
const READING: &str = "bench-read";

/// A load, and what the raw limit and AXON made of it.
struct Compared {
    load: Load,
    raw: Rounds,
    axon: Rounds,
}

/// All that was measured.
struct Results {
    run: Run,
    /// By kind, then by size.
    latency: Vec<Compared>,
    streams: Vec<Compared>,
    publish: Vec<Cost>,
}

/// Runs `axon bench shm`.
pub(crate) fn shm(args: &cli::BenchShm) -> Result<(), Failure> {
    let sizes = match (&args.sizes[..], args.quick) {
        ([], false) => &SIZES[..],
        ([], true) => &QUICK_SIZES[..],
        (sizes, _) => sizes,
    };
    let results = measure(sizes, args.quick).map_err(Failure::failed)?;
    fs::create_dir_all(&args.out)?;
    let file = |name: &str| args.out.join(name);
    fs::write(file("shm.json"), report::json(&results))?;
    fs::write(file("shm.svg"), chart::svg(&results))?;
    let mut out = io::stdout().lock();
    out.write_all(report::text(&results).as_bytes())?;
    writeln!(out, "\nshm.json and shm.svg are in {}", args.out.display())?;
    Ok(())
}

/// Is the process that answers one that measures.
pub(crate) fn answer() -> Result<(), Failure> {
    harness::serve(&MEDIA).map_err(Failure::failed)
}

/// Is one of the readers that a publish is measured with.
pub(crate) fn read() -> Result<(), Failure> {
    readers::attend().map_err(Failure::failed)
}

fn measure(sizes: &[usize], quick: bool) -> harness::Result<Results> {
    let run = Run::start(quick)?;
    let progress = Progress::new(sizes.len() * (KINDS.len() + STREAMS.len() + 1));
    let (mut latency, mut streams, mut publish) = (Vec::new(), Vec::new(), Vec::new());

    let pair = Pair::start(&MEDIA, run.effort, &run.machine, &[ANSWERING])?;
    for (wake, motion) in KINDS {
        progress.step(&format!("latency, {}", words::kind(wake, motion)));
        for size in sizes {
            let load = Load::ping_pong(*size, wake, motion);
            latency.push(compared(load, pair.latency(&load)?)?);
            progress.advance();
        }
    }
    for motion in STREAMS {
        progress.step(&format!("throughput, {}", words::motion(motion)));
        for size in sizes {
            let load = Load::stream(*size, Wake::Poll, motion);
            streams.push(compared(load, pair.stream(&load)?)?);
            progress.advance();
        }
    }
    drop(pair);

    progress.step("a publish by its readers");
    let crowd = Crowd::start(&[READING])?;
    for size in sizes {
        publish.push(crowd.measure(*size, run.effort)?);
        progress.advance();
    }
    Ok(Results { run, latency, streams, publish })
}

fn compared(load: Load, rounds: Vec<Rounds>) -> harness::Result<Compared> {
    let [raw, axon] = rounds.try_into().map_err(|_| "another number of media")?;
    Ok(Compared { load, raw, axon })
}
