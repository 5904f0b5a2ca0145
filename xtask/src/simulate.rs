//! Drives simulated hosts through faults: the engine's simulator, with as many seeds and hosts as asked for.

use std::path::Path;
use std::process::Command;

type Result<T> = std::result::Result<T, String>;

/// What is simulated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Options {
    /// The first seed.
    pub(crate) first: u64,
    /// How many seeds.
    pub(crate) seeds: u64,
    /// Hosts in each run.
    pub(crate) hosts: u64,
}

impl Options {
    /// Reads the options of the command line. `None`: they are wrong.
    pub(crate) fn parse(options: &[&str]) -> Option<Self> {
        let mut parsed = Self { first: 1, seeds: 5000, hosts: 3 };
        let mut options = options.iter();
        while let Some(name) = options.next() {
            let value: u64 = options.next()?.parse().ok()?;
            match *name {
                "--first" => parsed.first = value,
                "--seeds" if value > 0 => parsed.seeds = value,
                "--hosts" if value > 1 => parsed.hosts = value,
                _ => return None,
            }
        }
        Some(parsed)
    }
}

/// Runs the seeds in release: faster, and without the debug assertions of other crates.
///
/// # Errors
/// A seed fails; what the simulator printed has a short script that fails too.
pub(crate) fn simulate(options: Options) -> Result<String> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("xtask is in the repository");
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let status = Command::new(cargo)
        .current_dir(root)
        .args(["test", "--release", "-p", "axon-daemon", "--lib", "--"])
        .args(["--exact", "engine::sim::tests::mixed_faults_break_no_promise", "--nocapture"])
        .env("SIMULATE_FIRST", options.first.to_string())
        .env("SIMULATE_SEEDS", options.seeds.to_string())
        .env("SIMULATE_HOSTS", options.hosts.to_string())
        .status()
        .map_err(|error| format!("cargo cannot be started: {error}"))?;
    let Options { first, seeds, hosts } = options;
    let last = first + seeds - 1;
    if status.success() {
        Ok(format!("seeds {first} to {last}, {hosts} hosts each: no promise was broken"))
    } else {
        Err(format!("a seed of {first} to {last} with {hosts} hosts fails"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wrong_options_are_refused() {
        assert_eq!(Options::parse(&[]), Some(Options { first: 1, seeds: 5000, hosts: 3 }));
        let some = Options { first: 7, seeds: 10, hosts: 50 };
        assert_eq!(Options::parse(&["--first", "7", "--seeds", "10", "--hosts", "50"]), Some(some));
        for wrong in [&["--hosts", "1"][..], &["--seeds"], &["--seeds", "0"], &["--many", "1"]] {
            assert_eq!(Options::parse(wrong), None, "{wrong:?}");
        }
    }
}
