//! `axon demo`: replays a log between two hosts on one machine over every route, and attempts
//! connections that must be refused.

mod classical;
mod env_file;
mod events;
pub(crate) mod hosts;
pub(crate) mod kmes;
pub(crate) mod mode;
mod player;
mod process;
mod progress;
mod report;
mod route;
mod subscriber;
mod tally;
mod wrong_peers;

use std::{
    io::Write,
    path::{Path, PathBuf},
    process::ExitCode,
};

use tokio::signal::unix::{SignalKind, signal};

use self::{
    hosts::{Host, HostSpec},
    kmes::{Kmes, Role},
    mode::Mode,
    progress::Progress,
    report::{LogSummary, Report},
    route::{Pair, Replay},
    wrong_peers::Visit,
};
use crate::{
    cli,
    failure::CliError,
    log::{LogError, Survey},
    logging,
};

pub(crate) use self::{player::run as run_player, subscriber::run as run_subscriber};

/// The log that is replayed by default. It is part of the binary, so that the demo needs no file.
const RECORDED: &[u8] = include_bytes!("../../data/mit-csail.mcap");
const RECORDED_NAME: &str = "mit-csail.mcap";

/// An error that ends the demo. A lost message, or a wrong peer that is let in, is not such an
/// error; the report states it.
#[derive(Debug, thiserror::Error)]
pub(crate) enum DemoError {
    #[error("cannot make the demo's directory: {0}")]
    Directory(std::io::Error),
    #[error(transparent)]
    Log(#[from] LogError),
    #[error("the KME simulator: {0}")]
    Kme(String),
    #[error("--kme-env: {0}")]
    KmeEnv(String),
    #[error("cannot start {name}: {source}")]
    Start { name: String, source: std::io::Error },
    #[error("{name}: {reason}")]
    Child { name: String, reason: String },
    #[error("no status from {host}: {reason}")]
    Status { host: &'static str, reason: String },
    #[error("{attempt} could not be tried: {reason}")]
    Attempt { attempt: &'static str, reason: String },
    #[error("cannot follow signals: {0}")]
    Signals(std::io::Error),
    #[error("interrupted; everything is stopped and removed")]
    Interrupted,
}

/// Runs the demo. The exit status is 0 only if every result is as required.
pub(crate) fn run(args: &cli::Demo) -> Result<ExitCode, CliError> {
    logging::check()?;
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()
        .map_err(CliError::failed)?;
    let report = runtime.block_on(async {
        tokio::select! {
            report = show(args) => report,
            stopped = interrupted() => Err(stopped),
        }
    });
    let report = report.map_err(|error| match error {
        setting @ DemoError::KmeEnv(_) => CliError::Setting(setting.to_string()),
        other => CliError::failed(other),
    })?;
    let text = if args.json {
        let json = serde_json::to_string_pretty(&report).map_err(CliError::failed)?;
        crate::text::printable_json(&json) + "\n"
    } else {
        report.render()
    };
    std::io::stdout().lock().write_all(text.as_bytes()).map_err(CliError::failed)?;
    Ok(if report.passed { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

async fn show(args: &cli::Demo) -> Result<Report, DemoError> {
    let directory =
        tempfile::Builder::new().prefix("axon-demo-").tempdir().map_err(DemoError::Directory)?;
    let dir = directory.path();
    let logs = log_directory(args, dir)?;
    let file = match &args.file {
        Some(file) => file.clone(),
        None => unpack(dir)?,
    };
    let survey = Survey::of(&file)?;
    let progress = Progress::new(survey.messages * Mode::ALL.len() as u64);
    let kmes = match args.kme_env.as_slice() {
        [] => Kmes::start(dir).await?,
        [host_a, host_b] => Kmes::external(host_a, host_b)?,
        files => {
            let times = files.len();
            let why = format!("given {times} times, accepted: twice, for host A and for host B");
            return Err(DemoError::KmeEnv(why));
        }
    };

    let replay = Replay { file: &file, rate: args.rate, messages: survey.messages };
    let mut routes = Vec::new();
    let mut refused = Vec::new();
    for mode in Mode::ALL {
        progress.step(mode.route(), "starting two hosts");
        let keys_before = kmes.handed_out();
        let pair = start(mode, &kmes, dir, &logs).await?;
        let outcomes = route::run(mode, &pair, &kmes, keys_before, replay, &progress).await?;
        if mode == Mode::Classic {
            routes.push(outcomes.local);
        }
        routes.push(outcomes.remote);
        progress.step(mode.route(), "wrong peers");
        let Pair { a, b } = pair;
        // No other peer can use the name of host A while host A runs.
        let host_a = if kmes.has_visitor() {
            Some(a)
        } else {
            a.stop().await;
            None
        };
        let visit = Visit { mode, host: &b, kmes: &kmes, dir, topic: &survey.topics[0] };
        refused.extend(visit.all().await?);
        if let Some(a) = host_a {
            a.stop().await;
        }
        b.stop().await;
    }
    refused.push(wrong_peers::obsolete_variable().await?);
    progress.clear();

    let name = file.file_name().unwrap_or(file.as_os_str());
    let log = LogSummary {
        file: name.to_string_lossy().into_owned(),
        topics: survey.topics.into_iter().map(|t| (t.name, t.type_name)).collect(),
        messages: survey.messages,
        bytes: survey.bytes,
        seconds: survey.duration as f64 / 1e9,
        rate: args.rate,
    };
    Ok(Report::new(log, routes, refused))
}

async fn start(mode: Mode, kmes: &Kmes, dir: &Path, logs: &Path) -> Result<Pair, DemoError> {
    let spec_a = HostSpec {
        name: "host A",
        stem: "host-a",
        address: "127.0.0.1",
        peer: "127.0.0.2",
        mode,
        identity: kmes.identity(Role::A),
        peers: kmes.sae(Role::B).to_owned(),
    };
    let spec_b = HostSpec {
        name: "host B",
        stem: "host-b",
        address: "127.0.0.2",
        peer: "127.0.0.1",
        mode,
        identity: kmes.identity(Role::B),
        peers: kmes.peers_of_b(),
    };
    let (a, b) =
        tokio::try_join!(Host::start(&spec_a, dir, logs), Host::start(&spec_b, dir, logs))?;
    Ok(Pair { a, b })
}

fn log_directory(args: &cli::Demo, dir: &Path) -> Result<PathBuf, DemoError> {
    let logs = args.logs.clone().unwrap_or_else(|| dir.join("logs"));
    std::fs::create_dir_all(&logs).map_err(DemoError::Directory)?;
    Ok(logs)
}

fn unpack(dir: &Path) -> Result<PathBuf, DemoError> {
    let file = dir.join(RECORDED_NAME);
    std::fs::write(&file, RECORDED).map_err(DemoError::Directory)?;
    Ok(file)
}

/// Returns when a signal tells the demo to stop.
async fn interrupted() -> DemoError {
    let follow = |kind| signal(kind).map_err(DemoError::Signals);
    let signals = (
        follow(SignalKind::interrupt()),
        follow(SignalKind::terminate()),
        follow(SignalKind::hangup()),
    );
    match signals {
        (Ok(mut interrupt), Ok(mut terminate), Ok(mut hangup)) => {
            tokio::select! {
                _ = interrupt.recv() => {}
                _ = terminate.recv() => {}
                _ = hangup.recv() => {}
            }
            DemoError::Interrupted
        }
        (Err(error), ..) | (_, Err(error), _) | (.., Err(error)) => error,
    }
}
