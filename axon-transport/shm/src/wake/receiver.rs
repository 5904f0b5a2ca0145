//! The receiving end of a doorbell: an epoll set of the bell's socket, of an eventfd by which this process
//! wakes itself, and of a timer. One thread of a session sleeps on it.

#![allow(unsafe_code)]

use std::{
    mem::MaybeUninit,
    os::fd::{AsFd, AsRawFd, BorrowedFd, OwnedFd},
    time::Duration,
};

use rustix::{
    event::{EventfdFlags, PollFd, PollFlags, Timespec, epoll, eventfd, poll},
    io::{Errno, read, write},
    net::{AddressFamily, RecvFlags, SocketFlags, SocketType, recv, socketpair},
    time::{
        Itimerspec, TimerfdClockId, TimerfdFlags, TimerfdTimerFlags, timerfd_create,
        timerfd_settime,
    },
};

use super::DoorbellSender;
use crate::os::descriptors::{PassedFd, carries_descriptors};

/// Number of rings that one system call takes.
const BATCH: usize = 8;
/// Polling interval after the bell has been closed.
pub(super) const CLOSED: Duration = Duration::from_millis(5);
/// Maximum number of rings that one drain takes.
const FLOOD: usize = 512;

const BELL: u64 = 0;
const OWN_WAKEUP: u64 = 1;
const TICK: u64 = 2;

/// The receiving end of the bell, with this process's other wake-ups.
///
/// The sockets preserve packets and are watched edge-triggered: each ring is an event, whether or not the earlier rings
/// have been taken. So a woken thread need not take any, and returns after one system call.
pub(super) struct DoorbellReceiver {
    set: OwnedFd,
    /// If the kernel cannot keep descriptors out of it, it is closed like a descriptor of another process.
    heard: PassedFd,
    /// True if packets may carry descriptors.
    rights: bool,
    bell: DoorbellSender,
    /// An eventfd with which this process wakes itself. It is never passed to another process.
    own_wakeup: OwnedFd,
    tick: OwnedFd,
}

/// The events that arrived.
#[derive(Clone, Copy, Default)]
pub(super) struct HeardBells {
    /// A ring of the bell, or a wake-up from this process.
    pub(super) rung: bool,
    /// A ring of the bell, which is still in its queue.
    pub(super) queued: bool,
    /// Another process closed the bell.
    pub(super) closed: bool,
    /// The timer fired.
    pub(super) tick: bool,
}

impl DoorbellReceiver {
    pub(super) fn new() -> Result<Self, Errno> {
        let (heard, given) =
            socketpair(AddressFamily::UNIX, SocketType::SEQPACKET, SocketFlags::CLOEXEC, None)?;
        let rights = !pass_rights(heard.as_fd(), false);
        let heard = if rights { PassedFd::received(heard) } else { heard.into() };
        let flags = EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK;
        let own_wakeup = eventfd(0, flags)?;
        let flags = TimerfdFlags::CLOEXEC | TimerfdFlags::NONBLOCK;
        let tick = timerfd_create(TimerfdClockId::Monotonic, flags)?;
        let set = epoll::create(epoll::CreateFlags::CLOEXEC)?;
        let edge = epoll::EventFlags::IN | epoll::EventFlags::RDHUP | epoll::EventFlags::ET;
        epoll::add(&set, &heard, epoll::EventData::new_u64(BELL), edge)?;
        epoll::add(&set, &own_wakeup, epoll::EventData::new_u64(OWN_WAKEUP), edge)?;
        let level = epoll::EventFlags::IN;
        epoll::add(&set, &tick, epoll::EventData::new_u64(TICK), level)?;
        Ok(Self { set, heard, rights, bell: DoorbellSender::new(given.into()), own_wakeup, tick })
    }

    /// Returns the end that rings.
    pub(super) fn bell(&self) -> &DoorbellSender {
        &self.bell
    }

    /// Wakes the thread that listens, from within this process.
    pub(super) fn wake_self(&self) {
        // The only possible error is a full counter, after 2^64 wake-ups.
        let _ = write(&self.own_wakeup, &1u64.to_ne_bytes());
    }

    /// Wakes the thread that listens once per `interval`; `None` ends this.
    pub(super) fn tick(&self, interval: Option<Duration>) {
        let interval = Timespec::try_from(interval.unwrap_or_default()).unwrap_or_default();
        let timer = Itimerspec { it_interval: interval, it_value: interval };
        let _ = timerfd_settime(&self.tick, TimerfdTimerFlags::empty(), &timer);
    }

    /// Sleeps until an event arrives, at most for `left`. Events of `others` also end the sleep.
    pub(super) fn listen(&self, others: &[BorrowedFd<'_>], left: Option<Duration>) -> HeardBells {
        let whole = whole_millis(left);
        let timespec = |time| Timespec::try_from(time).ok();
        if others.is_empty() && whole != Some(Duration::ZERO) {
            return self.take(whole.and_then(timespec).as_ref());
        }
        let all = [self.set.as_fd()];
        let mut fds: Vec<PollFd<'_>> = all
            .iter()
            .chain(others)
            .map(|fd| PollFd::from_borrowed_fd(*fd, PollFlags::IN))
            .collect();
        // An interrupted poll counts as a spurious wake-up: the caller checks again and computes the remaining time.
        let _ = poll(&mut fds, left.and_then(timespec).as_ref());
        self.take(Some(&Timespec::default()))
    }

    /// Returns the events that arrive within `timeout`.
    pub(super) fn take(&self, timeout: Option<&Timespec>) -> HeardBells {
        let mut heard = HeardBells::default();
        let mut events = [MaybeUninit::<epoll::Event>::uninit(); 4];
        let Ok((events, _)) = epoll::wait(&self.set, &mut events, timeout) else { return heard };
        for event in events {
            let flags = event.flags;
            match event.data.u64() {
                TICK => heard.tick = read(&self.tick, &mut [0; 8]).is_ok(),
                BELL => {
                    heard.rung = true;
                    heard.queued = true;
                    let over = epoll::EventFlags::RDHUP | epoll::EventFlags::HUP;
                    heard.closed = flags.intersects(over);
                }
                _ => heard.rung = true,
            }
        }
        heard
    }

    /// Stops listening to a bell that was closed.
    pub(super) fn give_up(&self) {
        let _ = epoll::delete(&self.set, &self.heard);
    }

    #[cfg(test)]
    pub(super) fn let_rights_pass(&mut self) {
        pass_rights(self.heard.as_fd(), true);
        self.rights = true;
    }

    /// Takes the rings in the queue.
    pub(super) fn drain(&self) -> Drained {
        if self.rights {
            return self.drain_with_care();
        }
        for _ in 0..FLOOD / BATCH {
            match receive_many(self.heard.as_fd()) {
                BATCH => {}
                _ => return Drained::All,
            }
        }
        Drained::Some
    }

    /// Takes one ring at a time, and no packet with descriptors. Such a packet stays in the queue: its descriptors
    /// would fill this process's table, and the kernel would close in this thread those that do not fit.
    fn drain_with_care(&self) -> Drained {
        for _ in 0..FLOOD {
            if carries_descriptors(&self.heard) {
                return Drained::Rights;
            }
            match recv(&self.heard, &mut [0; 1], RecvFlags::DONTWAIT) {
                Ok(_) | Err(Errno::INTR) => {}
                Err(_) => return Drained::All,
            }
        }
        Drained::Some
    }
}

/// Returns the part of a wait that epoll may do. epoll counts in milliseconds and would be late by up to one, so the
/// remaining fraction is waited for by poll, which takes longer to start.
pub(super) fn whole_millis(left: Option<Duration>) -> Option<Duration> {
    left.map(|left| left - Duration::from_nanos(u64::from(left.subsec_nanos()) % 1_000_000))
}

/// The result of taking the rings of a queue.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Drained {
    /// No ring is left.
    All,
    /// Rings may be left: a process rings without end.
    Some,
    /// A packet carries descriptors, which no ring does.
    Rights,
}

impl AsFd for DoorbellReceiver {
    /// Returns a descriptor that is readable when an event is pending.
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.set.as_fd()
    }
}

/// Takes up to [`BATCH`] packets without reading them. Returns their number: fewer if the queue had no more, or if the
/// call was interrupted.
fn receive_many(socket: BorrowedFd<'_>) -> usize {
    let mut byte = 0u8;
    let mut place = libc::iovec { iov_base: (&raw mut byte).cast(), iov_len: 1 };
    // SAFETY: the structures contain integers and pointers, all of which may be zero: no name, no control data.
    let mut messages: [libc::mmsghdr; BATCH] = unsafe { MaybeUninit::zeroed().assume_init() };
    for message in &mut messages {
        message.msg_hdr.msg_iov = &raw mut place;
        message.msg_hdr.msg_iovlen = 1;
    }
    // SAFETY: each of the `BATCH` headers has one buffer of one byte. They may share it, because the kernel fills them
    // one after the other. `byte`, `place` and `messages` outlive the call.
    let received = unsafe {
        let (flags, no_timeout) = (libc::MSG_DONTWAIT, std::ptr::null_mut());
        libc::recvmmsg(socket.as_raw_fd(), messages.as_mut_ptr(), BATCH as u32, flags, no_timeout)
    };
    usize::try_from(received).unwrap_or(0)
}

/// Sets whether packets may carry descriptors (Linux 6.16). Returns false on older kernels, where they always may.
fn pass_rights(socket: BorrowedFd<'_>, may: bool) -> bool {
    const SO_PASSRIGHTS: libc::c_int = 83;
    let value = libc::c_int::from(may);
    let len = libc::socklen_t::try_from(size_of::<libc::c_int>()).expect("a few bytes");
    // SAFETY: the option's value is an int, which is read only during the call. Older kernels return an error for the
    // unknown option.
    unsafe {
        libc::setsockopt(
            socket.as_raw_fd(),
            libc::SOL_SOCKET,
            SO_PASSRIGHTS,
            (&raw const value).cast(),
            len,
        ) == 0
    }
}
