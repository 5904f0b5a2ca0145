#![doc = include_str!("../README.md")]
#![deny(unsafe_code)]

pub mod config;
pub mod daemon;
pub mod discovery;
pub mod events;
pub mod ffi;
mod files;
pub mod gateway;
pub mod graph;
pub mod keys;
pub mod link;
mod log_limit;
pub mod owner;
pub mod registry;
mod secrets;
pub mod session;
pub mod status;
pub mod text;
pub mod wire;

pub use axon_shm as shm;
#[doc(inline)]
pub use axon_shm::{ids, qos};
