//! Scenarios with many cases. `cargo test` runs a sample of them, `cargo xtask simulate --scenarios` all.

mod access;
mod best_effort;
mod cuts;
mod hostile;
mod kills;
mod limits;
mod long;
mod losses;
mod memory;
mod moves;
mod priorities;
mod radio;
mod refused;
mod segment;
mod torture;
