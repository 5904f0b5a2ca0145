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
    steps: u64,
    /// The instruction at which the last [look](LOOK) found it, if that repeats itself.
    repeats: Option<u64>,
}

/// So often it is looked whether the instruction is one that repeats itself.
const LOOK: u64 = 256;

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
                let tracee = Self { pid: child, gone: false, steps: 0, repeats: None };
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
    ///
    /// An instruction that copies megabytes stops after each byte. Of such a one that two looks on
    /// end found, which are 256 steps apart, the rest is one step.
    pub(crate) fn step(&mut self) -> Step {
        self.steps += 1;
        if self.steps.is_multiple_of(LOOK) && self.finish_repeating() {
            return Step::Next;
        }
        ptrace::step(self.pid, None).expect("a stopped tracee");
        match waitpid(self.pid, None).expect("a child") {
            WaitStatus::Stopped(_, Signal::SIGTRAP) => Step::Next,
            WaitStatus::Stopped(_, Signal::SIGSTOP) => Step::Done,
            other => panic!("it ended in its operation: {other:?}"),
        }
    }

    /// Whether it stood in the middle of an instruction that repeats itself, and has now done it to
    /// its end.
    #[cfg(target_arch = "x86_64")]
    fn finish_repeating(&mut self) -> bool {
        let at = ptrace::getregs(self.pid).expect("a stopped tracee").rip;
        // REP MOVS and REP STOS, with REX.W before the opcode or without.
        let len = match [0, 1, 2].map(|n| self.byte(at + n)) {
            [0xf2 | 0xf3, 0xa4 | 0xa5 | 0xaa | 0xab, _] => 2,
            [0xf2 | 0xf3, 0x48, 0xa4 | 0xa5 | 0xaa | 0xab] => 3,
            _ => {
                self.repeats = None;
                return false;
            }
        };
        if self.repeats.replace(at) != Some(at) {
            return false;
        }
        self.repeats = None;
        self.run_to(at + len);
        true
    }

    /// Other architectures have none.
    #[cfg(not(target_arch = "x86_64"))]
    fn finish_repeating(&mut self) -> bool {
        self.repeats = None;
        false
    }

    /// Lets it run until it comes to the instruction at `end`.
    #[cfg(target_arch = "x86_64")]
    fn run_to(&mut self, end: u64) {
        let (address, shift) = word_of(end);
        let word = ptrace::read(self.pid, address).expect("its code");
        // INT3 stops it once it is executed.
        let stop = word & !(0xff << shift) | (0xcc << shift);
        ptrace::write(self.pid, address, stop).expect("its code");
        ptrace::cont(self.pid, None).expect("a stopped tracee");
        let stopped = waitpid(self.pid, None).expect("a child");
        assert_eq!(stopped, WaitStatus::Stopped(self.pid, Signal::SIGTRAP));
        ptrace::write(self.pid, address, word).expect("its code");
        let mut registers = ptrace::getregs(self.pid).expect("a stopped tracee");
        assert_eq!(registers.rip, end + 1, "it stopped elsewhere");
        registers.rip = end;
        ptrace::setregs(self.pid, registers).expect("a stopped tracee");
    }

    /// A byte of its code; that of no instruction beyond the end of what is mapped.
    #[cfg(target_arch = "x86_64")]
    fn byte(&self, at: u64) -> u8 {
        let (address, shift) = word_of(at);
        ptrace::read(self.pid, address).map_or(0, |word| (word >> shift) as u8)
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

/// The word that a byte of a tracee's is in, which no page's end divides, and where it is in it in
/// bits.
#[cfg(target_arch = "x86_64")]
fn word_of(address: u64) -> (ptrace::AddressType, u64) {
    ((address & !7) as ptrace::AddressType, 8 * (address & 7))
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
