//! Events that the demo's players and subscribers write to standard output, one JSON object on each
//! line.

use std::io::{self, Write};

use serde::{Deserialize, Serialize};

use super::tally::RunTally;

/// One event, which is one line.
#[derive(Debug, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub(crate) enum Event {
    /// A subscriber's subscriptions exist, or a player's publishers have the readers that they wait
    /// for.
    Ready,
    /// This number of messages was published or received.
    Progress {
        /// The number since the start.
        messages: u64,
    },
    /// A player has published the whole log.
    Sent {
        /// The number of messages published.
        messages: u64,
        /// How often the player waited for a full reader.
        waits: u64,
    },
    /// A subscriber has finished.
    Outcome(RunTally),
    /// The process cannot continue.
    Failed {
        /// The reason.
        reason: String,
    },
}

impl Event {
    /// Writes the event to standard output and flushes it.
    pub(crate) fn say(&self) -> io::Result<()> {
        let mut line = serde_json::to_vec(self)?;
        line.push(b'\n');
        let mut out = io::stdout().lock();
        out.write_all(&line)?;
        out.flush()
    }
}
