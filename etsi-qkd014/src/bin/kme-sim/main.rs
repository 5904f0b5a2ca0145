//! `kme-sim`: KMEs to test an ETSI GS QKD 014 client against.
#![forbid(unsafe_code)]

mod fault;
mod init;
mod probe;
mod run;

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::{Parser, Subcommand};

/// KMEs that share key material as a QKD link does, over real mutual TLS. For tests only.
///
/// Exit status: 0, 1 on failure, 2 on wrong arguments.
#[derive(Parser)]
#[command(name = "kme-sim", version)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    Init(init::Arguments),
    Run(run::Arguments),
    Fault(fault::Arguments),
    Probe(probe::Arguments),
}

/// The reason why the program ends without success.
enum CommandFailure {
    Usage(String),
    Other(String),
}

type CommandResult<T = ()> = Result<T, CommandFailure>;

fn main() -> ExitCode {
    let outcome = match Arguments::parse().command {
        Command::Init(arguments) => init::init(&arguments),
        Command::Run(arguments) => run::run(arguments),
        Command::Fault(arguments) => fault::fault(&arguments),
        Command::Probe(arguments) => probe::probe(arguments),
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(CommandFailure::Usage(why)) => {
            eprintln!("kme-sim: {why}; see kme-sim --help");
            ExitCode::from(2)
        }
        Err(CommandFailure::Other(why)) => {
            eprintln!("kme-sim: {why}");
            ExitCode::FAILURE
        }
    }
}

#[allow(clippy::print_stdout, reason = "this is what the program is asked to print")]
fn say(text: &str) {
    print!("{text}");
}

fn other(error: impl std::fmt::Display) -> CommandFailure {
    CommandFailure::Other(error.to_string())
}

/// Returns the file in which `init` leaves the layout for `run`.
fn layout_file(dir: &Path) -> PathBuf {
    dir.join("layout.json")
}
