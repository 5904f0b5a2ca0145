//! The C interface as a static and a shared library: what the tests build C programs with. To install
//! them, see the README.

pub use axon_transport::internal::ffi::*;
