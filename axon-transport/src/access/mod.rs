//! Access rules: which topics and services a peer may publish, subscribe to, serve, call and see.
//!
//! A *party* is another host, by the name that it proved, or another user of this host. A rule applies to a party's
//! actions on this host. Each daemon applies its own rules, so that either side alone protects itself. Rules come
//! from `[[allow]]`, `[[deny]]` and `[[limit]]` in `axon.toml` or in the file that `AXON_ACCESS_FILE` names.
//! `docs/access-control.md` describes them.
//!
//! ```
//! use axon_transport::access::{AccessRules, Principal, Verb};
//!
//! let rules = AccessRules::parse(
//!     r#"
//!     [[allow]]
//!     peer = "base"
//!     publish = "/cmd_vel"
//!     subscribe = ["/scan", "/camera/**"]
//!     "#,
//!     "access.toml",
//! )?;
//! let base = Principal::Name("base");
//! assert!(rules.check(base, Verb::Publish, "/cmd_vel").allowed());
//! let denied = rules.check(base, Verb::Publish, "/scan");
//! assert_eq!(denied.to_string(), "denied: no [[allow]] in access.toml permits this");
//! // The rule names only the base station: nothing changes for other hosts.
//! assert!(rules.check(Principal::Name("laptop"), Verb::Publish, "/scan").allowed());
//! # Ok::<(), axon_transport::access::AccessError>(())
//! ```

#![forbid(unsafe_code)]

mod decision;
mod digest;
mod limit;
pub(crate) mod parse;
mod party;
mod pattern;
mod pattern_set;
mod permissions;
pub(crate) mod ros;
mod rules;
mod starred_segments;
#[cfg(test)]
mod tests;

pub use decision::Decision;
pub use limit::{EgressLimit, InterfaceLimit, Overflow, PlacedLimit, RateLimit};
pub use parse::AccessError;
pub(crate) use party::HostPattern;
pub use party::Principal;
pub use pattern::TopicPattern;
pub use permissions::Permissions;
pub use rules::{AccessRules, Expectation, Verb};
