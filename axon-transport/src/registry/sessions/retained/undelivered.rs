//! Packets for readers that are not connected.

use std::collections::VecDeque;

use super::super::{outbox::SessionPacket, shares::makes_room};
use crate::{
    ids::SessionId,
    registry::limits::{MAX_LEFT, MAX_UNMET},
};

/// Packets for readers that are not connected, and that never learned of the grant of a publisher that ended. The
/// readers' processes may be stopped or have ended. Packets that pass a ring on wait until the publisher's process has
/// ended, too.
#[derive(Debug)]
pub(super) struct UndeliveredPackets<F> {
    kept: VecDeque<KeptPacket<F>>,
    full: bool,
}

#[derive(Debug)]
struct KeptPacket<F> {
    output: SessionPacket<F>,
    /// The session whose process has to end first.
    awaits: Option<SessionId>,
}

impl<F> KeptPacket<F> {
    fn holds(&self) -> bool {
        !self.output.descriptors.is_empty()
    }
}

impl<F> Default for UndeliveredPackets<F> {
    fn default() -> Self {
        Self { kept: VecDeque::new(), full: false }
    }
}

impl<F> UndeliveredPackets<F> {
    /// Keeps a packet for its reader, which gets it only after the process of session `awaits` has ended. Replaces an
    /// equal packet.
    pub(super) fn keep(&mut self, output: SessionPacket<F>, awaits: Option<SessionId>) {
        self.kept.retain(|kept| kept.output.packet != output.packet);
        let new = KeptPacket { output, awaits };
        let full = self.kept.len() == MAX_UNMET;
        let rings = new.holds() && self.kept.iter().filter(|of| of.holds()).count() == MAX_LEFT;
        if full || rings {
            self.make_room(new.output.process, |kept| full && !rings || kept.holds());
        }
        self.kept.push_back(new);
    }

    /// Removes the oldest packet for which `of` holds, of the process that has the most of them.
    fn make_room(&mut self, newcomer: u32, of: impl Fn(&KeptPacket<F>) -> bool) {
        let those: Vec<usize> =
            (0..self.kept.len()).filter(|index| of(&self.kept[*index])).collect();
        let processes = those.iter().map(|index| self.kept[*index].output.process);
        let Some(oldest) = makes_room(processes, newcomer) else { return };
        self.kept.remove(those[oldest]);
        if !std::mem::replace(&mut self.full, true) {
            tracing::warn!(
                "publishers ended, or were killed, before more than {MAX_UNMET}, or {MAX_LEFT}, \
                 readers were told of them: some of these readers, of the processes with the most such \
                 publishers, do not count what they lost, should their processes go on"
            );
        }
    }

    /// Takes the packets for a session's readers that wait for no process.
    pub(super) fn take(&mut self, session: &SessionId) -> Vec<SessionPacket<F>> {
        self.take_where(|KeptPacket { output, awaits }| {
            awaits.is_none() && output.kept_for.is_some_and(|gid| gid.is_of(session))
        })
    }

    /// Takes the packets that wait until the process of `session` has ended.
    pub(super) fn take_awaiting(&mut self, session: &SessionId) -> Vec<SessionPacket<F>> {
        self.take_where(|kept| kept.awaits.as_ref() == Some(session))
    }

    /// Returns whether packets wait for the end of the process of `session`.
    pub(super) fn awaits(&self, session: &SessionId) -> bool {
        self.kept.iter().any(|kept| kept.awaits.as_ref() == Some(session))
    }

    fn take_where(&mut self, which: impl Fn(&KeptPacket<F>) -> bool) -> Vec<SessionPacket<F>> {
        let (taken, rest): (Vec<_>, _) = self.kept.drain(..).partition(which);
        self.kept = rest.into();
        taken.into_iter().map(|kept| kept.output).collect()
    }
}
