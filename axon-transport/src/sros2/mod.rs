//! SROS2's permissions of an enclave: what a process of that enclave may publish and subscribe to.
//!
//! `document` contains the content of a file in its order. The session decides by it, and `axon acl import` translates
//! it. [`EnclavePermissions`] decides as DDS Security 1.1 does (9.4.1.3): by the first rule that fits.

mod date;
pub(crate) mod document;
mod enclave;
mod error;
pub(crate) mod expression;
mod file;
mod grant;
pub(crate) mod names;
pub(crate) mod signed;
#[cfg(test)]
mod tests;
pub(crate) mod xml;

pub use enclave::EnclavePermissions;
pub use error::{Denial, PermissionsError};
