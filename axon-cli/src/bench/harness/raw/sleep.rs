//! How a receiver sleeps until a message arrives, and how the sender wakes it.

use std::{
    hint::spin_loop,
    os::fd::{AsFd as _, OwnedFd},
    sync::atomic::{AtomicU32, Ordering, fence},
    time::{Duration, Instant},
};

use rustix::{
    buffer::spare_capacity,
    event::{EventfdFlags, epoll, eventfd},
    io::{Errno, read, write},
    thread::futex,
};

use super::super::Result;

/// The time for which AXON polls for a message before it sleeps, if recent sleeps were short.
const SPIN: Duration = Duration::from_micros(50);
/// The number of polls between two readings of the clock.
const LOOKS: u32 = 8;

/// How a receiver of the raw limit waits for a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Sleeps {
    /// The receiver sleeps in epoll, on an eventfd. The sender writes the eventfd for each message.
    Epoll,
    /// The receiver polls for as long as AXON does, then sleeps in epoll. The sender writes the eventfd only if the
    /// receiver sleeps.
    SpinEpoll,
    /// The receiver sleeps on a futex. The sender wakes it only if it sleeps.
    Futex,
}

impl Sleeps {
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Epoll => "epoll + eventfd",
            Self::SpinEpoll => "50 us spin, then epoll + eventfd",
            Self::Futex => "futex",
        }
    }
}

/// The word of one direction that tells whether its receiver sleeps, in memory that both processes share.
pub(super) struct Asleep<'a>(pub(super) &'a AtomicU32);

impl Asleep<'_> {
    /// Called by the sender after it has stored the message. Returns whether the receiver has to be woken.
    fn ended(&self) -> bool {
        // Pairs with the receiver's fence in `begun`: at least one of the two sees what the other stored.
        fence(Ordering::SeqCst);
        self.0.load(Ordering::Relaxed) != 0 && self.0.swap(0, Ordering::Relaxed) != 0
    }

    /// Called by the receiver. Announces that it sleeps, and returns whether still no message has come.
    fn begun(&self, ready: impl Fn() -> bool) -> bool {
        self.0.store(1, Ordering::Relaxed);
        fence(Ordering::SeqCst);
        if ready() {
            self.0.store(0, Ordering::Relaxed);
            return false;
        }
        true
    }
}

/// Called by the sender. Wakes the receiver after a message was stored.
pub(super) fn wake(how: Sleeps, asleep: &Asleep<'_>, bell: &OwnedFd) -> Result<()> {
    match how {
        Sleeps::Epoll => drop(write(bell, &1u64.to_ne_bytes())?),
        Sleeps::SpinEpoll if asleep.ended() => drop(write(bell, &1u64.to_ne_bytes())?),
        Sleeps::Futex if asleep.ended() => drop(futex::wake(asleep.0, futex::Flags::empty(), 1)?),
        Sleeps::SpinEpoll | Sleeps::Futex => {}
    }
    Ok(())
}

/// Called by the receiver. Sleeps until `ready`, or with [`Sleeps::Epoll`] until the next write of the eventfd.
pub(super) fn sleep(
    how: Sleeps,
    asleep: &Asleep<'_>,
    bell: &mut Bell,
    ready: impl Fn() -> bool,
) -> Result<()> {
    match how {
        Sleeps::Epoll => bell.until_rung(),
        Sleeps::SpinEpoll => {
            // The eventfd may still be set by a message that came just before an earlier sleep.
            while !spin(&ready) && asleep.begun(&ready) {
                bell.until_rung()?;
            }
            Ok(())
        }
        Sleeps::Futex => {
            while !ready() && asleep.begun(&ready) {
                match futex::wait(asleep.0, futex::Flags::empty(), 1, None) {
                    Ok(()) | Err(Errno::AGAIN | Errno::INTR) => {}
                    Err(errno) => return Err(errno.into()),
                }
            }
            Ok(())
        }
    }
}

fn spin(ready: impl Fn() -> bool) -> bool {
    let end = Instant::now() + SPIN;
    loop {
        for _ in 0..LOOKS {
            if ready() {
                return true;
            }
            spin_loop();
        }
        if Instant::now() >= end {
            return false;
        }
    }
}

/// An eventfd in an epoll set.
pub(super) struct Bell {
    bell: OwnedFd,
    set: OwnedFd,
    events: Vec<epoll::Event>,
    /// Writes of the eventfd that were read and not yet consumed.
    rings: u64,
}

impl Bell {
    /// Creates an eventfd.
    pub(super) fn cast() -> Result<OwnedFd> {
        Ok(eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK)?)
    }

    /// Adds an eventfd to a new epoll set.
    pub(super) fn listen(bell: OwnedFd) -> Result<Self> {
        let set = epoll::create(epoll::CreateFlags::CLOEXEC)?;
        epoll::add(&set, bell.as_fd(), epoll::EventData::new_u64(0), epoll::EventFlags::IN)?;
        Ok(Self { bell, set, events: Vec::with_capacity(1), rings: 0 })
    }

    fn until_rung(&mut self) -> Result<()> {
        while self.rings == 0 {
            self.events.clear();
            match epoll::wait(&self.set, spare_capacity(&mut self.events), None) {
                Ok(_) | Err(Errno::INTR) => {}
                Err(errno) => return Err(errno.into()),
            }
            let mut counter = [0; 8];
            match read(&self.bell, &mut counter) {
                Ok(_) => self.rings = u64::from_ne_bytes(counter),
                Err(Errno::AGAIN | Errno::INTR) => {}
                Err(errno) => return Err(errno.into()),
            }
        }
        self.rings -= 1;
        Ok(())
    }
}
