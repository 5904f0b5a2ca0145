//! Handshakes on external PSKs over a byte stream: hostile peers first, then those that work.

mod client_hello;
mod common;
mod configs;
mod handshakes;
mod hostile_client;
mod hostile_server;
mod peer;
mod resumption;
mod server_hello;
