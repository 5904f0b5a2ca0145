//! Code that the test processes and the tests that start them share.

#[cfg(target_os = "linux")]
pub mod memory;
mod samples;
pub mod schedule;
#[cfg(target_os = "linux")]
mod secrets;
mod words;

pub use samples::{Sizes, payload};
#[cfg(target_os = "linux")]
pub use secrets::{tag_masks, unexpected};
pub use words::{Tally, Word};

use rustix::process::{Signal, getpid, kill_process};

/// Ends this process, as SIGTERM would, when standard input ends. The kernel closes the pipe of a
/// test that was killed, so none of its processes is left behind.
pub fn end_with_stdin() {
    let mut ignored = [0; 64];
    while std::io::Read::read(&mut std::io::stdin(), &mut ignored).is_ok_and(|count| count > 0) {}
    // The signal goes to this process itself. It cannot fail while the process exists.
    let _ = kill_process(getpid(), Signal::TERM);
}

// Its own documentation tests are off: most of them are rustls's, which call the crate `rustls`.
#[cfg(doctest)]
#[doc = include_str!("../../third_party/rustls-axon/README.md")]
struct RustlsAxonReadme;

#[cfg(doctest)]
#[doc = include_str!("../../README.md")]
struct RootReadme;

#[cfg(doctest)]
#[doc = include_str!("../../docs/configuration.md")]
struct ConfigurationPage;
