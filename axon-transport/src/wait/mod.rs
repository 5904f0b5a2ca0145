//! Sleeping until another process has something: tickets, and the doorbell that ends a sleep.
//!
//! A waiter stores a new ticket in a shared word before it sleeps; whoever has something for it
//! reads the word and rings the doorbell once per ticket, so a burst costs one system call. In a
//! process one waiter polls the doorbell and the others follow it.

mod doorbell;
mod ticket;

#[cfg(test)]
mod tests;

pub use doorbell::ExternalLeader;
pub(crate) use doorbell::{Bell, Doorbell, Purpose};
pub(crate) use ticket::{arm, disarm, due, settle};
