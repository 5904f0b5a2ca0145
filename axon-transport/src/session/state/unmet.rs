//! Readers that never took up the grant of a publisher before it ended. The daemon tells them how many samples they
//! lost.
//!
//! A daemon that is killed loses a grant that it did not pass on, and a reader whose process is stopped comes to the
//! next daemon late. So the session remembers these messages, and sends them to each daemon.

use std::collections::VecDeque;

use crate::wire::session::Unmet;

/// Maximum number of pairs that a session remembers.
const MAX_UNMET_PAIRS: usize = 1024;

/// The pairs of a session's ended publishers and the readers that had not taken up their grant.
#[derive(Debug, Default)]
pub(in crate::session) struct UnmetPairs {
    pairs: VecDeque<Unmet>,
    full: bool,
}

impl UnmetPairs {
    pub(in crate::session) fn is_empty(&self) -> bool {
        self.pairs.is_empty()
    }

    /// Returns the pairs that each daemon receives.
    pub(in crate::session) fn iter(&self) -> impl Iterator<Item = Unmet> {
        self.pairs.iter().copied()
    }

    pub(in crate::session) fn remember(&mut self, unmet: Unmet) {
        if self.pairs.len() == MAX_UNMET_PAIRS {
            self.pairs.pop_front();
            if !std::mem::replace(&mut self.full, true) {
                tracing::warn!(
                    "more than {MAX_UNMET_PAIRS} readers were never told of a publisher of this session \
                     that ended: the oldest of them do not count what they lost if the daemon is \
                     killed before it has told them"
                );
            }
        }
        self.pairs.push_back(unmet);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ids::{Gid, SessionId};

    #[test]
    fn the_oldest_pair_is_forgotten_beyond_the_bound() {
        let mut pairs = UnmetPairs::default();
        let [reader, writer] = [1, 2].map(|session| Gid::new(SessionId([session; 16]), 1));
        for samples in 0..=MAX_UNMET_PAIRS as u64 {
            pairs.remember(Unmet { reader, writer, samples });
        }
        assert_eq!((pairs.iter().count(), pairs.pairs[0].samples), (MAX_UNMET_PAIRS, 1));
    }
}
