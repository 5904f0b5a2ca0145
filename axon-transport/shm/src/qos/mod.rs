//! Quality of service: the policies under their ROS 2 names, and the compatibility of offered and requested
//! profiles.
//!
//! Plain data; no I/O. For periods, `None` is infinite.

mod matching;
pub(crate) mod nanoseconds;
mod policy;
mod request;
#[cfg(test)]
mod tests;

pub use matching::{Compatibility, Incompatible, check, compatible, incompatibilities};
pub use policy::{Durability, History, Liveliness, Qos, Reliability};
pub use request::{Choice, QosRequest};
