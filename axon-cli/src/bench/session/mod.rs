//! `axon bench session`: measures what a session adds to the shared memory under it.

pub(super) mod medium;
pub(super) mod place;
mod report;

use std::{
    fs,
    io::{self, Write},
};

use self::{
    medium::{Service, Sessions},
    place::BenchHost,
};
use super::{
    harness::{self, Axon, Load, Medium, Motion, Pair, Progress, Rounds, Wake, words},
    run::Run,
};
use crate::{cli, failure::CliError};

const SIZES: [usize; 7] = [64, 1 << 10, 4 << 10, 64 << 10, 256 << 10, 1 << 20, 4 << 20];
const QUICK_SIZES: [usize; 2] = [64, 64 << 10];
const KINDS: [(Wake, Motion); 4] = [
    (Wake::Poll, Motion::Copy),
    (Wake::Poll, Motion::Touch),
    (Wake::Event, Motion::Copy),
    (Wake::Event, Motion::Touch),
];
/// The most time that a session may take, divided by that of bare shared memory.
const BUDGET: f64 = 1.3;
/// The most time that a request and its response may take, divided by the time of a session's message one way. Both are
/// copied in and out.
const SERVICE_BUDGET: f64 = 2.5;

const ANSWERING: &str = "bench-session-answer";

/// The times of each medium that carries a load. They are one way, which is half a round trip, or from message to
/// message.
struct Compared {
    load: Load,
    bare: Rounds,
    session: Rounds,
    service: Option<Rounds>,
}

struct Results {
    run: Run,
    latency: Vec<Compared>,
    streams: Vec<Compared>,
}

/// Runs `axon bench session`.
pub(crate) fn run(args: &cli::BenchSession) -> Result<(), CliError> {
    let sizes = match (&args.sizes[..], args.quick) {
        ([], false) => &SIZES[..],
        ([], true) => &QUICK_SIZES[..],
        (sizes, _) => sizes,
    };
    let results = measure(sizes, args.quick).map_err(CliError::failed)?;
    fs::create_dir_all(&args.out)?;
    fs::write(args.out.join("session.json"), report::json(&results))?;
    let mut out = io::stdout().lock();
    out.write_all(report::text(&results).as_bytes())?;
    writeln!(out, "\nsession.json is in {}", args.out.display())?;
    Ok(())
}

/// Runs as the process that answers.
pub(crate) fn answer() -> Result<(), CliError> {
    harness::serve(&media(&Sessions(None), &Service(None))).map_err(CliError::failed)
}

/// Returns the media, with bare shared memory first.
fn media<'a>(sessions: &'a Sessions, service: &'a Service) -> [&'a dyn Medium; 3] {
    [&Axon, sessions, service]
}

fn measure(sizes: &[usize], quick: bool) -> harness::Result<Results> {
    let run = Run::start(quick)?;
    let place = BenchHost::start()?;
    let hosts = Some([place.settings(), place.settings()]);
    let (sessions, service) = (Sessions(hosts.clone()), Service(hosts));
    let media = media(&sessions, &service);
    let progress = Progress::new(sizes.len() * 2 * KINDS.len());
    let pair = Pair::start(&media, run.effort, &run.machine, &[ANSWERING])?;
    let (mut latency, mut streams) = (Vec::new(), Vec::new());
    for (wake, motion) in KINDS {
        progress.step(&format!("latency, {}", words::kind(wake, motion)));
        for size in sizes {
            let load = Load::ping_pong(*size, wake, motion);
            latency.push(compared(load, pair.latency(&load)?)?);
            progress.advance();
        }
    }
    for (wake, motion) in KINDS {
        progress.step(&format!("throughput, {}", words::kind(wake, motion)));
        for size in sizes {
            let load = Load::stream(*size, wake, motion);
            streams.push(compared(load, pair.stream(&load)?)?);
            progress.advance();
        }
    }
    Ok(Results { run, latency, streams })
}

fn compared(load: Load, rounds: Vec<Rounds>) -> harness::Result<Compared> {
    let mut rounds = rounds.into_iter();
    let (bare, session) = rounds.next().zip(rounds.next()).ok_or("no figures")?;
    Ok(Compared { load, bare, session, service: rounds.next() })
}
