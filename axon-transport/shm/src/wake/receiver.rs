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

/// Rings that one system call takes.
const BATCH: usize = 8;
/// How often there is a look once the bell has been closed.
pub(super) const CLOSED: Duration = Duration::from_millis(5);
/// Rings that are taken at a time.
const FLOOD: usize = 512;

const BELL: u64 = 0;
const OWN_WAKEUP: u64 = 1;
const TICK: u64 = 2;

/// A pair of sockets, of which one end rings, and what else wakes this process.
///
/// The ends are of packets and edge-triggered: each ring is an event, whether those before it have
/// been taken or not. So who is woken need not take any, and is back in one system call.
pub(super) struct DoorbellReceiver {
    set: OwnedFd,
    /// Where the kernel cannot keep descriptors out of it, it closes like one of another process.
    heard: PassedFd,
    /// Packets may carry descriptors.
    rights: bool,
    bell: DoorbellSender,
    /// Never handed out: an eventfd that this process wakes itself with.
    own_wakeup: OwnedFd,
    tick: OwnedFd,
}

/// What came.
#[derive(Clone, Copy, Default)]
pub(super) struct HeardBells {
    /// A ring of the bell, or a wake-up from this process.
    pub(super) rung: bool,
    /// A ring of the bell, which stands in its queue.
    pub(super) queued: bool,
    /// The bell was closed, by another process.
    pub(super) closed: bool,
    /// Only its time.
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

    /// The end that rings.
    pub(super) fn bell(&self) -> &DoorbellSender {
        &self.bell
    }

    /// Wakes the thread that listens, from within this process.
    pub(super) fn wake_self(&self) {
        // A counter that is full, after 2^64 of them, would be the only error.
        let _ = write(&self.own_wakeup, &1u64.to_ne_bytes());
    }

    /// Wakes the thread that listens once per `interval`; `None` ends this.
    pub(super) fn tick(&self, interval: Option<Duration>) {
        let interval = Timespec::try_from(interval.unwrap_or_default()).unwrap_or_default();
        let timer = Itimerspec { it_interval: interval, it_value: interval };
        let _ = timerfd_settime(&self.tick, TimerfdTimerFlags::empty(), &timer);
    }

    /// Sleeps until something comes, for at most `left`. Events of `others` end it too.
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
        // An interrupted poll counts as a spurious wake: the caller looks again and computes what
        // remains of its time.
        let _ = poll(&mut fds, left.and_then(timespec).as_ref());
        self.take(Some(&Timespec::default()))
    }

    /// What came, if it comes within `timeout`.
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

    /// Listens to a bell that was closed no more.
    pub(super) fn give_up(&self) {
        let _ = epoll::delete(&self.set, &self.heard);
    }

    #[cfg(test)]
    pub(super) fn let_rights_pass(&mut self) {
        pass_rights(self.heard.as_fd(), true);
        self.rights = true;
    }

    /// Takes the rings that stand in the queue.
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

    /// Takes one ring at a time, and none with descriptors. These stay where they are: taken, they
    /// would fill this process's table, and the kernel would close in this thread what did not fit.
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

/// What epoll may take of a wait. It counts in milliseconds and would be late by up to one, so the
/// rest, for which the caller is back, is waited for in a way that takes longer to begin.
pub(super) fn whole_millis(left: Option<Duration>) -> Option<Duration> {
    left.map(|left| left - Duration::from_nanos(u64::from(left.subsec_nanos()) % 1_000_000))
}

/// What became of the rings in a queue.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Drained {
    /// None is left.
    All,
    /// There may be more: somebody rings without end.
    Some,
    /// One carries descriptors, as no ring does.
    Rights,
}

impl AsFd for DoorbellReceiver {
    /// Readable when there is something to take.
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.set.as_fd()
    }
}

/// Takes up to [`BATCH`] packets without looking at them. How many there were: fewer if no more stood
/// there, or the call was interrupted.
fn receive_many(socket: BorrowedFd<'_>) -> usize {
    let mut byte = 0u8;
    let mut place = libc::iovec { iov_base: (&raw mut byte).cast(), iov_len: 1 };
    // SAFETY: integers and pointers, all of which may be zero: no name, no control data.
    let mut messages: [libc::mmsghdr; BATCH] = unsafe { MaybeUninit::zeroed().assume_init() };
    for message in &mut messages {
        message.msg_hdr.msg_iov = &raw mut place;
        message.msg_hdr.msg_iovlen = 1;
    }
    // SAFETY: each of the `BATCH` headers has one place of one byte, which they may share as they
    // are filled one after the other. `byte`, `place` and `messages` outlive the call.
    let received = unsafe {
        let (flags, no_timeout) = (libc::MSG_DONTWAIT, std::ptr::null_mut());
        libc::recvmmsg(socket.as_raw_fd(), messages.as_mut_ptr(), BATCH as u32, flags, no_timeout)
    };
    usize::try_from(received).unwrap_or(0)
}

/// Whether packets may carry descriptors. Older kernels (Linux 6.16 is the first) let them; whether
/// this one did as it was told.
fn pass_rights(socket: BorrowedFd<'_>, may: bool) -> bool {
    const SO_PASSRIGHTS: libc::c_int = 83;
    let value = libc::c_int::from(may);
    let len = libc::socklen_t::try_from(size_of::<libc::c_int>()).expect("a few bytes");
    // SAFETY: the option's value is an int; it is read during the call only. Older kernels say that
    // they do not know the option.
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
