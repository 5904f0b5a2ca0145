//! The output of a test process: one JSON line for each message.

use std::io::{self, Write};

use serde::{Deserialize, Serialize};

use crate::{Sizes, payload};

/// A line.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Word {
    /// The endpoint is there; a publisher has the readers that it waited for.
    Ready,
    /// The progress of a publisher.
    Published(u64),
    /// A publisher has sent all samples; their number.
    Sent(u64),
    /// The progress of a subscription.
    Taken(Tally),
}

impl Word {
    /// Prints the message on standard output.
    ///
    /// # Errors
    /// No process reads the output any more.
    pub fn say(&self) -> io::Result<()> {
        let mut line = serde_json::to_vec(self)?;
        line.push(b'\n');
        io::stdout().lock().write_all(&line)
    }
}

/// The samples that a subscription took from its one publisher.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Tally {
    /// Samples.
    pub taken: u64,
    /// Sequence number of the first.
    pub first: u64,
    /// The highest sequence number.
    pub last: u64,
    /// Samples that never came between the first and the last.
    pub missing: u64,
    /// Samples that came again, or after a later one.
    pub repeated: u64,
    /// Samples with other content than published.
    pub corrupt: u64,
    /// Samples that the subscription counted as lost.
    pub lost: u64,
}

impl Tally {
    /// Counts a sample.
    pub fn count(&mut self, sizes: Sizes, sequence: u64, bytes: &[u8], expected: &mut Vec<u8>) {
        if self.taken == 0 {
            self.first = sequence;
        } else if sequence <= self.last {
            self.repeated += 1;
        } else {
            self.missing += sequence - self.last - 1;
        }
        self.taken += 1;
        self.last = self.last.max(sequence);
        payload(sizes, sequence, expected);
        self.corrupt += u64::from(bytes != expected);
    }
}
