//! What is sent, and by what.

use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::{Channel, Result};

/// How a receiver learns that there is something.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Wake {
    /// It looks all the time.
    Poll,
    /// It sleeps until it is woken, from another CPU.
    Event,
    /// As [`Event`](Self::Event), with both processes on one CPU, so that a wake-up is a switch
    /// from one to the other and takes nothing from the machine between CPUs.
    EventOneCpu,
}

impl Wake {
    /// Whether the receiver sleeps.
    pub(crate) fn sleeps(self) -> bool {
        self != Self::Poll
    }
}

/// What becomes of a message's bytes. In all of them both ends touch its first and last eight.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Motion {
    /// Nothing: the message is made and read in place.
    Touch,
    /// The sender copies them in, the receiver reads in place.
    Fill,
    /// The sender copies them in and the receiver copies them out.
    Copy,
}

/// One kind of traffic.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Load {
    /// Bytes of a message, at least eight.
    pub(crate) size: usize,
    pub(crate) wake: Wake,
    pub(crate) motion: Motion,
    /// How many messages may be under way.
    pub(crate) window: usize,
    /// From message to message; none where the next one does not wait.
    pub(crate) pace: Option<Duration>,
}

impl Load {
    /// One message at a time.
    pub(crate) fn ping_pong(size: usize, wake: Wake, motion: Motion) -> Self {
        Self { size, wake, motion, window: 1, pace: None }
    }

    /// A message every `pace`, to a receiver that sleeps in between. Four may be under way, should the
    /// machine leave the receiver out for a while.
    pub(crate) fn paced(size: usize, motion: Motion, pace: Duration) -> Self {
        Self { pace: Some(pace), window: 4, ..Self::ping_pong(size, Wake::Event, motion) }
    }

    /// As many as 16 MiB hold, from 4 to 64.
    pub(crate) fn stream(size: usize, wake: Wake, motion: Motion) -> Self {
        Self { size, wake, motion, window: ((16 << 20) / size).clamp(4, 64), pace: None }
    }

    /// Whether messages follow each other without an answer in between.
    pub(crate) fn is_stream(&self) -> bool {
        self.window > 1 && self.pace.is_none()
    }
}

/// Which of the two processes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Side {
    /// The one that measures.
    Near,
    /// The one that answers.
    Far,
}

/// A way to get bytes from one process to another and back.
pub(crate) trait Medium {
    /// Its name in tables, charts and files.
    fn name(&self) -> &'static str;

    /// Whether it has a part under `load`: one without is passed over.
    fn carries(&self, _load: &Load) -> bool {
        true
    }

    /// Process ids of the daemons that carry its messages: their processor time counts.
    ///
    /// # Errors
    /// A daemon does not say its own.
    fn daemons(&self) -> Result<Vec<u32>> {
        Ok(Vec::new())
    }

    /// This side's end for `load`. The other side opens its own at the same time, and both may
    /// talk over `channel` until both are done.
    fn open(&self, load: &Load, side: Side, channel: &Channel) -> Result<Box<dyn End>>;
}

/// One process's end of a medium.
pub(crate) trait End {
    /// Sends the next message. Stamps count from 1 in each direction.
    fn send(&mut self, stamp: u64) -> Result<()>;

    /// Awaits the next message and returns its stamp.
    fn receive(&mut self) -> Result<u64>;

    /// Runs what has to run in this thread for what was sent to arrive, until `channel` can be read.
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

/// The number in a message's first and last eight bytes, which must be the same.
#[inline]
pub(crate) fn agree(first: [u8; 8], last: [u8; 8]) -> Result<u64> {
    if first != last {
        return Err("a message's end does not belong to its beginning".into());
    }
    Ok(u64::from_ne_bytes(first))
}
