//! The published crates as somebody outside of this repository has them: from their packages, in
//! projects of their own, and from a checkout.
//!
//! Doc tests compile the README's blocks with the features, dependencies and hidden lines of this
//! workspace. Here each block stands alone, in a project to which was added what the README says, and
//! nothing else.
//!
//! Most of it builds all that the crates depend on, in part with other features than the workspace's:
//! `cargo test -p xtask --test outside -- --include-ignored`.

mod beside;
mod checkout;
mod examples;
mod project;
mod readme;
mod run;
#[path = "../support/mod.rs"]
mod support;

/// The crates that are published, and where they are in this repository.
const PUBLISHED: [(&str, &str); 8] = [
    ("etsi-qkd014", "etsi-qkd014"),
    ("axon-envelope", "axon-envelope"),
    ("rustls-axon", "third_party/rustls-axon"),
    ("axon-tls", "axon-tls"),
    ("axon-shm", "axon-transport/shm"),
    ("axon-transport", "axon-transport"),
    ("axon-daemon", "axon-transport/daemon"),
    ("axon-cli", "axon-cli"),
];
