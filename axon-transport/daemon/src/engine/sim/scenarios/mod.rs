//! Scenarios with many cases. `cargo test` runs a sample of them, `cargo xtask simulate --scenarios` all.

mod best_effort;
mod compression;
mod cuts;
mod hostile;
mod kills;
mod long;
mod losses;
mod memory;
mod moves;
mod priorities;
mod radio;
mod refused;
mod replaced;
mod rules;
mod segment;
mod torture;
mod two_links;
mod unfair;
