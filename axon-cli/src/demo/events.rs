//! What the demo's players and subscribers say on standard output: one JSON object a line.

use std::io::{self, Write};

use serde::{Deserialize, Serialize};

use super::tally::RunTally;

/// One line.
#[derive(Debug, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub(crate) enum Event {
    /// A subscriber's subscriptions exist; a player's publishers have the readers they wait for.
    Ready,
    /// So many messages were published, or received.
    Progress {
        /// Count from the start.
        messages: u64,
    },
    /// A player has published the whole log.
    Sent {
        /// Messages published.
        messages: u64,
        /// How often a full reader made it wait.
        waits: u64,
    },
    /// A subscriber is done.
    Outcome(RunTally),
    /// It cannot go on.
    Failed {
        /// Why.
        reason: String,
    },
}

impl Event {
    /// Writes the line to standard output at once.
    pub(crate) fn say(&self) -> io::Result<()> {
        let mut line = serde_json::to_vec(self)?;
        line.push(b'\n');
        let mut out = io::stdout().lock();
        out.write_all(&line)?;
        out.flush()
    }
}
