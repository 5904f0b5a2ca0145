//! Grants that are kept until their readers come back.

use std::collections::VecDeque;

use super::super::shares::makes_room;
use crate::{ids::SessionId, registry::limits::MAX_EARLIER_GRANTS, wire::session::Granted};

/// Grants that publishers made through an earlier daemon, to readers that had not taken them up when the publishers
/// connected to this one. A publisher whose process is killed reports no losses. These readers then get the grant and
/// the ring.
#[derive(Debug, Default)]
pub(super) struct EarlierGrants(VecDeque<EarlierGrant>);

#[derive(Debug)]
struct EarlierGrant {
    granted: Granted,
    /// The id of the publisher's process.
    process: u32,
}

impl EarlierGrants {
    pub(super) fn note(&mut self, granted: Granted, process: u32) {
        self.forget(|known| (known.reader, known.writer) == (granted.reader, granted.writer));
        if self.0.len() == MAX_EARLIER_GRANTS
            && let Some(index) =
                makes_room(self.0.iter().map(|earlier_grant| earlier_grant.process), process)
            && let Some(EarlierGrant { granted: Granted { reader, writer, .. }, .. }) =
                self.0.remove(index)
        {
            tracing::warn!(
                %reader, %writer,
                "more than {MAX_EARLIER_GRANTS} readers have not come back from an earlier daemon: this one \
                 does not count what it lost if its publisher is killed"
            );
        }
        self.0.push_back(EarlierGrant { granted, process });
    }

    pub(super) fn forget(&mut self, which: impl Fn(&Granted) -> bool) {
        self.0.retain(|earlier_grant| !which(&earlier_grant.granted));
    }

    /// Takes the grants of a session's publishers.
    pub(super) fn take(&mut self, session: &SessionId) -> Vec<Granted> {
        let (taken, rest): (Vec<_>, _) =
            self.0.drain(..).partition(|earlier_grant| earlier_grant.granted.writer.is_of(session));
        self.0 = rest.into();
        taken.into_iter().map(|earlier_grant| earlier_grant.granted).collect()
    }
}
