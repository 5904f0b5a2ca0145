//! AXON's shared memory beside iceoryx2 and zenoh: the same loads by the same driver in the same
//! run, next to the raw limit.

#[path = "../../axon-cli/src/bench/harness/mod.rs"]
#[allow(dead_code, unused_imports, reason = "`axon bench` uses the rest")]
mod harness;
mod iceoryx;
mod report;
#[path = "../../axon-cli/src/say.rs"]
mod say;
#[path = "../../axon-cli/src/text.rs"]
#[allow(dead_code, reason = "the tool `axon` uses the rest")]
mod text;
mod zenoh;

use std::{
    fs,
    io::{self, Write},
    path::PathBuf,
    time::Duration,
};

use clap::Parser;
use harness::{
    Axon, Effort, Load, Machine, Medium, Motion, Pair, Progress, Raw, Result, Rounds, SIZES,
    Sleeps, Wake, words,
};
use iceoryx::Iceoryx2;
use zenoh::Zenoh;

/// The kinds of latency that are compared. Sleepers on two CPUs are compared at a pace: where messages
/// follow each other at once, AXON looks for a while before it sleeps, and the others do not.
const KINDS: [(Wake, Motion); 3] =
    [(Wake::Poll, Motion::Touch), (Wake::Poll, Motion::Copy), (Wake::EventOneCpu, Motion::Touch)];
/// The kinds of messages at a pace.
const PACED: [Motion; 2] = [Motion::Touch, Motion::Copy];
const PACE: Duration = Duration::from_millis(1);
/// The kinds of streams.
const STREAMS: [Motion; 2] = [Motion::Touch, Motion::Copy];

/// Compares AXON's shared memory with that of iceoryx2 and zenoh.
#[derive(Debug, Parser)]
#[command(name = "bench-peers")]
struct Arguments {
    /// Sizes of messages in bytes, from 8 [default: ten from 8 B to 25 MB]
    #[arg(long, value_name = "BYTES", value_delimiter = ',')]
    sizes: Vec<usize>,
    /// Where to write peers.json and peers.svg
    #[arg(long, value_name = "DIR", default_value = ".")]
    out: PathBuf,
    /// A few messages only: the figures are good for nothing
    #[arg(long)]
    quick: bool,
    /// Is the process that answers
    #[arg(long, hide = true)]
    answer: bool,
}

/// The media in their order.
const MEDIA: [&str; 4] = ["raw", "AXON", "iceoryx2", "zenoh"];

/// A load, and the results of each medium.
struct Compared {
    load: Load,
    rounds: Vec<Rounds>,
}

struct Results {
    machine: Machine,
    quick: bool,
    effort: Effort,
    latency: Vec<Compared>,
    paced: Vec<Compared>,
    streams: Vec<Compared>,
}

fn main() -> Result<()> {
    let arguments = Arguments::parse();
    let (iceoryx, zenoh) = (Iceoryx2::default(), Zenoh::default());
    let media: [&dyn Medium; 4] = [&Raw(Sleeps::Epoll), &Axon, &iceoryx, &zenoh];
    if arguments.answer {
        return harness::serve(&media);
    }
    let sizes = if arguments.sizes.is_empty() { &SIZES[..] } else { &arguments.sizes };
    if sizes.iter().any(|size| *size < 8) {
        return Err("a message has at least 8 bytes".into());
    }
    let results = measure(&media, sizes, arguments.quick)?;
    fs::create_dir_all(&arguments.out)?;
    fs::write(arguments.out.join("peers.json"), report::json(&results))?;
    fs::write(arguments.out.join("peers.svg"), report::svg(&results))?;
    let mut out = io::stdout().lock();
    out.write_all(report::text(&results).as_bytes())?;
    writeln!(out, "\npeers.json and peers.svg are in {}", arguments.out.display())?;
    Ok(())
}

fn measure(media: &[&dyn Medium], sizes: &[usize], quick: bool) -> Result<Results> {
    let effort = if quick { Effort::QUICK } else { Effort::FULL };
    let machine = Machine::look()?;
    let progress = Progress::new(sizes.len() * (KINDS.len() + PACED.len() + STREAMS.len()));
    let pair = Pair::start(media, effort, &machine, &["--answer"])?;
    let (mut latency, mut paced, mut streams) = (Vec::new(), Vec::new(), Vec::new());
    for (wake, motion) in KINDS {
        progress.step(&format!("latency, {}", words::kind(wake, motion)));
        for size in sizes {
            let load = Load::ping_pong(*size, wake, motion);
            latency.push(Compared { load, rounds: pair.latency(&load)? });
            progress.advance();
        }
    }
    for motion in PACED {
        progress.step(&format!("latency at {}, {}", words::pace(PACE), words::motion(motion)));
        for size in sizes {
            let load = Load::paced(*size, motion, PACE);
            paced.push(Compared { load, rounds: pair.paced(&load)? });
            progress.advance();
        }
    }
    for motion in STREAMS {
        progress.step(&format!("throughput, {}", words::motion(motion)));
        for size in sizes {
            let load = Load::stream(*size, Wake::Poll, motion);
            streams.push(Compared { load, rounds: pair.stream(&load)? });
            progress.advance();
        }
    }
    Ok(Results { machine, quick, effort, latency, paced, streams })
}
