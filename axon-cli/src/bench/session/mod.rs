//! `axon bench session`: what a session adds to the shared memory under it.

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
/// What a session may take at most, by what bare shared memory takes.
const BUDGET: f64 = 1.3;
/// What a request and its response may take at most, by what one message takes one way that is copied
/// as they are.
const SERVICE_BUDGET: f64 = 2.5;

const ANSWERING: &str = "bench-session-answer";

/// A load, and what each of those made of it that carry it: times are one way, half a round trip, or
/// from message to message.
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

/// Is the process that answers.
pub(crate) fn answer() -> Result<(), CliError> {
    harness::serve(&media(&Sessions(None), &Service(None))).map_err(CliError::failed)
}

/// Bare shared memory first.
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
