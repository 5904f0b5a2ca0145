//! Drives many engines in one process, with a virtual clock, a simulated network and a script of faults.
//!
//! One seed determines everything except the bytes of TLS. [`network`] carries datagrams, [`script`] schedules the
//! faults, [`trace`] shows whether two runs were the same, and [`rng`] gives each part its own generator. [`host`] runs
//! the engine of one host. [`rings`] models its rings, and [`discovery`] chooses the hosts that it dials. [`beacons`]
//! runs the daemon's own discovery instead, in scenarios about dials. [`world`]
//! holds all hosts and the clock. [`run`] runs a script in a world. [`raw`] is a peer without an engine. [`held`]
//! checks that memory is bounded. [`pair`] runs two QUIC connections without the rest of the simulator.

mod beacons;
mod discovery;
mod held;
mod host;
pub(crate) mod network;
pub(crate) mod pair;
mod raw;
pub(crate) mod rings;
pub(crate) mod rng;
mod run;
mod scenarios;
pub(crate) mod script;
mod tests;
mod topics;
pub(crate) mod trace;
mod world;
