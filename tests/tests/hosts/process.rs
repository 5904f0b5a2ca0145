//! Child processes that do not outlive the test.

use std::{
    io::{BufRead, BufReader, Write},
    process::{Child, ChildStdin, Command, Stdio},
    sync::{Arc, Mutex},
    thread,
    time::{Duration, Instant},
};

use axon_tests::{Tally, Word};

/// Long enough for a loaded machine; a test that works never waits for it.
pub(crate) const PATIENCE: Duration = Duration::from_secs(60);

/// Waits for something that must come.
#[track_caller]
pub(crate) fn until(what: &str, mut reached: impl FnMut() -> bool) {
    let deadline = Instant::now() + PATIENCE;
    while !reached() {
        assert!(Instant::now() < deadline, "in vain: {what}");
        thread::sleep(Duration::from_millis(20));
    }
}

/// A process that is killed on drop.
#[derive(Debug)]
pub(crate) struct Kept(pub(crate) Child);

impl Drop for Kept {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// A publisher or subscriber.
#[derive(Debug)]
pub(crate) struct Node {
    child: Kept,
    stdin: Option<ChildStdin>,
    said: Arc<Mutex<Said>>,
}

/// The output of the process so far.
#[derive(Clone, Debug, Default)]
struct Said {
    ready: bool,
    published: u64,
    sent: Option<u64>,
    tally: Tally,
}

impl Node {
    pub(crate) fn start(mut command: Command) -> Self {
        let command = command.stdin(Stdio::piped()).stdout(Stdio::piped());
        let mut child = command.spawn().unwrap();
        let said = Arc::new(Mutex::new(Said::default()));
        let (lines, hear) = (BufReader::new(child.stdout.take().unwrap()).lines(), said.clone());
        thread::spawn(move || {
            for line in lines.map_while(Result::ok) {
                let word = serde_json::from_str(&line).unwrap();
                let mut said = hear.lock().unwrap();
                match word {
                    Word::Ready => said.ready = true,
                    Word::Published(sequence) => said.published = sequence,
                    Word::Sent(count) => said.sent = Some(count),
                    Word::Taken(tally) => said.tally = tally,
                }
            }
        });
        Self { stdin: child.stdin.take(), child: Kept(child), said }
    }

    fn said(&mut self) -> Said {
        let ended = self.child.0.try_wait().unwrap();
        assert!(ended.is_none(), "a node ended: {ended:?}");
        self.said.lock().unwrap().clone()
    }

    pub(crate) fn pid(&self) -> u32 {
        self.child.0.id()
    }

    #[track_caller]
    pub(crate) fn wait_ready(&mut self) {
        until("a node is ready", || self.said().ready);
    }

    /// Returns the number of samples that a publisher has published, or fewer.
    pub(crate) fn published(&mut self) -> u64 {
        self.said().published
    }

    /// Returns the tally of a subscription, which may be a little old.
    pub(crate) fn tally(&mut self) -> Tally {
        self.said().tally
    }

    /// Waits for a publisher to have sent all; that many.
    #[track_caller]
    pub(crate) fn wait_sent(&mut self) -> u64 {
        until("everything is sent", || self.said().sent.is_some());
        self.said().sent.unwrap()
    }

    /// Ends a stream, and returns the number of its samples.
    #[track_caller]
    pub(crate) fn stop(&mut self) -> u64 {
        self.stdin.as_ref().unwrap().write_all(b"\n").unwrap();
        self.wait_sent()
    }

    /// Waits for a subscription to have the sample `last`.
    #[track_caller]
    pub(crate) fn wait_taken(&mut self, last: u64) {
        let mut tally = Tally::default();
        let deadline = Instant::now() + PATIENCE;
        while tally.last < last {
            assert!(Instant::now() < deadline, "waiting for sample {last}: {tally:?}");
            thread::sleep(Duration::from_millis(20));
            tally = self.tally();
        }
    }

    /// Lets it end, which it must do well.
    #[track_caller]
    pub(crate) fn finish(mut self) {
        drop(self.stdin.take());
        until("a node ends", || self.child.0.try_wait().unwrap().is_some());
        let status = self.child.0.wait().unwrap();
        assert!(status.success(), "a node failed: {status}");
    }
}
