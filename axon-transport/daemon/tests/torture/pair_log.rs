//! The history of a process's pairs, kept in memory, and printed when one of them lost something.
#![expect(clippy::print_stderr, reason = "it is for people who look for a cause")]

use std::{
    collections::VecDeque,
    io,
    sync::{Arc, Mutex, MutexGuard},
};

use tracing_subscriber::{EnvFilter, fmt::MakeWriter};

/// Number of lines that are kept.
const LINES: usize = 50_000;
/// The part of the library's log that the log of pairs keeps: pairs, and the daemons that come and go.
const FILTER: &str = "axon_transport::pairs=debug,axon_transport::session=debug";

#[derive(Clone, Default)]
pub(crate) struct PairLog(Arc<Mutex<VecDeque<String>>>);

impl PairLog {
    /// Keeps the library's log from now on.
    pub(crate) fn keep() -> Self {
        let pair_log = Self::default();
        let subscriber = tracing_subscriber::fmt()
            .with_env_filter(EnvFilter::new(FILTER))
            .with_ansi(false)
            .with_writer(pair_log.clone());
        subscriber.init();
        pair_log
    }

    pub(crate) fn add(&self, line: &str) {
        tracing::debug!(target: "axon_transport::pairs", "{line}");
    }

    /// Prints the lines about a reader or writer, and the lines about no pair.
    pub(crate) fn print(&self, gid: &str) {
        let of_pairs = |line: &str| line.contains("axon_transport::pairs");
        let lines = self.lines();
        let lines = lines.iter().filter(|line| line.contains(gid) || !of_pairs(line));
        let lines: String = lines.map(String::as_str).collect();
        eprintln!("--- process {}, {gid}:\n{lines}", std::process::id());
    }

    /// Returns how many samples the library counted as lost of publishers that ended before this process was told of
    /// their grant to `reader`: of all publishers, or of `writer` alone. Returns `None` if there were none.
    pub(crate) fn unmet(&self, reader: &str, writer: Option<&str>) -> Option<u64> {
        let reader = format!("reader={reader} ");
        let writer = writer.map(|writer| format!("writer={writer} ")).unwrap_or_default();
        let lines = self.lines();
        let lines = lines.iter().filter(|line| line.contains("axon_transport::pairs: unmet "));
        let lines = lines.filter(|line| line.contains(&reader) && line.contains(&writer));
        let samples = lines.filter_map(|line| line.trim_end().rsplit_once("samples="));
        let samples = samples.map(|(_, number)| number.parse::<u64>().expect("a number"));
        samples.reduce(|sum, number| sum + number)
    }

    fn lines(&self) -> MutexGuard<'_, VecDeque<String>> {
        self.0.lock().expect("no panic")
    }
}

impl io::Write for PairLog {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let mut lines = self.lines();
        if lines.len() == LINES {
            lines.pop_front();
        }
        // The library writes its log one event at a time.
        lines.push_back(String::from_utf8_lossy(bytes).into_owned());
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl<'a> MakeWriter<'a> for PairLog {
    type Writer = Self;

    fn make_writer(&'a self) -> Self {
        self.clone()
    }
}
