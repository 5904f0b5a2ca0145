//! What `include/axon.h` declares, as a static library.

pub use axon_transport::internal::ffi::*;
