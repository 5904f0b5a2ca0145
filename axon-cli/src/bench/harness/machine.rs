//! The machine on which figures are measured.

use std::fs;

use rustix::{
    system::uname,
    thread::{CpuSet, sched_getaffinity, sched_setaffinity},
};
use serde::Serialize;

use super::Result;

/// The properties of the machine that affect the figures.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Machine {
    pub(crate) host: String,
    pub(crate) kernel: String,
    pub(crate) architecture: String,
    pub(crate) cpu: String,
    /// The number of CPUs that this process may use.
    pub(crate) cpus: usize,
    /// The CPUs that this process may use.
    #[serde(skip)]
    pub(super) allowed: Vec<usize>,
    /// The CPUs of the process that measures and of the other process.
    pub(crate) pinned: [usize; 2],
    /// The average number of running and waiting processes in the minute before.
    pub(crate) load_before: f64,
    /// The time that one reading of the clock takes. It is subtracted from each measured time.
    pub(crate) clock_ns: f64,
}

impl Machine {
    /// Returns the machine on which this process runs.
    ///
    /// # Errors
    /// The process may use only one CPU, on which two processes cannot poll for each other.
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

    /// Lets this thread run on all CPUs that the process may use, after a [`Pair`](super::Pair) has pinned it to one.
    pub(crate) fn release(&self) -> Result<()> {
        unpin(&self.allowed)
    }

    /// Pins this thread to the CPU of the process that measures.
    pub(crate) fn near(&self) -> Result<()> {
        pin(self.pinned[0])
    }

    /// Excludes this thread, and the processes that it starts from now on, from the CPU of the process that measures.
    pub(crate) fn beside(&self) -> Result<()> {
        let near = self.pinned[0];
        let others: Vec<usize> = self.allowed.iter().copied().filter(|cpu| *cpu != near).collect();
        unpin(&others)
    }

    /// Returns the machine as one line of text.
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

/// Pins this thread, and the threads that it starts from now on, to one CPU.
pub(super) fn pin(cpu: usize) -> Result<()> {
    let mut set = CpuSet::new();
    set.set(cpu);
    Ok(sched_setaffinity(None, &set)?)
}

/// Lets this thread run on `cpus`.
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
