//! The binary `kme-sim`, as a process that ends with its test.

use std::process::{Child, Command};

pub(crate) fn kme_sim() -> Command {
    Command::new(env!("CARGO_BIN_EXE_kme-sim"))
}

/// A process that does not outlive the test.
pub(crate) struct Killed(pub(crate) Child);

impl Drop for Killed {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}
