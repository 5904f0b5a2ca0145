//! Measures methods of transferring bytes from one process to another and back. Each takes turns with the raw limit, so
//! that a disturbance of the machine affects all of them.
//!
//! A [`Medium`] is one method, and an [`End`] is the state of it that one of the two processes holds. [`Pair`] is the
//! process that measures, and [`serve`](serve()) is the process that answers. The comparison with other middlewares
//! (`bench-peers/`) includes this folder and adds its media.

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

/// An error that ends a measurement.
pub(crate) type Error = Box<dyn std::error::Error + Send + Sync>;
/// The result of a step of a measurement.
pub(crate) type Result<T> = std::result::Result<T, Error>;

/// The sizes that are measured by default, in bytes.
pub(crate) const SIZES: [usize; 10] =
    [8, 64, 1 << 10, 4 << 10, 16 << 10, 64 << 10, 256 << 10, 1 << 20, 4 << 20, 25_000_000];
