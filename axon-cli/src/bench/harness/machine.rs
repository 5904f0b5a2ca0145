//! The machine that the figures are of.

use std::fs;

use rustix::{
    system::uname,
    thread::{CpuSet, sched_getaffinity, sched_setaffinity},
};
use serde::Serialize;

use super::Result;

/// What a reader of the figures must know of the machine.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Machine {
    pub(crate) host: String,
    pub(crate) kernel: String,
    pub(crate) architecture: String,
    pub(crate) cpu: String,
    /// How many CPUs this process may use.
    pub(crate) cpus: usize,
    /// Which.
    #[serde(skip)]
    pub(super) allowed: Vec<usize>,
    /// The CPU of the process that measures and that of the other one.
    pub(crate) pinned: [usize; 2],
    /// Processes that ran or wanted to in the minute before.
    pub(crate) load_before: f64,
    /// What one look at the clock takes; it is taken off each time.
    pub(crate) clock_ns: f64,
}

impl Machine {
    /// This one.
    ///
    /// # Errors
    /// It has one CPU only, where two processes cannot poll for each other.
    pub(crate) fn look() -> Result<Self> {
        let system = uname();
        let text = |field: &std::ffi::CStr| field.to_string_lossy().into_owned();
        let allowed = sched_getaffinity(None)?;
        let cpus: Vec<usize> = (0..CpuSet::MAX_CPU).filter(|cpu| allowed.is_set(*cpu)).collect();
        let [near, far, ..] = cpus[..] else {
            return Err("two processes cannot poll for each other on a single CPU".into());
        };
        Ok(Self {
            host: text(system.nodename()),
            kernel: format!("{} {}", text(system.sysname()), text(system.release())),
            architecture: text(system.machine()),
            cpu: cpu_model(),
            cpus: cpus.len(),
            allowed: cpus,
            pinned: [near, far],
            load_before: load_average().unwrap_or(0.0),
            clock_ns: super::clock_cost(),
        })
    }

    /// Lets this thread run wherever the process may, after a [`Pair`](super::Pair) has kept it on one
    /// CPU.
    pub(crate) fn release(&self) -> Result<()> {
        unpin(&self.allowed)
    }

    /// Keeps this thread on the CPU of the process that measures.
    pub(crate) fn near(&self) -> Result<()> {
        pin(self.pinned[0])
    }

    /// Keeps this thread, and the processes that it starts from now on, off that CPU.
    pub(crate) fn beside(&self) -> Result<()> {
        let near = self.pinned[0];
        let others: Vec<usize> = self.allowed.iter().copied().filter(|cpu| *cpu != near).collect();
        unpin(&others)
    }

    /// One line for people.
    pub(crate) fn line(&self) -> String {
        format!(
            "{} ({}), {}, {} CPUs, processes pinned to {} and {}, load before {:.2}, clock {:.0} ns",
            self.cpu,
            self.architecture,
            self.kernel,
            self.cpus,
            self.pinned[0],
            self.pinned[1],
            self.load_before,
            self.clock_ns,
        )
    }
}

/// Keeps this thread, and those that it starts from now on, on one CPU.
pub(super) fn pin(cpu: usize) -> Result<()> {
    let mut set = CpuSet::new();
    set.set(cpu);
    Ok(sched_setaffinity(None, &set)?)
}

/// Lets this thread run wherever `cpus` says.
pub(super) fn unpin(cpus: &[usize]) -> Result<()> {
    let mut set = CpuSet::new();
    cpus.iter().for_each(|cpu| set.set(*cpu));
    Ok(sched_setaffinity(None, &set)?)
}

fn cpu_model() -> String {
    let info = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let model = info.lines().find_map(|line| line.strip_prefix("model name")?.split_once(':'));
    model.map_or_else(|| "unknown CPU".to_owned(), |(_, name)| name.trim().to_owned())
}

fn load_average() -> Option<f64> {
    fs::read_to_string("/proc/loadavg").ok()?.split(' ').next()?.parse().ok()
}
