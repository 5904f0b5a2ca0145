//! A process that is single-stepped and killed.
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

/// The traced process. Dropping it kills and reaps the process and its forks.
pub(crate) struct Tracee {
    pid: Pid,
    gone: bool,
    steps: u64,
    /// The repeating instruction at which the last [look](LOOK) found the process, if any.
    repeats: Option<u64>,
}

/// Number of steps between two checks whether the instruction is a repeating one.
const LOOK: u64 = 256;

/// The result of a step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Step {
    /// The process is at the next instruction.
    Next,
    /// The operation has ended.
    Done,
}

/// Marks the beginning and the end of the operation. Called in the traced process.
pub(crate) fn mark() {
    raise(Signal::SIGSTOP).expect("a signal to oneself");
}

impl Tracee {
    /// Runs `life` in a fork of this process up to its first [`mark`]; this process must have only
    /// one thread. `meanwhile` runs here until then, for the other end. Each process gets only one
    /// of `ends`, so that it sees when the other end is closed.
    pub(crate) fn start<E, T>(
        ends: (E, E),
        life: impl FnOnce(E),
        meanwhile: impl FnOnce(E) -> T,
    ) -> (Self, T) {
        let (ours, theirs) = ends;
        // SAFETY: this process has one thread, so no thread that the child lacks holds a lock.
        match unsafe { fork() }.expect("a fork") {
            ForkResult::Child => {
                drop(ours);
                // Its forks are in the same process group, which can be killed as a whole.
                let _ = setpgid(Pid::from_raw(0), Pid::from_raw(0));
                let traced = ptrace::traceme().is_ok();
                let well = traced && catch_unwind(AssertUnwindSafe(|| life(theirs))).is_ok();
                // SAFETY: ends the process at once; nothing of the parent may be dropped here.
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

    /// Lets the process execute one instruction or one system call.
    ///
    /// A repeating instruction that copies megabytes stops after each byte. If two successive
    /// checks, 256 steps apart, find the process at the same one, the rest of the instruction is
    /// one step.
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

    /// Returns whether the process was in the middle of a repeating instruction, which it has now
    /// finished.
    #[cfg(target_arch = "x86_64")]
    fn finish_repeating(&mut self) -> bool {
        let at = ptrace::getregs(self.pid).expect("a stopped tracee").rip;
        // REP MOVS and REP STOS, with or without REX.W before the opcode.
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

    /// Other architectures have no such instructions.
    #[cfg(not(target_arch = "x86_64"))]
    fn finish_repeating(&mut self) -> bool {
        self.repeats = None;
        false
    }

    /// Runs the process up to the instruction at `end`.
    #[cfg(target_arch = "x86_64")]
    fn run_to(&mut self, end: u64) {
        let (address, shift) = word_of(end);
        let word = ptrace::read(self.pid, address).expect("its code");
        // INT3 stops the process when it is executed.
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

    /// Returns a byte of the process's code; beyond the mapped memory a byte that begins no such
    /// instruction.
    #[cfg(target_arch = "x86_64")]
    fn byte(&self, at: u64) -> u8 {
        let (address, shift) = word_of(at);
        ptrace::read(self.pid, address).map_or(0, |word| (word >> shift) as u8)
    }

    /// Takes up to `count` steps. Returns whether the operation ended.
    pub(crate) fn advance(&mut self, count: u64) -> bool {
        (0..count).any(|_| self.step() == Step::Done)
    }

    /// Runs the process to the operation's end.
    pub(crate) fn advance_to_end(&mut self) {
        ptrace::cont(self.pid, None).expect("a stopped tracee");
        match waitpid(self.pid, None).expect("a child") {
            WaitStatus::Stopped(_, Signal::SIGSTOP) => {}
            other => panic!("it ended in its operation: {other:?}"),
        }
    }

    /// Lets the process run freely from the operation's end.
    pub(crate) fn release(&mut self) {
        ptrace::detach(self.pid, None).expect("a stopped tracee");
    }

    /// Waits until the process ends by itself, which must be without an error.
    pub(crate) fn finish(&mut self) {
        self.gone = true;
        assert_eq!(waitpid(self.pid, None), Ok(WaitStatus::Exited(self.pid, 0)));
    }

    /// Kills the process where it is. Its forks live on.
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
        // This process is a subreaper, so it has to reap the forks.
        if killpg(self.pid, Signal::SIGKILL).is_ok() {
            while waitpid(Pid::from_raw(-self.pid.as_raw()), None).is_ok() {}
        }
    }
}

/// Returns the address of the aligned word that contains a byte of a traced process, and the bit
/// offset of the byte. Such a word lies within one page.
#[cfg(target_arch = "x86_64")]
fn word_of(address: u64) -> (ptrace::AddressType, u64) {
    ((address & !7) as ptrace::AddressType, 8 * (address & 7))
}

/// Returns the reason if no process can be traced here.
pub(crate) fn refused() -> Option<String> {
    // SAFETY: as in `Tracee::start`. Called before any thread is started.
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
