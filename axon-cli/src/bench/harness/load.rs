//! The traffic that a measurement sends, and the media that carry it.

use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::{Channel, Result};

/// How a receiver learns of a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Wake {
    /// The receiver polls.
    Poll,
    /// The receiver sleeps until a process on another CPU wakes it.
    Event,
    /// As [`Event`](Self::Event), with both processes on one CPU. A wake-up is then a switch between the two processes,
    /// and no signal between CPUs adds to it.
    EventOneCpu,
}

impl Wake {
    /// Returns whether the receiver sleeps.
    pub(crate) fn sleeps(self) -> bool {
        self != Self::Poll
    }
}

/// How a message's bytes move. Both ends access the first and the last eight bytes in any case.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Motion {
    /// The message is made and read in place; no bytes are copied.
    Touch,
    /// The sender copies the bytes in, and the receiver reads them in place.
    Fill,
    /// The sender copies the bytes in, and the receiver copies them out.
    Copy,
}

/// One kind of traffic.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Load {
    /// The length of a message in bytes, at least eight.
    pub(crate) size: usize,
    pub(crate) wake: Wake,
    pub(crate) motion: Motion,
    /// The most messages in transit.
    pub(crate) window: usize,
    /// The time from message to message. `None` if each message follows at once.
    pub(crate) pace: Option<Duration>,
}

impl Load {
    /// Returns a load with one message at a time.
    pub(crate) fn ping_pong(size: usize, wake: Wake, motion: Motion) -> Self {
        Self { size, wake, motion, window: 1, pace: None }
    }

    /// Returns a load with a message every `pace`, and a receiver that sleeps in between. Four messages may be in
    /// transit, in case the system does not schedule the receiver for a while.
    pub(crate) fn paced(size: usize, motion: Motion, pace: Duration) -> Self {
        Self { pace: Some(pace), window: 4, ..Self::ping_pong(size, Wake::Event, motion) }
    }

    /// Returns a stream. As many messages as fit in 16 MiB may be in transit, from 4 to 64.
    pub(crate) fn stream(size: usize, wake: Wake, motion: Motion) -> Self {
        Self { size, wake, motion, window: ((16 << 20) / size).clamp(4, 64), pace: None }
    }

    /// Returns whether messages follow each other without an answer in between.
    pub(crate) fn is_stream(&self) -> bool {
        self.window > 1 && self.pace.is_none()
    }
}

/// One of the two processes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Side {
    /// The process that measures.
    Near,
    /// The process that answers.
    Far,
}

/// A method of transferring bytes from one process to another and back.
pub(crate) trait Medium {
    /// Returns the name in tables, charts and files.
    fn name(&self) -> &'static str;

    /// Returns whether the medium takes part under `load`. A medium that does not is skipped.
    fn carries(&self, _load: &Load) -> bool {
        true
    }

    /// Returns the process ids of the daemons that carry its messages. Their processor time counts.
    ///
    /// # Errors
    /// A daemon does not report its process id.
    fn daemons(&self) -> Result<Vec<u32>> {
        Ok(Vec::new())
    }

    /// Opens this side's end for `load`. The other side opens its own at the same time, and both may use `channel`
    /// until both are done.
    fn open(&self, load: &Load, side: Side, channel: &Channel) -> Result<Box<dyn End>>;
}

/// One process's end of a medium.
pub(crate) trait End {
    /// Sends the next message. Stamps count from 1 in each direction.
    fn send(&mut self, stamp: u64) -> Result<()>;

    /// Waits for the next message and returns its stamp.
    fn receive(&mut self) -> Result<u64>;

    /// Runs the work of this thread without which sent messages would not arrive, until `channel` is readable.
    fn idle(&mut self, _channel: &Channel) -> Result<()> {
        Ok(())
    }
}

/// Writes `number` to the first and the last eight bytes.
#[inline]
pub(crate) fn stamp(bytes: &mut [u8], number: u64) {
    let end = bytes.len() - 8;
    bytes[..8].copy_from_slice(&number.to_ne_bytes());
    bytes[end..].copy_from_slice(&number.to_ne_bytes());
}

/// Returns the number in a message's first and last eight bytes, which must be the same.
#[inline]
pub(crate) fn agree(first: [u8; 8], last: [u8; 8]) -> Result<u64> {
    if first != last {
        return Err("a message's end does not belong to its beginning".into());
    }
    Ok(u64::from_ne_bytes(first))
}
