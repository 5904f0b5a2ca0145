//! Futures that wait for messages, in a session that has its process to itself.

mod calls;
mod forked;
mod receive;
mod slices;
mod support;
