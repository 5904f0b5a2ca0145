//! Measures ways to get bytes from one process to another and back, each beside the raw limit and
//! in turns with it, so that whatever disturbs the machine hits all of them.
//!
//! A [`Medium`] is such a way, an [`End`] what one of the two processes holds of it. [`Pair`] is
//! the process that measures, [`serve`](serve()) the one that answers. The comparison with other middlewares (`bench-peers/`) includes this folder
//! and adds its media.

mod axon;
mod channel;
mod chart;
pub(crate) mod cpu;
mod load;
mod machine;
mod measure;
mod other;
mod pair;
mod progress;
mod raw;
mod serve;
pub(crate) mod words;

pub(crate) use axon::{Axon, qos};
pub(crate) use channel::Channel;
pub(crate) use chart::{Chart, Line, page};
pub(crate) use load::{End, Load, Medium, Motion, Side, Wake, agree, stamp};
pub(crate) use machine::Machine;
pub(crate) use measure::{Effort, Ratio, Rounds, clock_cost};
pub(crate) use other::{Other, spawn};
pub(crate) use pair::Pair;
pub(crate) use progress::Progress;
pub(crate) use raw::{Raw, SharedPages, Sleeps};
pub(crate) use serve::{now_ns, serve};

/// Whatever stops a measurement.
pub(crate) type Error = Box<dyn std::error::Error + Send + Sync>;
/// What it stops.
pub(crate) type Result<T> = std::result::Result<T, Error>;

/// Sizes that are measured unless others are asked for, in bytes.
pub(crate) const SIZES: [usize; 10] =
    [8, 64, 1 << 10, 4 << 10, 16 << 10, 64 << 10, 256 << 10, 1 << 20, 4 << 20, 25_000_000];
