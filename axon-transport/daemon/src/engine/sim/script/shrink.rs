//! Reduces a failing script: delta debugging over the faults, then simpler faults, until neither helps.

use std::{collections::BTreeSet, time::Duration};

use super::{Fault, Kind, PathChange, Script};

/// Outcome of [`Script::shrink`].
#[derive(Clone, Debug)]
pub(crate) struct Shrunk {
    pub(crate) script: Script,
    /// The number of calls of `fails`.
    pub(crate) runs: usize,
    /// Whether the limit of runs was reached first. Otherwise no fault can be deleted and none made simpler
    /// by one step.
    pub(crate) stopped: bool,
}

impl Script {
    /// Returns a smaller script for which `fails` is still true, with at most `max_runs` calls of it.
    ///
    /// `fails` must give the same answer for the same script, and is not asked about `self`, which fails.
    pub(crate) fn shrink(&self, max_runs: usize, fails: impl FnMut(&Self) -> bool) -> Shrunk {
        let mut search = Search { best: self.clone(), runs: 0, max_runs, fails };
        loop {
            let before = search.best.clone();
            search.delete_chunks();
            search.simplify_faults();
            search.drop_hosts();
            if search.best == before || search.is_over() {
                break;
            }
        }
        Shrunk { stopped: search.is_over(), script: search.best, runs: search.runs }
    }
}

struct Search<F> {
    best: Script,
    runs: usize,
    max_runs: usize,
    fails: F,
}

impl<F: FnMut(&Script) -> bool> Search<F> {
    fn is_over(&self) -> bool {
        self.runs >= self.max_runs
    }

    /// Takes `candidate` if it fails.
    fn try_script(&mut self, candidate: Script) -> bool {
        if self.is_over() || candidate == self.best {
            return false;
        }
        self.runs += 1;
        let fails = (self.fails)(&candidate);
        if fails {
            self.best = candidate;
        }
        fails
    }

    /// Deletes chunks of faults: all, halves, quarters, down to single ones, as long as one can go.
    fn delete_chunks(&mut self) {
        let mut size = self.best.faults.len();
        while size > 0 && !self.is_over() {
            let mut deleted = false;
            // The search goes from the end: late faults are least likely to be a condition of early ones.
            let mut end = self.best.faults.len();
            while end > 0 {
                let start = end.saturating_sub(size);
                let mut candidate = self.best.clone();
                candidate.faults.drain(start..end);
                deleted |= self.try_script(candidate);
                end = start;
            }
            // Once no single fault can be deleted, the search is over.
            if size > 1 || !deleted {
                size /= 2;
            }
        }
    }

    fn simplify_faults(&mut self) {
        for index in 0..self.best.faults.len() {
            // Each accepted step is strictly simpler, so this ends.
            while !self.is_over() {
                let simpler = simpler(&self.best.faults[index]);
                let accepted = simpler.into_iter().any(|fault| {
                    let mut candidate = self.best.clone();
                    candidate.faults[index] = fault;
                    self.try_script(candidate)
                });
                if !accepted {
                    break;
                }
            }
        }
    }

    /// Leaves out the hosts that no fault names: first all, then one by one from the last.
    fn drop_hosts(&mut self) {
        let named: BTreeSet<usize> = {
            let mut script = self.best.clone();
            let hosts = script.faults.iter_mut().flat_map(|fault| fault.kind.hosts_mut());
            hosts.map(|host| *host).collect()
        };
        let unnamed: Vec<usize> = (0..self.best.hosts).filter(|h| !named.contains(h)).collect();
        if unnamed.is_empty() || self.try_script(without_hosts(&self.best, &unnamed)) {
            return;
        }
        for host in unnamed.into_iter().rev() {
            self.try_script(without_hosts(&self.best, &[host]));
        }
    }
}

/// Returns the script with the hosts above `gone` moved down. No fault may name a host of `gone`.
fn without_hosts(script: &Script, gone: &[usize]) -> Script {
    let mut script = script.clone();
    script.hosts -= gone.len();
    for host in script.faults.iter_mut().flat_map(|fault| fault.kind.hosts_mut()) {
        *host -= gone.iter().filter(|other| **other < *host).count();
    }
    script
}

/// Returns the faults that are one step simpler, the simplest first.
fn simpler(fault: &Fault) -> Vec<Fault> {
    let kinds = simpler_kinds(&fault.kind).into_iter().map(|kind| Fault { kind, ..fault.clone() });
    let mut all: Vec<Fault> = kinds.collect();
    if let Some(lasts) = fault.lasts {
        let shorter = shorter(lasts).into_iter();
        all.extend(shorter.map(|lasts| Fault { lasts: Some(lasts), ..fault.clone() }));
    }
    all.extend(shorter(fault.at).into_iter().map(|at| Fault { at, ..fault.clone() }));
    all
}

fn simpler_kinds(kind: &Kind) -> Vec<Kind> {
    match kind {
        Kind::Partition { hosts } => (0..hosts.len())
            .filter(|_| hosts.len() > 1)
            .map(|gone| {
                let mut hosts = hosts.clone();
                hosts.remove(gone);
                Kind::Partition { hosts }
            })
            .collect(),
        Kind::Path { from, to, change } => {
            let changes = simpler_paths(change).into_iter();
            changes.map(|change| Kind::Path { from: *from, to: *to, change }).collect()
        }
        Kind::Publish { host, topic, count, size, every } => {
            let (host, topic) = (*host, *topic);
            let publish = |count, size, every| Kind::Publish { host, topic, count, size, every };
            let mut kinds: Vec<Kind> =
                lower(*count, 1).map(|count| publish(count, *size, *every)).collect();
            kinds.extend(lower(*size, 0).map(|size| publish(*count, size, *every)));
            kinds.extend(shorter(*every).into_iter().map(|every| publish(*count, *size, every)));
            kinds
        }
        Kind::Cut { .. }
        | Kind::Kill { .. }
        | Kind::Pause { .. }
        | Kind::Rebind { .. }
        | Kind::Move { .. }
        | Kind::InterfaceDown { .. }
        | Kind::Kme { .. }
        | Kind::Publisher { .. }
        | Kind::Subscription { .. } => Vec::new(),
    }
}

fn simpler_paths(change: &PathChange) -> Vec<PathChange> {
    let per_mille = |value: u16| lower(value.into(), 0).map(|value| value as u16);
    let mut all = Vec::new();
    all.extend(change.rate.map(|_| PathChange { rate: None, ..*change }));
    all.extend(per_mille(change.reorder).map(|reorder| PathChange { reorder, ..*change }));
    all.extend(per_mille(change.duplicate).map(|duplicate| PathChange { duplicate, ..*change }));
    all.extend(per_mille(change.loss).map(|loss| PathChange { loss, ..*change }));
    all.extend(shorter(change.jitter).into_iter().map(|jitter| PathChange { jitter, ..*change }));
    all.extend(shorter(change.delay).into_iter().map(|delay| PathChange { delay, ..*change }));
    all
}

/// Returns values below `value`, as a binary search for the least one takes them: `least`, the middle, and ever
/// closer ones.
fn lower(value: u32, least: u32) -> impl Iterator<Item = u32> {
    let distance = value.saturating_sub(least);
    let steps = std::iter::successors(Some(distance), |step| Some(step / 2));
    steps.take_while(|step| *step > 0).map(move |step| value - step)
}

/// Returns times below `time`: none, the whole seconds and tenths in it, then as [`lower`] in milliseconds.
fn shorter(time: Duration) -> Vec<Duration> {
    let millis = u32::try_from(time.as_millis()).unwrap_or(u32::MAX);
    let whole = |unit: u32| millis / unit * unit;
    let round = [0, whole(1_000), whole(100), millis].into_iter();
    let mut times: Vec<Duration> = Vec::new();
    for time_below in round.chain(lower(millis, 0)).map(|ms| Duration::from_millis(ms.into())) {
        if time_below < time && !times.contains(&time_below) {
            times.push(time_below);
        }
    }
    times
}
