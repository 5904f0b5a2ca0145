//! `axon bench`: compares AXON's shared memory with the machine's raw limits, and AXON's sessions with its own shared
//! memory.

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
    time::Duration,
};

use self::{
    harness::{
        Axon, Load, Medium, Motion, Pair, Progress, Raw, Rounds, SIZES, Sleeps, Wake, words,
    },
    readers::{Cost, ReaderProcesses},
    run::Run,
};
use crate::{cli, failure::CliError};

/// The sizes of a quick run. Messages of these sizes are inline, copied, and in place.
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

/// The default sizes of messages that have a pace. `READ_SIZES` are the default sizes of messages that many processes
/// read.
const FEW_SIZES: [usize; 2] = [64, 64 << 10];
const READ_SIZES: [usize; 4] = [64, 4 << 10, 64 << 10, 1 << 20];
/// The times from message to message: 100 Hz and 1 kHz.
const PACES: [Duration; 2] = [Duration::from_millis(10), Duration::from_millis(1)];

/// The media. The raw limits come first. Each load has one raw limit, and a load with a pace has two.
const MEDIA: [&dyn Medium; 4] =
    [&Raw(Sleeps::Epoll), &Raw(Sleeps::SpinEpoll), &Raw(Sleeps::Futex), &Axon];

const ANSWERING: &str = "bench-answer";
const READING: &str = "bench-read";

/// The times of the raw limit and of AXON under one load.
struct Compared {
    load: Load,
    raw: Rounds,
    axon: Rounds,
}

/// The times of two raw limits and of AXON under a load with a pace.
struct Paced {
    load: Load,
    epoll: Rounds,
    futex: Rounds,
    axon: Rounds,
}

/// All measurements.
struct Results {
    run: Run,
    /// Sorted by kind, then by size.
    latency: Vec<Compared>,
    /// Sorted by pace, then by size.
    paced: Vec<Paced>,
    streams: Vec<Compared>,
    publish: Vec<Cost>,
}

/// Runs `axon bench shm`.
pub(crate) fn shm(args: &cli::BenchShm) -> Result<(), CliError> {
    let sizes = match (&args.sizes[..], args.quick) {
        ([], false) => &SIZES[..],
        ([], true) => &QUICK_SIZES[..],
        (sizes, _) => sizes,
    };
    let few = |few: &'static [usize]| if args.sizes.is_empty() { few } else { sizes };
    let results = measure(sizes, few(&FEW_SIZES), few(&READ_SIZES), args.quick);
    let results = results.map_err(CliError::failed)?;
    fs::create_dir_all(&args.out)?;
    let file = |name: &str| args.out.join(name);
    fs::write(file("shm.json"), report::json(&results))?;
    fs::write(file("shm.svg"), chart::svg(&results))?;
    let mut out = io::stdout().lock();
    out.write_all(report::text(&results).as_bytes())?;
    writeln!(out, "\nshm.json and shm.svg are in {}", args.out.display())?;
    Ok(())
}

/// Runs as the process that answers one that measures.
pub(crate) fn answer() -> Result<(), CliError> {
    harness::serve(&MEDIA).map_err(CliError::failed)
}

/// Runs as one of the reader processes of a publish measurement.
pub(crate) fn read() -> Result<(), CliError> {
    readers::attend().map_err(CliError::failed)
}

fn measure(
    sizes: &[usize],
    paced_sizes: &[usize],
    read_sizes: &[usize],
    quick: bool,
) -> harness::Result<Results> {
    let run = Run::start(quick)?;
    let loads = sizes.len() * (KINDS.len() + STREAMS.len());
    let progress = Progress::new(loads + paced_sizes.len() * PACES.len() + read_sizes.len());
    let (mut latency, mut paced) = (Vec::new(), Vec::new());
    let (mut streams, mut publish) = (Vec::new(), Vec::new());

    let pair = Pair::start(&MEDIA, run.effort, &run.machine, &[ANSWERING])?;
    for (wake, motion) in KINDS {
        progress.step(&format!("latency, {}", words::kind(wake, motion)));
        for size in sizes {
            let load = Load::ping_pong(*size, wake, motion);
            latency.push(compared(load, pair.latency(&load)?)?);
            progress.advance();
        }
    }
    for pace in PACES {
        progress.step(&format!("latency at {}", words::pace(pace)));
        for size in paced_sizes {
            let load = Load::paced(*size, Motion::Copy, pace);
            let rounds = pair.paced(&load)?.try_into();
            let [epoll, futex, axon] = rounds.map_err(|_| "another number of media")?;
            paced.push(Paced { load, epoll, futex, axon });
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
    let readers = ReaderProcesses::start(&run.machine, &[READING])?;
    for size in read_sizes {
        publish.extend(readers.measure(*size, run.effort)?);
        progress.advance();
    }
    drop(readers);
    Ok(Results { run, latency, paced, streams, publish })
}

fn compared(load: Load, rounds: Vec<Rounds>) -> harness::Result<Compared> {
    let [raw, axon] = rounds.try_into().map_err(|_| "another number of media")?;
    Ok(Compared { load, raw, axon })
}
