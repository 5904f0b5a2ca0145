//! Chores of this repository that need a program: `cargo xtask` lists them.
#![forbid(unsafe_code)]
#![allow(clippy::print_stdout, reason = "a command line tool reports on its standard output")]

use std::env;
use std::process::ExitCode;

mod rustls_axon;

const USAGE: &str = "\
usage: cargo xtask COMMAND

  patched-tree         make third_party/rustls-axon/patched/, which `cargo package` ships
  rustls-digests       after a change to patches/ or added/: write patched.sha256 anew
  rustls-checkout DIR  make DIR a git repository with rustls's source and a commit a patch
  rustls-export DIR    the way back: write the commits in DIR to patches/, and the digests";

fn main() -> ExitCode {
    let args: Vec<String> = env::args().skip(1).collect();
    let args: Vec<&str> = args.iter().map(String::as_str).collect();
    let result = match args[..] {
        ["patched-tree"] => rustls_axon::patched_tree(),
        ["rustls-digests"] => rustls_axon::digests(),
        ["rustls-checkout", dir] => rustls_axon::checkout(dir.as_ref()),
        ["rustls-export", dir] => rustls_axon::export(dir.as_ref()),
        _ => {
            eprintln!("{USAGE}");
            return ExitCode::from(2);
        }
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
