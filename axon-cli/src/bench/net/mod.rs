//! `axon bench net`: compares AXON between two hosts with a stream of bare quinn.

mod bare;
mod hosts;
mod report;
mod stream;

use std::{
    fs,
    io::{self, Write},
    time::Duration,
};

use self::{
    bare::{BareQuic, Threads},
    hosts::Hosts,
    stream::{Flow, Reader, Streamed},
};
use super::{
    PACES,
    harness::{self, Load, Medium, Motion, Pair, Progress, Raw, Rounds, Sleeps, Wake, words},
    run::Run,
    session::medium::Sessions,
};
use crate::{
    cli,
    demo::{kmes::Kmes, mode::Mode},
    failure::CliError,
};

const SIZES: [usize; 6] = [64, 1 << 10, 4 << 10, 64 << 10, 1 << 20, 4 << 20];
const QUICK_SIZES: [usize; 2] = [64, 64 << 10];
/// The longest message with a pace. One packet holds it. Bare quinn has no thread that would process the
/// acknowledgements for which the rest of a longer message waits.
const MAX_PACED: usize = 1 << 10;

const ANSWERING: &str = "bench-net-answer";
const READING: &str = "bench-net-read";

/// Round trips by turns. Times are one way, which is half a round trip.
struct Latency {
    size: usize,
    bare: Rounds,
    axon: Rounds,
}

/// Messages with a pace. Times are from just before a message is sent until it was taken.
struct Paced {
    load: Load,
    /// The time of one wake-up, from one process to another in shared memory.
    wake_up: Rounds,
    bare: Rounds,
    axon: Rounds,
}

impl Paced {
    /// Returns the longest permitted time of AXON: bare quinn's time, and one wake-up for each daemon.
    fn allowed(&self) -> f64 {
        self.bare.typical() + 2.0 * self.wake_up.typical()
    }
}

/// Streams of one size, by turns. Each field is the best turn.
struct Streams {
    size: usize,
    bare: Streamed,
    waits: Streamed,
    overtakes: Streamed,
}

struct Measured {
    mode: Mode,
    latency: Vec<Latency>,
    /// Sorted by pace, then by size.
    paced: Vec<Paced>,
    streams: Vec<Streams>,
}

struct Results {
    run: Run,
    modes: Vec<Measured>,
}

/// Runs `axon bench net`.
pub(crate) fn run(args: &cli::BenchNet) -> Result<(), CliError> {
    let sizes = match (&args.sizes[..], args.quick) {
        ([], false) => &SIZES[..],
        ([], true) => &QUICK_SIZES[..],
        (sizes, _) => sizes,
    };
    let modes = match &args.modes[..] {
        [] => &Mode::ALL[..],
        modes => modes,
    };
    let results = measure(sizes, modes, args.quick).map_err(CliError::failed)?;
    fs::create_dir_all(&args.out)?;
    fs::write(args.out.join("net.json"), report::json(&results))?;
    let mut out = io::stdout().lock();
    out.write_all(report::text(&results).as_bytes())?;
    writeln!(out, "\nnet.json is in {}", args.out.display())?;
    Ok(())
}

/// Runs as the process that answers.
pub(crate) fn answer() -> Result<(), CliError> {
    harness::serve(&media(&Sessions(None))).map_err(CliError::failed)
}

/// Runs as the process that reads streams.
pub(crate) fn read() -> Result<(), CliError> {
    stream::attend().map_err(CliError::failed)
}

/// Returns the media, with the raw limits first. The wake-up limit is used only for messages that have a pace.
fn media(sessions: &Sessions) -> [&dyn Medium; 3] {
    [&Raw(Sleeps::Epoll), &BareQuic, sessions]
}

fn measure(sizes: &[usize], modes: &[Mode], quick: bool) -> harness::Result<Results> {
    let run = Run::start(quick)?;
    let (turns, length) = if quick { (1, 20) } else { (3, 1000) };
    let length = Duration::from_millis(length);
    let directory = tempfile::Builder::new().prefix("axon-bench-").tempdir()?;
    let runtime =
        tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build()?;
    let kmes = runtime.block_on(Kmes::start(directory.path()))?;
    let paced_sizes = || sizes.iter().copied().filter(|size| *size <= MAX_PACED);
    let steps = sizes.len() * 2 + paced_sizes().count() * PACES.len();
    let progress = Progress::new(modes.len() * steps);
    let mut measured = Vec::new();
    for mode in modes {
        let hosts = Hosts::start(&runtime, *mode, &kmes, directory.path())?;
        let sessions = Sessions(Some(hosts.settings.clone()));
        let media = media(&sessions);

        progress.step(&format!("latency, {}", mode.route()));
        let pair = Pair::start(&media, run.effort, &run.machine, &[ANSWERING])?;
        let mut latency = Vec::new();
        for size in sizes {
            let load = Load::ping_pong(*size, Wake::Event, Motion::Copy);
            let [bare, axon] =
                pair.latency(&load)?.try_into().map_err(|_| "a medium without figures")?;
            latency.push(Latency { size: *size, bare, axon });
            progress.advance();
        }
        let mut paced = Vec::new();
        for pace in PACES {
            progress.step(&format!("latency at {}, {}", words::pace(pace), mode.route()));
            for size in paced_sizes() {
                let load = Load::paced(size, Motion::Copy, pace);
                let rounds = pair.paced(&load)?.try_into();
                let [wake_up, bare, axon] = rounds.map_err(|_| "a medium without figures")?;
                paced.push(Paced { load, wake_up, bare, axon });
                progress.advance();
            }
        }
        drop(pair);

        progress.step(&format!("streams, {}", mode.route()));
        run.machine.release()?;
        let reader = Reader::start(&[READING])?;
        let mut streams = Vec::new();
        for size in sizes {
            let by_turns = (0..turns).map(|_| {
                Ok([
                    reader.bare(*size, Threads::One, length)?,
                    reader.bare(*size, Threads::Two, length)?,
                    reader.axon(&hosts, *size, Flow::Waits, length)?,
                    reader.axon(&hosts, *size, Flow::Overtakes, length)?,
                ])
            });
            let by_turns = by_turns.collect::<harness::Result<Vec<_>>>()?;
            let best = |which: usize| {
                let one = |turn: &[Streamed; 4]| turn[which];
                let more = |a: &Streamed, b: &Streamed| a.per_second().total_cmp(&b.per_second());
                by_turns.iter().map(one).max_by(more).ok_or("no turn")
            };
            let [one, two, waits, overtakes] = [best(0)?, best(1)?, best(2)?, best(3)?];
            let bare = if one.per_second() >= two.per_second() { one } else { two };
            streams.push(Streams { size: *size, bare, waits, overtakes });
            progress.advance();
        }
        measured.push(Measured { mode: *mode, latency, paced, streams });
    }
    Ok(Results { run, modes: measured })
}
