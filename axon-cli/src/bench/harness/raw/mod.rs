//! The raw limits: the fastest communication between two processes without any middleware.

mod memory;
mod sleep;

use std::{
    os::fd::{AsFd, OwnedFd},
    sync::atomic::Ordering,
};

pub(crate) use memory::SharedPages;
pub(crate) use sleep::Sleeps;
use sleep::{Asleep, Bell, sleep, wake};

use super::{Channel, End, Load, Medium, Motion, Result, Side, Wake, agree, stamp};

/// A message of up to this many bytes fits beside the word that announces it, so its limit is the word alone.
const INLINE: usize = 88;
/// The distance in bytes between two objects that must share neither a cache line nor a pair of lines that are fetched
/// together.
const APART: usize = 256;
const PAYLOADS: usize = 4096;

/// The distance from a direction's word to the word that tells whether its receiver sleeps. It puts them on different
/// cache lines.
const ASLEEP: usize = 128;

/// A shared atomic that the receiver polls, or for which it sleeps in one of three ways. The bytes are copied as often
/// as the load requires. Messages of up to 88 bytes are not copied.
///
/// Under a load with a polling receiver, one limit serves, [`Sleeps::Epoll`]. Where messages follow each other at once,
/// AXON polls before it sleeps; the limit that does the same is [`Sleeps::SpinEpoll`]. The other two are for messages
/// with a pace. [`Sleeps::Epoll`] is also for two processes on one CPU, where polling is of no use.
pub(crate) struct Raw(pub(crate) Sleeps);

impl Medium for Raw {
    fn name(&self) -> &'static str {
        self.0.name()
    }

    fn carries(&self, load: &Load) -> bool {
        match self.0 {
            Sleeps::Epoll => load.wake != Wake::Event || load.pace.is_some(),
            Sleeps::SpinEpoll => load.wake == Wake::Event && load.pace.is_none(),
            Sleeps::Futex => load.pace.is_some(),
        }
    }

    fn open(&self, load: &Load, side: Side, channel: &Channel) -> Result<Box<dyn End>> {
        let slot = load.size.next_multiple_of(64);
        let slots = load.window.max(((4 << 20) / slot).clamp(2, 4));
        let len = PAYLOADS + 2 * slots * slot;
        let (memory, bells) = match side {
            Side::Near => {
                let (memory, fd) = SharedPages::create(len)?;
                let bells = [Bell::cast()?, Bell::cast()?];
                let fds = [fd.as_fd(), bells[1].as_fd(), bells[0].as_fd()];
                channel.hand_over(&(), &fds)?;
                (memory, bells)
            }
            Side::Far => {
                let ((), fds) = channel.take_over()?;
                let [fd, first, second] =
                    fds.try_into().map_err(|_| "another number of descriptors")?;
                (SharedPages::map(&fd, len)?, [first, second])
            }
        };
        let [out, into] = match side {
            Side::Near => [0, 1],
            Side::Far => [1, 0],
        };
        let direction = |index: usize| Direction {
            word: index * APART,
            payload: PAYLOADS + index * slots * slot,
            count: 0,
        };
        let moves = if load.size <= INLINE { Motion::Touch } else { load.motion };
        let [ours, theirs] = bells;
        Ok(Box::new(RawEnd {
            memory,
            load: Load { motion: moves, ..*load },
            slot,
            slots: slots as u64,
            out: direction(out),
            into: direction(into),
            how: load.wake.sleeps().then_some(self.0),
            bell: theirs,
            ours: Bell::listen(ours)?,
            bytes: vec![0x5a; load.size],
        }))
    }
}

struct RawEnd {
    memory: SharedPages,
    load: Load,
    slot: usize,
    /// The number of slots. With one slot, a sender has to take each line back from the receiver's cache, which is up
    /// to 40 % slower. With many slots, large messages are in no cache.
    slots: u64,
    out: Direction,
    into: Direction,
    how: Option<Sleeps>,
    /// The eventfd that wakes the other side.
    bell: OwnedFd,
    ours: Bell,
    bytes: Vec<u8>,
}

struct Direction {
    /// The offset of the word that holds the number of the last message.
    word: usize,
    /// The offset of the messages, one in each slot.
    payload: usize,
    /// The number of messages so far.
    count: u64,
}

impl RawEnd {
    fn at(&self, direction: &Direction) -> usize {
        direction.payload + (direction.count % self.slots) as usize * self.slot
    }
}

impl End for RawEnd {
    fn send(&mut self, number: u64) -> Result<()> {
        if self.load.motion != Motion::Touch {
            stamp(&mut self.bytes, number);
            self.memory.copy_in(self.at(&self.out), &self.bytes);
        }
        self.out.count += 1;
        // Pairs with the load in `receive`.
        self.memory.word(self.out.word).store(self.out.count, Ordering::Release);
        if let Some(how) = self.how {
            wake(how, &Asleep(self.memory.half(self.out.word + ASLEEP)), &self.bell)?;
        }
        Ok(())
    }

    fn receive(&mut self) -> Result<u64> {
        let next = self.into.count + 1;
        let word = self.memory.word(self.into.word);
        if let Some(how) = self.how {
            let asleep = Asleep(self.memory.half(self.into.word + ASLEEP));
            let ready = || word.load(Ordering::Acquire) >= next;
            sleep(how, &asleep, &mut self.ours, ready)?;
        }
        // Pairs with the store in `send`.
        while word.load(Ordering::Acquire) < next {}
        let at = self.at(&self.into);
        let number = match self.load.motion {
            Motion::Touch => next,
            Motion::Fill => {
                let [mut first, mut last] = [[0; 8]; 2];
                self.memory.copy_out(at, &mut first);
                self.memory.copy_out(at + self.load.size - 8, &mut last);
                agree(first, last)?
            }
            Motion::Copy => {
                self.memory.copy_out(at, &mut self.bytes);
                let [first, last] = [self.bytes.first_chunk(), self.bytes.last_chunk()];
                agree(*first.ok_or("too short")?, *last.ok_or("too short")?)?
            }
        };
        self.into.count = next;
        Ok(number)
    }
}
