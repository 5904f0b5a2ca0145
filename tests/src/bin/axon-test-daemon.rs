//! The daemon for tests: like `axon_daemon`. With `--while-stdin` it ends when its standard input ends.

use std::process::ExitCode;

use axon_daemon::{ErasingHeap, Start};

#[global_allocator]
static HEAP: ErasingHeap = ErasingHeap;

fn main() -> ExitCode {
    let mut arguments: Vec<_> = std::env::args_os().skip(1).collect();
    if arguments.first().is_some_and(|flag| flag == "--while-stdin") {
        std::thread::spawn(axon_tests::end_with_stdin);
        arguments.remove(0);
    }
    axon_daemon::main(Start::from_arguments(arguments).unwrap_or(Start::Foreground))
}
