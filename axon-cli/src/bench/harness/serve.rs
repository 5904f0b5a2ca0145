//! The process that answers.

use std::sync::atomic::Ordering;

use rustix::{
    process::{Signal, set_parent_process_death_signal},
    time::{ClockId, clock_gettime},
};
use serde::{Deserialize, Serialize};

use super::{Channel, End, Error, Load, Medium, Result, Side, cpu, machine, raw::SharedPages};

/// Messages of a paced turn at most: each has a word of the board.
pub(super) const MOST_PACED: u64 = 1024;
/// Bytes of the memory that both processes share beside their media: the credit word, and the time at
/// which each message of a paced turn was taken.
pub(super) const BOARD: usize = 8 * (1 + MOST_PACED as usize);

/// What the process that measures has the other one do. Each turn is answered by the processor time
/// that it took, in seconds.
#[derive(Serialize, Deserialize)]
pub(super) enum BenchCommand {
    Open(Load),
    /// Send each of so many messages back.
    Answer {
        medium: usize,
        count: u64,
    },
    /// Take so many messages and say by the credit word how many they are in all.
    Take {
        medium: usize,
        count: u64,
    },
    /// Take so many messages and note on the board when each came.
    Note {
        medium: usize,
        count: u64,
    },
    /// Go to this CPU until the next is opened.
    Move(usize),
    Close,
}

#[derive(Serialize, Deserialize)]
pub(super) struct Hello {
    pub(super) cpu: usize,
    pub(super) cpus: Vec<usize>,
}

/// Where on the board the time of a message is, counted from zero.
pub(super) fn noted(index: u64) -> usize {
    8 * (1 + index as usize)
}

/// Nanoseconds of the clock that all processes share.
pub(crate) fn now_ns() -> u64 {
    let now = clock_gettime(ClockId::Monotonic);
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64
}

/// Is the other process, until the one that measures ends.
pub(crate) fn serve(all: &[&dyn Medium]) -> Result<()> {
    // In the middle of a loop nobody else would end this process.
    set_parent_process_death_signal(Some(Signal::KILL))?;
    let channel = Channel::inherited()?;
    let (Hello { cpu, cpus }, fds) = channel.take_over()?;
    let [fd] = fds.try_into().map_err(|_| "another number of descriptors")?;
    let board = SharedPages::map(&fd, BOARD)?;
    // Each with the number of the last message.
    let mut ends: Vec<(Box<dyn End>, u64)> = Vec::new();
    let mut media = Vec::new();
    let mut window = 1;
    loop {
        for (end, _) in &mut ends {
            end.idle(&channel)?;
        }
        let Ok(order) = channel.hear() else { return Ok(()) };
        let before = cpu::own();
        match order {
            BenchCommand::Open(load) => {
                window = load.window as u64;
                machine::unpin(&cpus)?;
                media = carrying(all, &load);
                for medium in &media {
                    let end = medium.open(&load, Side::Far, &channel);
                    ends.push((end.map_err(|error| named(*medium, error))?, 0));
                    channel.tell(&())?;
                }
                machine::pin(cpu)?;
            }
            BenchCommand::Answer { medium, count } => {
                let (end, last) = &mut ends[medium];
                for _ in 0..count {
                    let number = next(&mut **end, last).map_err(|e| named(media[medium], e))?;
                    end.send(number).map_err(|error| named(media[medium], error))?;
                }
                channel.tell(&(cpu::own() - before))?;
            }
            BenchCommand::Take { medium, count } => {
                let (end, last) = &mut ends[medium];
                let word = board.word(0);
                let taken = word.load(Ordering::Relaxed);
                channel.tell(&())?;
                for index in 1..=count {
                    next(&mut **end, last).map_err(|error| named(media[medium], error))?;
                    if index == count || index.is_multiple_of(window / 4) {
                        // Pairs with the load of the one that waits for it.
                        word.store(taken + index, Ordering::Release);
                    }
                }
                channel.tell(&(cpu::own() - before))?;
            }
            BenchCommand::Note { medium, count } => {
                let (end, last) = &mut ends[medium];
                let word = board.word(0);
                let taken = word.load(Ordering::Relaxed);
                channel.tell(&())?;
                for index in 0..count {
                    next(&mut **end, last).map_err(|error| named(media[medium], error))?;
                    board.word(noted(index)).store(now_ns(), Ordering::Relaxed);
                    // Pairs with the load of the one that waits for it.
                    word.store(taken + index + 1, Ordering::Release);
                }
                channel.tell(&(cpu::own() - before))?;
            }
            BenchCommand::Move(cpu) => {
                machine::pin(cpu)?;
                channel.tell(&())?;
            }
            BenchCommand::Close => {
                ends.clear();
                channel.tell(&())?;
            }
        }
    }
}

/// Those that have a part under `load`, the same on both sides.
pub(super) fn carrying<'a>(media: &[&'a dyn Medium], load: &Load) -> Vec<&'a dyn Medium> {
    media.iter().copied().filter(|medium| medium.carries(load)).collect()
}

/// Receives the message after `last`.
fn next(end: &mut dyn End, last: &mut u64) -> Result<u64> {
    let number = end.receive()?;
    if number != *last + 1 {
        return Err(format!("message {number} came after message {last}").into());
    }
    *last = number;
    Ok(number)
}

pub(super) fn named(medium: &dyn Medium, error: Error) -> Error {
    format!("{}: {error}", medium.name()).into()
}
