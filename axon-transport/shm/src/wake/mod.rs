//! Sleeping until another process has news: tickets, and the doorbell that ends a sleep.
//!
//! A waiter stores a new ticket in a shared word before it sleeps. A process with news for it reads the word and
//! rings the doorbell once per ticket, so a burst costs one system call. In each process one waiter listens to the
//! doorbell, and it wakes the others.

mod bell;
mod doorbell;
mod receiver;
mod spin;
mod ticket;

#[cfg(test)]
mod tests;

pub(crate) use bell::DoorbellSender;
pub(crate) use doorbell::{Doorbell, PURPOSES, WakeListener};
pub use doorbell::{ForwardedWakeups, Purpose, WakeCheck};
pub(crate) use ticket::{arm, disarm, due, settle, waits};
