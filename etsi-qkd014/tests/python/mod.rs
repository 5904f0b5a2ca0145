//! Runs the Python programs beside this file. A machine without `python3` skips, and says so.

#![allow(dead_code, reason = "each test program uses its part")]

use std::collections::HashMap;
use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};

const DIR: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/python");

/// Returns Python 3.8 or later, or `None` with the reason on standard error.
fn python() -> Option<Command> {
    let probe = "import sys, ssl; sys.exit(sys.version_info < (3, 8))";
    let found = Command::new("python3").args(["-c", probe]).output();
    match found {
        Ok(output) if output.status.success() => {
            let mut command = Command::new("python3");
            // Python writes no bytecode beside the sources.
            command.arg("-B").current_dir(DIR);
            Some(command)
        }
        Ok(_) => skip("python3 is older than 3.8, or has no module ssl"),
        Err(error) => skip(&format!("python3 cannot be run: {error}")),
    }
}

/// Says so past the harness, which would show it only beside a failure.
fn skip<T>(why: &str) -> Option<T> {
    let _ = writeln!(std::io::stderr(), "skipped: {why}");
    None
}

/// Runs `sae.py` with its settings.
pub(crate) fn sae(settings: &Path) -> Option<Output> {
    Some(python()?.arg("sae.py").arg(settings).output().expect("python3 runs"))
}

/// `kme.py`, until it is dropped.
pub(crate) struct Server {
    child: Child,
    urls: HashMap<String, String>,
}

impl Server {
    /// Starts the KMEs. `kme.py` takes `sites` in the form `KME=ADDRESS=SAE,SAE`.
    pub(crate) fn start(dir: &Path, stored: u32, sites: &[&str]) -> Option<Self> {
        Self::wrong(&[], dir, stored, sites)
    }

    /// Starts the KMEs with options of `kme.py` that make it wrong.
    pub(crate) fn wrong(options: &[&str], dir: &Path, stored: u32, sites: &[&str]) -> Option<Self> {
        let mut command = python()?;
        command.arg("kme.py").args(options).arg(dir).arg(stored.to_string()).args(sites);
        let mut child =
            command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().expect("python3 runs");
        let mut lines = BufReader::new(child.stdout.take().expect("a pipe")).lines();
        let urls = sites.iter().map(|site| {
            let (kme, rest) = site.split_once('=').expect("KME=ADDRESS=SAE");
            let (address, _) = rest.split_once('=').expect("KME=ADDRESS=SAE");
            let line = lines.next().expect("a line a KME").expect("text");
            let port = line.strip_prefix(kme).expect("its name").trim();
            (kme.to_owned(), format!("https://{address}:{port}"))
        });
        let urls = urls.collect();
        Some(Self { child, urls })
    }

    pub(crate) fn url(&self, kme: &str) -> &str {
        &self.urls[kme]
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
