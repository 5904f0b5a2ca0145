//! Handshakes on external PSKs: hostile peers first, then those that work.
#![cfg(feature = "aws_lc_rs")]

mod client_hello;
mod common;
mod configs;
mod handshakes;
mod hostile_client;
mod hostile_server;
mod key_share;
mod peer;
mod quic;
mod resumption;
mod second_client_hello;
mod selection;
mod server_hello;
