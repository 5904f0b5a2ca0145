//! Drives many engines in one process, with a virtual clock, a simulated network and a script of faults.
//!
//! Everything follows from one seed. The parts here know nothing of the engine: [`network`] carries
//! datagrams, [`script`] says which fault happens when, [`trace`] tells whether two runs were the same, and
//! [`rng`] gives each part its own generator.

pub(crate) mod network;
pub(crate) mod rng;
pub(crate) mod script;
pub(crate) mod trace;
