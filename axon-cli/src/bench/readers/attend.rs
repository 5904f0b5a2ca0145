//! A reader process.

use std::{
    sync::atomic::{AtomicU32, Ordering},
    time::Duration,
};

use axon_shm::{Context, Subscriber, SubscriberOptions};
use rustix::{
    io::Errno,
    process::{Signal, set_parent_process_death_signal},
    thread::futex,
};
use serde::{Deserialize, Serialize};

use super::{
    super::harness::{Channel, Result, agree, cpu, now_ns, qos},
    place::ReadersMemory,
};

/// The longest sleep. A message ends it earlier.
const LONGEST_SLEEP: Option<Duration> = Some(Duration::from_secs(1));

/// A command of the process that measures.
#[derive(Serialize, Deserialize)]
pub(super) enum ReaderCommand {
    /// Map the memory that comes with the command. `index` is the reader's number.
    Share {
        size: usize,
        index: usize,
    },
    /// Subscribe over the socket that comes with the command.
    Connect,
    /// Read `messages` messages from a subscriber, given by its number, or from the raw limit. The messages of all
    /// media are numbered together, and the first one follows `after`. The answer is the processor time that it took,
    /// in seconds.
    Attend {
        source: Option<usize>,
        told: bool,
        messages: u64,
        after: u32,
    },
    Drop,
}

/// Runs as one of the readers, until the process that measures ends.
pub(in crate::bench) fn attend() -> Result<()> {
    set_parent_process_death_signal(Some(Signal::KILL))?;
    let channel = Channel::inherited()?;
    let context = Context::new()?;
    let mut subscribers = Vec::new();
    let mut shared = None;
    while let Ok((order, fds)) = channel.take_over() {
        match order {
            ReaderCommand::Share { size, index } => {
                let [fd] = fds.try_into().map_err(|_| "another number of descriptors")?;
                shared = Some((ReadersMemory::map(&fd, size)?, index, vec![0; size]));
                channel.tell(&())?;
            }
            ReaderCommand::Connect => {
                let [socket] = fds.try_into().map_err(|_| "another number of descriptors")?;
                let options = SubscriberOptions::new(qos(1)?);
                subscribers.push(Subscriber::connect(&context, &socket, options, None)?);
                channel.tell(&())?;
            }
            ReaderCommand::Attend { source, told, messages, after } => {
                let (place, index, bytes) = shared.as_mut().ok_or("nothing is shared")?;
                let mut subscriber = source.map(|number| &mut subscribers[number]);
                channel.tell(&())?;
                let before = cpu::own();
                for past in after..after + u32::try_from(messages)? {
                    if told {
                        sleep_past(place.told(), past)?;
                    }
                    match &mut subscriber {
                        None => {
                            sleep_past(place.message(), past)?;
                            place.copy_out(bytes);
                        }
                        Some(subscriber) => take(&context, subscriber, bytes)?,
                    }
                    let [first, last] = [bytes.first_chunk(), bytes.last_chunk()];
                    let number = agree(*first.ok_or("too short")?, *last.ok_or("too short")?)?;
                    if number != u64::from(past + 1) {
                        return Err(format!("message {number} came after message {past}").into());
                    }
                    place.read_at(*index).store(now_ns(), Ordering::Relaxed);
                    // Pairs with the publisher's Acquire load in `Turns::take`.
                    place.read_by(*index).store(past + 1, Ordering::Release);
                }
                channel.tell(&(cpu::own() - before))?;
            }
            ReaderCommand::Drop => {
                subscribers.clear();
                shared = None;
                channel.tell(&())?;
            }
        }
    }
    Ok(())
}

/// Sleeps while the futex holds a number up to `past`.
fn sleep_past(word: &AtomicU32, past: u32) -> Result<()> {
    loop {
        let now = word.load(Ordering::Acquire);
        if now > past {
            return Ok(());
        }
        match futex::wait(word, futex::Flags::empty(), now, None) {
            Ok(()) | Err(Errno::AGAIN | Errno::INTR) => {}
            Err(errno) => return Err(errno.into()),
        }
    }
}

fn take(context: &Context, subscriber: &mut Subscriber, bytes: &mut Vec<u8>) -> Result<()> {
    while subscriber.take_into(bytes)?.is_none() {
        context.wait(|| subscriber.has_data(), LONGEST_SLEEP);
    }
    Ok(())
}
