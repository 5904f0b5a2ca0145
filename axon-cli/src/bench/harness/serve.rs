//! The process that answers.

use std::sync::atomic::Ordering;

use rustix::{
    process::{Signal, set_parent_process_death_signal},
    time::{ClockId, clock_gettime},
};
use serde::{Deserialize, Serialize};

use super::{Channel, End, Error, Load, Medium, Result, Side, cpu, machine, raw::SharedPages};

/// The most messages of a paced turn. Each has a word on the board.
pub(super) const MOST_PACED: u64 = 1024;
/// The length in bytes of the board, the memory that both processes share apart from their media. It holds the credit
/// word, and the time at which each message of a paced turn was taken.
pub(super) const BOARD: usize = 8 * (1 + MOST_PACED as usize);

/// A command of the process that measures. The answer to each turn is the processor time that it took, in seconds.
#[derive(Serialize, Deserialize)]
pub(super) enum BenchCommand {
    Open(Load),
    /// Send back each of `count` messages.
    Answer {
        medium: usize,
        count: u64,
    },
    /// Take `count` messages, and report the total number of messages taken in the credit word.
    Take {
        medium: usize,
        count: u64,
    },
    /// Take `count` messages, and write on the board when each arrived.
    Note {
        medium: usize,
        count: u64,
    },
    /// Run on this CPU until the next load is opened.
    Move(usize),
    Close,
}

#[derive(Serialize, Deserialize)]
pub(super) struct Hello {
    pub(super) cpu: usize,
    pub(super) cpus: Vec<usize>,
}

/// Returns the position on the board of the time of a message. Messages count from zero.
pub(super) fn noted(index: u64) -> usize {
    8 * (1 + index as usize)
}

/// Returns the nanoseconds of the monotonic clock, which all processes share.
pub(crate) fn now_ns() -> u64 {
    let now = clock_gettime(ClockId::Monotonic);
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64
}

/// Runs the process that answers, until the process that measures ends.
pub(crate) fn serve(all: &[&dyn Medium]) -> Result<()> {
    // In the middle of a loop this process would not notice that the other one has ended.
    set_parent_process_death_signal(Some(Signal::KILL))?;
    let channel = Channel::inherited()?;
    let (Hello { cpu, cpus }, fds) = channel.take_over()?;
    let [fd] = fds.try_into().map_err(|_| "another number of descriptors")?;
    let board = SharedPages::map(&fd, BOARD)?;
    // Each end, with the number of its last message.
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
                        // Pairs with the Acquire load in `await_credit`.
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
                    // Pairs with the Acquire load in `await_credit`.
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

/// Returns the media that take part under `load`. They are the same on both sides.
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
