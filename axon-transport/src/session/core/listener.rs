//! A task for which the control thread listens.

use super::SessionCore;
use crate::session::error::RecvError;

/// Makes the control thread listen for a task until it is dropped.
pub(in crate::session) struct Listener<'a> {
    core: &'a SessionCore,
}

impl<'a> Listener<'a> {
    pub(in crate::session) fn new(core: &'a SessionCore) -> Result<Self, RecvError> {
        let begun = core.listening.begin_task(&core.segment);
        if begun.map_err(|error| RecvError::of_listening(&error))? {
            core.wake();
        }
        Ok(Self { core })
    }
}

impl Drop for Listener<'_> {
    fn drop(&mut self) {
        // A forked child must not take the parent's locks.
        if !self.core.is_forked() && self.core.listening.end_task() {
            self.core.wake();
        }
    }
}
