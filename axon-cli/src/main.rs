//! The command-line tool `axon`.

// Only the memory that `bench` shares between two processes is an exception.
#![deny(unsafe_code)]
// `say` writes to standard error instead, and does not panic if the write fails.
#![warn(clippy::print_stderr)]

mod acl;
mod bench;
mod cli;
mod daemon;
mod demo;
mod echo;
mod failure;
mod interrupt;
mod log;
mod logging;
mod play;
mod reload;
mod say;
mod served;
mod session;
mod status;
mod text;
mod trust;

use std::process::ExitCode;

use axon_daemon::ErasingHeap;
use clap::Parser;

use crate::cli::{Bench, Cli, Command};

/// Erases freed memory in `axon daemon` only.
#[global_allocator]
static HEAP: ErasingHeap = ErasingHeap;

fn main() -> ExitCode {
    let outcome = match &Cli::parse().command {
        Command::Demo(args) => demo::run(args),
        Command::Play(args) => play::run(args).map(done),
        Command::Echo(args) => echo::run(args).map(done),
        Command::Status(args) => status::run(args),
        Command::Trust(args) => trust::run(args).map(done),
        Command::Acl(args) => acl::run(args),
        Command::Reload => reload::run(),
        Command::Daemon(args) => daemon::run(args),
        Command::Bench(Bench::Shm(args)) => bench::shm(args).map(done),
        Command::Bench(Bench::Session(args)) => bench::session::run(args).map(done),
        Command::Bench(Bench::Net(args)) => bench::net::run(args).map(done),
        Command::BenchAnswer => bench::answer().map(done),
        Command::BenchRead => bench::read().map(done),
        Command::BenchSessionAnswer => bench::session::answer().map(done),
        Command::BenchNetAnswer => bench::net::answer().map(done),
        Command::BenchNetRead => bench::net::read().map(done),
        Command::DemoPlayer(args) => demo::run_player(args).map(done),
        Command::DemoSubscriber(args) => demo::run_subscriber(args).map(done),
    };
    outcome.unwrap_or_else(|failure| failure.report())
}

fn done((): ()) -> ExitCode {
    ExitCode::SUCCESS
}
