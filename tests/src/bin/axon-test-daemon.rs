//! The daemon for tests: like `axon_daemon`, and it ends with its standard input when it is told
//! to by `--while-stdin`.

use std::process::ExitCode;

use axon_transport::{
    config::Config,
    daemon::{
        self, Start,
        spawn::{DETACHED, SPAWNED},
    },
};
use tracing_subscriber::EnvFilter;

fn main() -> ExitCode {
    let start = match std::env::args().nth(1).as_deref() {
        Some(SPAWNED) => Start::Spawned,
        Some(DETACHED) => Start::Detached,
        Some("--while-stdin") => {
            std::thread::spawn(axon_tests::end_with_stdin);
            Start::Foreground
        }
        _ => Start::Foreground,
    };
    daemon::main(start, log)
}

fn log(config: &Config) {
    let filter = EnvFilter::try_new(&config.log).unwrap_or_else(|_| EnvFilter::new("warn"));
    let subscriber = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr)
        .with_ansi(false);
    let _ = subscriber.try_init();
}
