//! A process that is stepped one instruction at a time and killed.
#![allow(unsafe_code)]

use std::{
    mem,
    panic::{AssertUnwindSafe, catch_unwind},
};

use nix::{
    errno::Errno,
    libc,
    sys::{
        ptrace::{self, Options},
        signal::{Signal, kill, killpg, raise},
        wait::{WaitStatus, waitpid},
    },
    unistd::{ForkResult, Pid, fork, setpgid},
};

/// The traced process; killed and reaped when dropped, with what it forked.
pub(crate) struct Tracee {
    pid: Pid,
    gone: bool,
}

/// What a step led to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Step {
    /// The next instruction.
    Next,
    /// The operation's end.
    Done,
}

/// Marks, in the traced process, where the operation begins and where it ends.
pub(crate) fn mark() {
    raise(Signal::SIGSTOP).expect("a signal to oneself");
}

impl Tracee {
    /// Runs `life` in a fork of this process, which must have one thread, up to its first
    /// [`mark`]. `meanwhile` runs here until then: it plays the other end. Each gets one of `ends`,
    /// and only that one, so that either sees when the other's is closed.
    pub(crate) fn start<E, T>(
        ends: (E, E),
        life: impl FnOnce(E),
        meanwhile: impl FnOnce(E) -> T,
    ) -> (Self, T) {
        let (ours, theirs) = ends;
        // SAFETY: this process has one thread, so no lock is held by one that the child lacks.
        match unsafe { fork() }.expect("a fork") {
            ForkResult::Child => {
                drop(ours);
                // What it forks is of the same group, which can be killed as a whole.
                let _ = setpgid(Pid::from_raw(0), Pid::from_raw(0));
                let traced = ptrace::traceme().is_ok();
                let well = traced && catch_unwind(AssertUnwindSafe(|| life(theirs))).is_ok();
                // SAFETY: ends the process at once; nothing of the parent's may be dropped here.
                unsafe { libc::_exit(if well { 0 } else { 99 }) }
            }
            ForkResult::Parent { child } => {
                drop(theirs);
                let tracee = Self { pid: child, gone: false };
                let result = meanwhile(ours);
                match waitpid(child, None).expect("a child") {
                    WaitStatus::Stopped(_, Signal::SIGSTOP) => {}
                    other => panic!("it did not come to its operation: {other:?}"),
                }
                ptrace::setoptions(child, Options::PTRACE_O_EXITKILL).expect("its tracer");
                (tracee, result)
            }
        }
    }

    /// Lets it execute one instruction, or one system call.
    pub(crate) fn step(&mut self) -> Step {
        ptrace::step(self.pid, None).expect("a stopped tracee");
        match waitpid(self.pid, None).expect("a child") {
            WaitStatus::Stopped(_, Signal::SIGTRAP) => Step::Next,
            WaitStatus::Stopped(_, Signal::SIGSTOP) => Step::Done,
            other => panic!("it ended in its operation: {other:?}"),
        }
    }

    /// Takes up to `count` steps. Whether the operation came to its end.
    pub(crate) fn advance(&mut self, count: u64) -> bool {
        (0..count).any(|_| self.step() == Step::Done)
    }

    /// Lets it run on to the operation's end.
    pub(crate) fn advance_to_end(&mut self) {
        ptrace::cont(self.pid, None).expect("a stopped tracee");
        match waitpid(self.pid, None).expect("a child") {
            WaitStatus::Stopped(_, Signal::SIGSTOP) => {}
            other => panic!("it ended in its operation: {other:?}"),
        }
    }

    /// Lets it go its own way from the operation's end.
    pub(crate) fn release(&mut self) {
        ptrace::detach(self.pid, None).expect("a stopped tracee");
    }

    /// Waits until it has come to its own end, which must be a good one.
    pub(crate) fn finish(&mut self) {
        self.gone = true;
        assert_eq!(waitpid(self.pid, None), Ok(WaitStatus::Exited(self.pid, 0)));
    }

    /// Kills it where it stands. What it forked lives on.
    pub(crate) fn end(&mut self) {
        if !mem::replace(&mut self.gone, true) {
            let _ = kill(self.pid, Signal::SIGKILL);
            while !matches!(
                waitpid(self.pid, None),
                Ok(WaitStatus::Signaled(..) | WaitStatus::Exited(..)) | Err(Errno::ECHILD)
            ) {}
        }
    }
}

impl Drop for Tracee {
    fn drop(&mut self) {
        self.end();
        // Its forks are this process's to reap, which is a subreaper.
        if killpg(self.pid, Signal::SIGKILL).is_ok() {
            while waitpid(Pid::from_raw(-self.pid.as_raw()), None).is_ok() {}
        }
    }
}

/// Why no process can be traced here, if none can.
pub(crate) fn refused() -> Option<String> {
    // SAFETY: as in `Tracee::start`; called before any thread is made.
    match unsafe { fork() } {
        Err(error) => Some(format!("no fork: {error}")),
        Ok(ForkResult::Child) => {
            let code = match ptrace::traceme() {
                Ok(()) => 0,
                Err(errno) => errno as i32,
            };
            // SAFETY: ends the process at once.
            unsafe { libc::_exit(code) }
        }
        Ok(ForkResult::Parent { child }) => match waitpid(child, None) {
            Ok(WaitStatus::Exited(_, 0)) => None,
            Ok(WaitStatus::Exited(_, code)) => {
                Some(format!("ptrace is refused: {}", Errno::from_raw(code)))
            }
            other => Some(format!("a traced process ended oddly: {other:?}")),
        },
    }
}
