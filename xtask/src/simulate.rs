//! Drives simulated hosts through faults: the engine's simulator, with as many seeds and hosts as asked for.

use std::path::Path;
use std::process::Command;

type Result<T> = std::result::Result<T, String>;

/// What is simulated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Options {
    /// Mixed faults.
    Seeds(Seeds),
    /// The scenarios, each with all of its cases.
    Scenarios,
    /// The scenarios of a hostile peer with two links: all lies in all modes, and these seeds of acts by chance.
    TwoLinks { first: u64, seeds: u64 },
}

/// Runs of mixed faults.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Seeds {
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
        if options == ["--scenarios"] {
            return Some(Self::Scenarios);
        }
        if let ["--two-links", options @ ..] = options {
            return match Self::parse(options)? {
                Self::Seeds(Seeds { first, seeds, hosts: 3 }) => {
                    let seeds = if options.contains(&"--seeds") { seeds } else { 200 };
                    Some(Self::TwoLinks { first, seeds })
                }
                _ => None,
            };
        }
        let mut parsed = Seeds { first: 1, seeds: 5000, hosts: 3 };
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
        Some(Self::Seeds(parsed))
    }
}

/// Runs the seeds, or the scenarios, in release: faster, and without the debug assertions of other crates.
///
/// # Errors
/// A seed fails, and what the simulator printed has a short script that fails too; or a scenario does.
pub(crate) fn simulate(options: Options) -> Result<String> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("xtask is in the repository");
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let mut command = Command::new(cargo);
    command.current_dir(root).args(["test", "--release", "-p", "axon-daemon", "--lib", "--"]);
    match options {
        Options::Seeds(Seeds { first, seeds, hosts }) => command
            .args(["--exact", "engine::sim::tests::mixed_faults_break_no_promise", "--nocapture"])
            .env("SIMULATE_FIRST", first.to_string())
            .env("SIMULATE_SEEDS", seeds.to_string())
            .env("SIMULATE_HOSTS", hosts.to_string()),
        Options::Scenarios => command.args(["engine::sim", "--nocapture"]).env("SIMULATE_ALL", "1"),
        Options::TwoLinks { first, seeds } => command
            .args(["engine::sim::scenarios::two_links", "--nocapture"])
            .env("SIMULATE_ALL", "1")
            .env("SIMULATE_FIRST", first.to_string())
            .env("SIMULATE_SEEDS", seeds.to_string()),
    };
    let status = command.status().map_err(|error| format!("cargo cannot be started: {error}"))?;
    let what = match options {
        Options::Seeds(Seeds { first, seeds, hosts }) => {
            format!("seeds {first} to {}, {hosts} hosts each", first + seeds - 1)
        }
        Options::Scenarios => "all cases of the scenarios".to_owned(),
        Options::TwoLinks { first, seeds } => {
            format!("a hostile peer with two links, seeds {first} to {}", first + seeds - 1)
        }
    };
    if status.success() {
        Ok(format!("{what}: no promise was broken"))
    } else {
        Err(format!("{what}: one fails"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wrong_options_are_refused() {
        let some = |first, seeds, hosts| Some(Options::Seeds(Seeds { first, seeds, hosts }));
        assert_eq!(Options::parse(&[]), some(1, 5000, 3));
        assert_eq!(Options::parse(&["--scenarios"]), Some(Options::Scenarios));
        assert_eq!(
            Options::parse(&["--first", "7", "--seeds", "10", "--hosts", "50"]),
            some(7, 10, 50)
        );
        let two_links = |first, seeds| Some(Options::TwoLinks { first, seeds });
        assert_eq!(Options::parse(&["--two-links"]), two_links(1, 200));
        let some_seeds = ["--two-links", "--first", "7", "--seeds", "9"];
        assert_eq!(Options::parse(&some_seeds), two_links(7, 9));
        for wrong in [
            &["--hosts", "1"][..],
            &["--seeds"],
            &["--seeds", "0"],
            &["--many", "1"],
            &["--scenarios", "1"],
            &["--two-links", "--scenarios"],
            &["--two-links", "--hosts", "4"],
        ] {
            assert_eq!(Options::parse(wrong), None, "{wrong:?}");
        }
    }
}
