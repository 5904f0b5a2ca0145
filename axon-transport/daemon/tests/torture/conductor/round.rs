//! A round's line of the table.

use std::{fmt, time::Duration};

use super::{CEILING_MB, Plan};

/// The disturbances of a round, and the work of the processes that lived to its end.
pub(crate) struct Round {
    pub(super) plan: Plan,
    pub(super) seed: u64,
    pub(super) time: Duration,
    pub(super) done: Done,
    pub(super) published: u64,
    pub(super) taken: u64,
    /// Number of responses taken.
    pub(super) answers: u64,
    pub(super) gone: Gone,
    /// The largest amount of shared memory at a time, in bytes.
    pub(super) most: u64,
}

/// The disturbances of the processes and the daemon.
#[derive(Default)]
pub(super) struct Done {
    /// Number of processes that were started in their own PID namespace.
    pub(super) namespaced: u32,
    pub(super) kills: u32,
    pub(super) stops: u32,
    pub(super) daemons: u32,
    /// Number of publishers and processes that ended.
    pub(super) ends: u32,
}

/// Messages that did not arrive, and did not have to.
#[derive(Default)]
pub(super) struct Gone {
    /// Number of samples of killed publishers, in memory that had not reached their subscribers.
    pub(super) samples: u64,
    /// Number of calls of or to processes that were killed or ended.
    pub(super) calls: u64,
    /// Number of pairs with an ended publisher that never came about, and whose reader counts its
    /// losses.
    pub(super) unmet: u64,
    /// Number of such pairs whose reader no process was left to tell.
    pub(super) untold: u64,
}

impl Round {
    pub(crate) fn heading() -> String {
        format!(
            "{:>6} {:>6} {:>8} {:>6} {:>6} {:>6} {:>8} {:>6} {:>10} {:>9} {:>9} {:>14} {:>11} {:>6} {:>6} {:>6} {:>6}",
            "plan",
            "seed",
            "seconds",
            "PID ns",
            "kills",
            "stops",
            "daemons",
            "ends",
            "published",
            "taken",
            "answers",
            "gone with dead",
            "calls gone",
            "unmet",
            "untold",
            "MiB",
            "most"
        )
    }
}

impl fmt::Display for Round {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { plan, seed, time, done, published, taken, answers, gone, most } = self;
        let Done { namespaced, kills, stops, daemons, ends } = done;
        let Gone { samples, calls, unmet, untold } = gone;
        let (seconds, most) = (time.as_secs_f64(), most >> 20);
        let (plan, limit) = (format!("{plan:?}"), plan.processes() as u64 * CEILING_MB);
        write!(
            f,
            "{plan:>6} {seed:>6} {seconds:>8.1} {namespaced:>6} {kills:>6} {stops:>6} {daemons:>8} \
             {ends:>6} {published:>10} {taken:>9} {answers:>9} {samples:>14} {calls:>11} {unmet:>6} {untold:>6} \
             {most:>6} {limit:>6}"
        )
    }
}
