//! Chores of this repository that need a program: `cargo xtask` lists them.
#![forbid(unsafe_code)]
#![allow(clippy::print_stdout, reason = "a command line tool reports on its standard output")]

use std::env;
use std::path::Path;
use std::process::ExitCode;

use public_api::Mode;

mod floors;
mod install_c;
mod package;
mod picture;
mod public_api;
mod repeat;
mod ros_release;
mod rustls_axon;
mod simulate;

const USAGE: &str = "\
usage: cargo xtask COMMAND

  floors               check that imports between rooms run down only, by the tables of
                       docs/architecture.md
  install-c PREFIX [PROFILE]
                       build axon-transport's C libraries and daemon, in release unless told
                       otherwise, and install them with header and pkg-config file
  package [CRATE]... [--allow-dirty] [--no-verify] [--offline] [--target-dir DIR]
                       make the packages of the named crates, or of all that are published, from a copy
                       of the workspace in which rustls-axon has its patched source
  picture              draw docs/architecture.svg anew, from the manifests and the imports
  public-api [--strict | --write]
                       compare the public items of the published crates with their public-api.txt, or
                       write these files. Without --strict the comparison is skipped where this
                       compiler's rustdoc writes another format than xtask reads
  repeat TIMES [--busy N] [NAME ...]
                       run the test suite, or the test programs with such a name, TIMES times,
                       beside N busy threads, and list the tests that failed in any run
  ros-release [DIR] [--debian ROSDISTRO [--suite SUITE] [--rust-package 1.NN]] [--allow-dirty] [--offline]
                       make the source package of rmw_axon, with its crates, for bloom; with --debian
                       also what dpkg-buildpackage needs for a distribution of ROS
  simulate [--seeds N] [--hosts M] [--first SEED]
                       drive M simulated hosts through mixed faults, for each of N seeds, and shrink
                       the script of a seed that fails
  simulate --scenarios run all cases of the simulator's scenarios: daemons killed at each step, hostile
                       peers, rebinding NATs, many hosts. cargo test runs some of them
  simulate --two-links [--seeds N] [--first SEED]
                       play a hostile peer with two links: all single lies, and N seeds of acts by
                       chance in each mode
  rustls-digests       after a change to patches/ or added/: write patched.sha256 anew
  rustls-checkout DIR [VERSION]
                       make DIR a git repository with rustls's source and a commit a patch, and
                       with VERSION on a branch to rebase them on
  rustls-export DIR    the way back: write the commits in DIR to patches/, and the digests
  rebase VERSION [--from DIR] [--suite DIR] [--dry-run]
                       move rustls-axon to another release of rustls 0.23, or say what hinders it
                         --from DIR   with the commits in DIR (rustls-checkout) as the patches
                         --suite DIR  run rustls's own tests, from a checkout of its repository,
                                      without and with the patches
                         --dry-run    change nothing";

fn main() -> ExitCode {
    if let Some(status) = public_api::rustdoc() {
        return status;
    }
    let args: Vec<String> = env::args().skip(1).collect();
    let args: Vec<&str> = args.iter().map(String::as_str).collect();
    let result = match args[..] {
        ["floors"] => floors::check(rustls_axon::workspace()),
        ["install-c", prefix] => install_c::install(prefix.as_ref(), "release"),
        ["install-c", prefix, profile] => install_c::install(prefix.as_ref(), profile),
        ["package", ref options @ ..] => match package::Options::parse(options) {
            Some(options) => package::package(&options),
            None => return usage(),
        },
        ["picture"] => picture::draw(rustls_axon::workspace()),
        ["public-api"] => public_api::check(rustls_axon::workspace(), Mode::Check),
        ["public-api", "--strict"] => public_api::check(rustls_axon::workspace(), Mode::Strict),
        ["public-api", "--write"] => public_api::check(rustls_axon::workspace(), Mode::Write),
        ["repeat", times, ref options @ ..] => match repeat_options(times, options) {
            Some(options) => repeat::repeat(&options),
            None => return usage(),
        },
        ["ros-release", ref options @ ..] => match ros_release::Options::parse(options) {
            Some(options) => ros_release::release(&options),
            None => return usage(),
        },
        ["simulate", ref options @ ..] => match simulate::Options::parse(options) {
            Some(options) => simulate::simulate(options),
            None => return usage(),
        },
        ["rustls-digests"] => rustls_axon::digests(),
        ["rustls-checkout", dir] => rustls_axon::checkout(dir.as_ref(), None),
        ["rustls-checkout", dir, version] => rustls_axon::checkout(dir.as_ref(), Some(version)),
        ["rustls-export", dir] => rustls_axon::export(dir.as_ref()),
        ["rebase", version, ref options @ ..] => match rebase_options(version, options) {
            Some(options) => rustls_axon::rebase(&options),
            None => return usage(),
        },
        _ => return usage(),
    };
    match result {
        Ok(report) => {
            println!("{report}");
            ExitCode::SUCCESS
        }
        Err(why) => {
            eprintln!("error: {why}");
            ExitCode::FAILURE
        }
    }
}

fn usage() -> ExitCode {
    eprintln!("{USAGE}");
    ExitCode::from(2)
}

fn repeat_options<'a>(times: &str, args: &[&'a str]) -> Option<repeat::Repeat<'a>> {
    let times = times.parse().ok().filter(|&times| times > 0)?;
    let (busy, only) = match args {
        ["--busy", busy, only @ ..] => (busy.parse().ok()?, only),
        only => (0, only),
    };
    Some(repeat::Repeat { times, busy, only: only.to_vec() })
}

fn rebase_options<'a>(version: &'a str, mut args: &[&'a str]) -> Option<rustls_axon::Rebase<'a>> {
    let mut options = rustls_axon::Rebase::new(version);
    while !args.is_empty() {
        args = match args {
            ["--dry-run", rest @ ..] => {
                options.dry_run = true;
                rest
            }
            ["--from", dir, rest @ ..] => {
                options.from = Some(Path::new(*dir));
                rest
            }
            ["--suite", dir, rest @ ..] => {
                options.suite = Some(Path::new(*dir));
                rest
            }
            _ => return None,
        };
    }
    Some(options)
}
