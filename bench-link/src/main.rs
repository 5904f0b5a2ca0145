//! Measures AXON, beside TCP, over a path that loses packets, delays them and limits their rate: two hosts are two
//! network namespaces, and this program carries the packets between them.
#![forbid(unsafe_code)]
#![allow(clippy::print_stdout, reason = "what it prints is its result")]

mod host;
mod kmes;
mod lend;
mod mode;
mod part;
mod path;
mod place;
mod plot;
mod relay;
mod scenarios;
mod table;
mod tcp;
mod torture;

use std::{error, fs, path::PathBuf, process::ExitCode, time::Duration};

use axon_daemon::{ErasingHeap, Start};
use clap::{Parser, Subcommand, ValueEnum};
use serde_json::{Map, Value, json};

use self::{
    mode::Mode,
    part::Part,
    path::{Loss, Settings},
    place::Plan,
    scenarios::Options,
};

/// Whatever stops a measurement.
type Error = Box<dyn error::Error + Send + Sync>;
/// What it stops.
type Result<T> = std::result::Result<T, Error>;

#[global_allocator]
static HEAP: ErasingHeap = ErasingHeap;

/// Measures AXON, beside TCP, between two network namespaces.
///
/// The path between them loses packets, delays them and limits their rate. Needs Linux with /dev/net/tun, iproute2, and
/// the right to make network namespaces: root, or user namespaces.
#[derive(Parser)]
struct Arguments {
    #[command(subcommand)]
    command: Option<Command>,
    /// What is measured [default: all but torture].
    #[arg(value_enum)]
    scenarios: Vec<Scenario>,
    /// The path's rate in Mbit/s.
    #[arg(long, global = true, default_value_t = 54.0)]
    rate: f64,
    /// The path's round trip in milliseconds.
    #[arg(long, global = true, default_value_t = 3.0)]
    round_trip: f64,
    /// Bytes that may wait for their turn, each way.
    #[arg(long, global = true, default_value_t = 256 << 10)]
    queue: usize,
    /// Losses in percent, both ways.
    #[arg(long, global = true, value_delimiter = ',', default_values_t = [0.0, 10.0, 20.0, 30.0, 40.0])]
    losses: Vec<f64>,
    /// Packets that are lost in a row, on average.
    #[arg(long, global = true, default_value_t = 1.0)]
    burst: f64,
    /// How long each stream flows, in seconds; paths and torture: how long all flow [default: 20; paths: 60; torture: 3600].
    #[arg(long)]
    seconds: Option<f64>,
    /// Security modes of both daemons: everything is measured in each. TCP is measured in the first one only.
    #[arg(long, value_enum, value_delimiter = ',', default_values_t = [Mode::Classic])]
    mode: Vec<Mode>,
    /// `[link] congestion` of both daemons.
    #[arg(long, default_value = "auto", value_parser = ["auto", "delay", "cubic", "bbr"])]
    congestion: String,
    /// Decides which packets are lost.
    #[arg(long, global = true, default_value_t = 1)]
    seed: u64,
    /// Writes the figures to this file.
    #[arg(long)]
    json: Option<PathBuf>,
    /// Draws what arrives at which loss to this file, as SVG; needs `losses`.
    #[arg(long)]
    plot: Option<PathBuf>,
}

#[derive(Subcommand)]
enum Command {
    /// Is a program of a measurement.
    #[command(hide = true)]
    Part { part: String },
    /// Lends the two hosts and the path between them to other programs, until the standard input ends.
    ///
    /// Prints how the hosts are entered, and at the end what became of the packets, as a line of JSON each. `--losses`
    /// names one loss.
    Relay,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Scenario {
    /// What arrives in time at which loss.
    Losses,
    /// How much of the rate a stream gets.
    Flood,
    /// A command beside a camera that fills the link.
    Camera,
    /// A path whose rate falls, and comes back.
    Slow,
    /// A path that is cut, and comes back.
    Cut,
    /// Two paths, of which one after the other is cut.
    Paths,
    /// Processes and daemons that are killed over a path that fails at random: every sample is accounted for.
    Torture,
}

impl Scenario {
    fn run(self, options: &Options) -> Result<Value> {
        match self {
            Self::Losses => scenarios::losses(options),
            Self::Flood => scenarios::flood(options),
            Self::Camera => scenarios::camera(options),
            Self::Slow => scenarios::slow(options),
            Self::Cut => scenarios::cut(options),
            Self::Paths => scenarios::paths(options),
            Self::Torture => torture::torture(options),
        }
    }
}

fn main() -> ExitCode {
    // A session starts this program as its daemon.
    if let Some(start @ (Start::Spawned | Start::Detached)) =
        Start::from_arguments(std::env::args_os().skip(1))
    {
        return axon_daemon::main(start);
    }
    match run(&Arguments::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("axon-bench-link: {error}");
            ExitCode::FAILURE
        }
    }
}

fn run(arguments: &Arguments) -> Result<()> {
    if let Some(Command::Part { part }) = &arguments.command {
        return serde_json::from_str::<Part>(part)?.run();
    }
    let path = path(arguments)?;
    host::prepare()?;
    if let Some(Command::Relay) = &arguments.command {
        let [percent] = arguments.losses[..] else {
            return Err("relay takes one loss, for example --losses 20".into());
        };
        let loss = Loss { share: percent / 100.0, burst: arguments.burst };
        return lend::lend(Settings { loss, ..path }, arguments.seed);
    }
    println!(
        "{} Mbit/s, round trip {} ms, queue {} bytes, bursts of {} packets; congestion = {}; TCP with the kernel's {}",
        arguments.rate,
        arguments.round_trip,
        arguments.queue,
        arguments.burst,
        arguments.congestion,
        tcp::congestion()?
    );
    let all = Scenario::value_variants().iter().copied();
    let chosen = match &arguments.scenarios[..] {
        [] => all.filter(|scenario| *scenario != Scenario::Torture).collect(),
        chosen => chosen.to_vec(),
    };
    if arguments.plot.is_some() && !chosen.contains(&Scenario::Losses) {
        return Err(
            "--plot draws the scenario losses, which is not among those that are measured".into()
        );
    }
    let mut figures = Map::new();
    for (index, mode) in arguments.mode.iter().enumerate() {
        println!("\nAXON in {}", mode.name());
        let options = options(arguments, path, *mode, index == 0);
        let mut of_mode = Map::new();
        for scenario in &chosen {
            let name = scenario.to_possible_value().ok_or("a scenario without a name")?;
            of_mode.insert(name.get_name().to_owned(), scenario.run(&options)?);
        }
        figures.insert(mode.name().to_owned(), of_mode.into());
    }
    if let Some(file) = &arguments.plot {
        plot::losses(file, &figures)?;
    }
    if let Some(file) = &arguments.json {
        let document = json!({
            "benchmark": "axon-bench-link",
            "rate_mbits": arguments.rate,
            "round_trip_ms": arguments.round_trip,
            "queue_bytes": arguments.queue,
            "burst_packets": arguments.burst,
            "seconds": arguments.seconds,
            "congestion": arguments.congestion,
            "tcp_congestion": tcp::congestion()?,
            "optimized": !cfg!(debug_assertions),
            "figures": figures,
        });
        fs::write(file, format!("{document:#}\n"))?;
    }
    Ok(())
}

/// The path without losses, if the arguments make sense.
fn path(arguments: &Arguments) -> Result<Settings> {
    let is_share = |percent: &f64| (0.0..100.0).contains(percent);
    if !arguments.losses.iter().all(is_share) {
        return Err("--losses are percentages from 0 to below 100".into());
    }
    for (name, value) in [("rate", arguments.rate), ("seconds", arguments.seconds.unwrap_or(1.0))] {
        if !(value > 0.0 && value.is_finite()) {
            return Err(format!("--{name} has to be above 0").into());
        }
    }
    Ok(Settings {
        rate: arguments.rate * 1e6,
        queue: arguments.queue,
        delay: Duration::try_from_secs_f64(arguments.round_trip / 2e3)?,
        loss: Loss::NONE,
        is_cut: false,
    })
}

fn options(arguments: &Arguments, path: Settings, mode: Mode, with_tcp: bool) -> Options {
    Options {
        path,
        time: arguments.seconds.map(Duration::from_secs_f64),
        losses: arguments.losses.iter().map(|percent| percent / 100.0).collect(),
        burst: arguments.burst,
        plan: Plan {
            mode,
            congestion: arguments.congestion.clone(),
            link: "",
            paths: 1,
            seed: arguments.seed,
        },
        with_tcp,
    }
}
