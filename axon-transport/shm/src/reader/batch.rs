//! Takes several samples into one buffer, and notifies their publisher once.

use super::{ATTEMPTS, Reader};
use crate::{error::TakeError, ring::types::Taken};

impl Reader {
    /// Takes the next sample, and appends its payload to `out`; also returns the payload's length. Returns `None` also
    /// if `out` is not empty and would be longer than `most` with the payload.
    ///
    /// The publisher, which may wait for the sample to be taken, sees that only after [`tell_taken`](Self::tell_taken).
    ///
    /// # Errors
    /// As for [`take`](Self::take). `out` is unchanged.
    pub fn take_behind(
        &mut self,
        out: &mut Vec<u8>,
        most: usize,
    ) -> Result<Option<(Taken, usize)>, TakeError> {
        let before = out.len();
        for _ in 0..ATTEMPTS {
            let Some((record, bytes)) = self.find_whole()? else { break };
            let len = record.len as usize;
            if before > 0 && before + len > most {
                break;
            }
            if before == 0 {
                // Waiting samples usually have one length. If there is not enough memory for all of them, there may be
                // enough for this one.
                let waiting = usize::try_from(self.unread()).unwrap_or(usize::MAX);
                let _ = out.try_reserve_exact(len.saturating_mul(waiting).min(most).max(len));
            }
            match self.copy_to(&record, &bytes, out) {
                Ok(true) => return Ok(Some((self.taken_untold(&record), len))),
                Ok(false) => out.truncate(before),
                Err(error) => {
                    out.truncate(before);
                    return Err(error);
                }
            }
        }
        Ok(None)
    }

    /// Shows the publisher which samples were [taken](Self::take_behind), and wakes it if it waits for that.
    pub fn tell_taken(&self) {
        if !self.attachment.lane.is_forked() {
            self.tell_cursor();
        }
    }
}
