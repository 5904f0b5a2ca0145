//! Child processes that never outlive the demo.
//!
//! Each child's standard input is a pipe that the demo holds. A child ends when the pipe closes.
//! The kernel closes it even when the demo itself is killed. Each child leads its own process
//! group. An interrupt at the terminal therefore reaches only the demo, and the children end in
//! order.

use std::{
    fs::File,
    io,
    path::{Path, PathBuf},
    process::Stdio,
    time::{Duration, Instant},
};

use tokio::{
    io::{AsyncBufReadExt, AsyncWriteExt, BufReader, Lines},
    process::{Child, ChildStdin, ChildStdout, Command},
};

use super::{DemoError, events::Event};

/// The time in which a child has to end by itself.
const EXIT_TIMEOUT: Duration = Duration::from_secs(5);

/// The longest part of a log that an error quotes.
const TAIL: usize = 600;

/// A running child.
#[derive(Debug)]
pub(crate) struct Process {
    name: String,
    child: Child,
    stdin: Option<ChildStdin>,
    events: Option<Lines<BufReader<ChildStdout>>>,
    log: PathBuf,
}

impl Process {
    /// Starts `command`. Its standard error is appended to `log`.
    pub(crate) fn start(name: &str, mut command: Command, log: &Path) -> Result<Self, DemoError> {
        let failed = |source| DemoError::Start { name: name.to_owned(), source };
        let stderr = File::options().create(true).append(true).open(log).map_err(failed)?;
        let mut child = command
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(stderr)
            .process_group(0)
            .kill_on_drop(true)
            .spawn()
            .map_err(failed)?;
        Ok(Self {
            name: name.to_owned(),
            stdin: child.stdin.take(),
            events: child.stdout.take().map(|out| BufReader::new(out).lines()),
            child,
            log: log.to_owned(),
        })
    }

    /// Returns the next event of the child. Returns an error if the child ended or failed. Cancel
    /// safe.
    pub(crate) async fn event(&mut self) -> Result<Event, DemoError> {
        let Some(events) = &mut self.events else { return Err(self.ended()) };
        let Some(line) = events.next_line().await.unwrap_or(None) else {
            return Err(self.ended());
        };
        match serde_json::from_str(&line) {
            Ok(Event::Failed { reason }) => {
                Err(DemoError::Child { name: self.name.clone(), reason })
            }
            Ok(event) => Ok(event),
            Err(_) => {
                let reason = format!("said {line:?}, which is no event");
                Err(DemoError::Child { name: self.name.clone(), reason })
            }
        }
    }

    /// Returns an error if the child has ended.
    pub(crate) fn check(&mut self) -> Result<(), DemoError> {
        if matches!(self.child.try_wait(), Ok(None)) { Ok(()) } else { Err(self.ended()) }
    }

    /// Returns an error for an event in the wrong order.
    pub(crate) fn unexpected(&self, event: &Event) -> DemoError {
        let reason = format!("said {event:?} out of turn");
        DemoError::Child { name: self.name.clone(), reason }
    }

    /// Returns an error for a child that did not become `what` within `limit`.
    pub(crate) fn late(&self, what: &str, limit: Duration) -> DemoError {
        let tail = tail(&self.log).unwrap_or_default();
        let reason =
            format!("was not {what} after {} s; its host's log ends: {tail}", limit.as_secs());
        DemoError::Child { name: self.name.clone(), reason }
    }

    /// Closes the child's standard input, so that the child ends.
    pub(crate) async fn release(&mut self) {
        if let Some(mut stdin) = self.stdin.take() {
            let _ = stdin.shutdown().await;
        }
    }

    /// Stops the child. A child that does not end in time is killed.
    pub(crate) async fn stop(mut self) {
        self.release().await;
        let _ = tokio::time::timeout(EXIT_TIMEOUT, self.child.wait()).await;
    }

    fn ended(&mut self) -> DemoError {
        let status = match self.child.try_wait() {
            Ok(Some(status)) => format!("ended ({status})"),
            _ => "closed its output".to_owned(),
        };
        let tail = tail(&self.log).unwrap_or_default();
        let reason = if tail.is_empty() { status } else { format!("{status}: {tail}") };
        DemoError::Child { name: self.name.clone(), reason }
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // The child is killed and reaped here, so that it no longer writes to the directory, which
        // is removed next.
        let _ = self.child.start_kill();
        let deadline = Instant::now() + Duration::from_secs(2);
        while matches!(self.child.try_wait(), Ok(None)) && Instant::now() < deadline {
            std::thread::sleep(Duration::from_millis(2));
        }
    }
}

/// Returns the end of a log as one line.
fn tail(log: &Path) -> io::Result<String> {
    let text = String::from_utf8_lossy(&std::fs::read(log)?).into_owned();
    let joined = text.lines().filter(|l| !l.trim().is_empty()).collect::<Vec<_>>().join(" | ");
    let skip = joined.chars().count().saturating_sub(TAIL);
    Ok(joined.chars().skip(skip).collect())
}
