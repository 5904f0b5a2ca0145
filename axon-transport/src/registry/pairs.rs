//! The pairs of writers and readers, and their progress.

use std::collections::{BTreeMap, HashMap};

use super::limits::{MAX_ALL_PAIRS, MAX_PAIRS};
use crate::{
    ids::{Gid, SessionId},
    wire::session::{Attach, Granted, Pair},
};

/// The progress of a pair.
#[derive(Debug)]
struct PairProgress {
    /// The session that announced the second endpoint of the pair.
    by: SessionId,
    /// The reader's request.
    attach: Option<Attach>,
    /// The subscriptions that the reader stands for, as last sent to the writer.
    stands_for: Option<Vec<Gid>>,
    /// The writer's answer. It is removed when the reader sends another request.
    grant: Option<Granted>,
}

/// The pairs. Each counts for the session whose announcement made it.
#[derive(Debug, Default)]
pub(super) struct Pairs {
    all: BTreeMap<Pair, PairProgress>,
    /// The number of pairs that each session made. No entry is zero.
    made: HashMap<SessionId, usize>,
}

impl Pairs {
    pub(super) fn len(&self) -> usize {
        self.all.len()
    }

    pub(super) fn contains(&self, pair: &Pair) -> bool {
        self.all.contains_key(pair)
    }

    /// Returns those of `pairs` that exist.
    pub(super) fn existing(&self, pairs: Vec<Pair>) -> impl Iterator<Item = Pair> {
        pairs.into_iter().filter(|pair| self.contains(pair))
    }

    /// Returns the reason if a session's announcement may not make `new` more pairs. The gateway's stand-ins are
    /// limited by its links, not here.
    pub(super) fn refusal(&self, by: &SessionId, new: usize, is_gateway: bool) -> Option<String> {
        let made = self.made.get(by).copied().unwrap_or_default();
        if !is_gateway && made + new > MAX_PAIRS {
            Some(format!(
                "its session has {made} pairs of publishers and subscriptions, and would have {new} more: the most \
                 are {MAX_PAIRS}"
            ))
        } else if self.all.len() + new > MAX_ALL_PAIRS {
            let all = self.all.len();
            Some(format!(
                "all sessions have {all} pairs of publishers and subscriptions, and there would be {new} more: the \
                 most are {MAX_ALL_PAIRS}"
            ))
        } else {
            None
        }
    }

    /// Adds a new pair.
    pub(super) fn insert(&mut self, pair: Pair, by: SessionId) {
        let new = PairProgress { by, attach: None, stands_for: None, grant: None };
        if let Some(before) = self.all.insert(pair, new) {
            self.uncount(&before.by);
        }
        *self.made.entry(by).or_default() += 1;
    }

    /// Removes a pair. Returns whether it existed.
    pub(super) fn remove(&mut self, pair: &Pair) -> bool {
        let Some(progress) = self.all.remove(pair) else { return false };
        self.uncount(&progress.by);
        true
    }

    fn uncount(&mut self, by: &SessionId) {
        if let Some(made) = self.made.get_mut(by) {
            *made -= 1;
            if *made == 0 {
                self.made.remove(by);
            }
        }
    }

    /// Stores a reader's request. Returns whether its writer has to get it. A repetition is not passed on: each session
    /// that needs it has been sent it, is about to be, or is behind. Sessions that are sent the complete state would
    /// otherwise set each other back without end.
    pub(super) fn attach(&mut self, attach: Attach) -> bool {
        let pair = Pair { reader: attach.reader, writer: attach.writer };
        // The pair may have ended while the message was in flight.
        let Some(progress) = self.all.get_mut(&pair) else { return false };
        let attach = Some(attach);
        let of = |attach: &Option<Attach>| attach.clone().map(|a| Attach { after: None, ..a });
        if of(&progress.attach) == of(&attach) {
            return false;
        }
        *progress = PairProgress { attach, stands_for: None, grant: None, by: progress.by };
        true
    }

    /// Stores a writer's grant to a reader that asked. Returns whether the reader has to get it.
    pub(super) fn grant(&mut self, grant: Granted) -> bool {
        let pair = Pair { reader: grant.reader, writer: grant.writer };
        let Some(progress) = self.all.get_mut(&pair).filter(|p| p.attach.is_some()) else {
            return false;
        };
        let grant = Some(grant);
        let of = |grant: &Option<Granted>| grant.clone().map(|g| Granted { after: None, ..g });
        let changed = of(&progress.grant) != of(&grant);
        if changed {
            progress.grant = grant;
        }
        changed
    }

    /// Returns the request of a pair's reader.
    pub(super) fn attach_of(&self, pair: &Pair) -> Option<&Attach> {
        self.all.get(pair)?.attach.as_ref()
    }

    /// Returns the grant of a pair's writer.
    pub(super) fn grant_of(&self, pair: &Pair) -> Option<&Granted> {
        self.all.get(pair)?.grant.as_ref()
    }

    /// Returns the subscriptions that a reader stands for, as last sent to its writer.
    pub(super) fn told(&self, pair: &Pair) -> Option<&Vec<Gid>> {
        self.all.get(pair)?.stands_for.as_ref()
    }

    /// Records the subscriptions that a writer is told its reader stands for.
    pub(super) fn set_told(&mut self, pair: &Pair, stands_for: Option<&Vec<Gid>>) {
        if let Some(progress) = self.all.get_mut(pair) {
            progress.stands_for = stands_for.cloned();
        }
    }

    /// Returns the requests of all pairs whose reader has asked its writer.
    pub(super) fn attached(&self) -> impl Iterator<Item = &Attach> {
        self.all.values().filter_map(|progress| progress.attach.as_ref())
    }
}

#[cfg(test)]
impl Pairs {
    pub(super) fn keys(&self) -> impl Iterator<Item = &Pair> {
        self.all.keys()
    }

    /// Returns the number of pairs that a session made.
    pub(super) fn made_by(&self, session: &SessionId) -> usize {
        self.made.get(session).copied().unwrap_or_default()
    }
}

#[cfg(test)]
mod tests {
    use axon_shm::internal::Location;

    use super::*;
    use crate::qos::Qos;

    const BY: SessionId = SessionId([1; 16]);

    fn pair(number: u32) -> Pair {
        Pair { reader: Gid::new(BY, number), writer: Gid::new(SessionId([2; 16]), 1) }
    }

    fn asks(Pair { reader, writer }: Pair, offset: u64) -> Attach {
        let lane = Location { segment: 0, offset };
        let (stands_for, segments, after, carries) = (None, Vec::new(), None, None);
        let (qos, session) = (Qos::default(), BY);
        Attach { reader, writer, lane, qos, session, stands_for, segments, after, carries }
    }

    fn grants(Pair { reader, writer }: Pair, generation: u64) -> Granted {
        let ring = Location { segment: 0, offset: 4096 };
        let (session, first, segments) = (SessionId([2; 16]), 0, Vec::new());
        let (after, relayed) = (None, None);
        Granted { reader, writer, generation, first, session, ring, segments, after, relayed }
    }

    #[test]
    fn a_session_makes_pairs_within_its_bound_and_a_removed_one_counts_no_more() {
        let mut pairs = Pairs::default();
        let most = u32::try_from(MAX_PAIRS).unwrap();
        (0..most).for_each(|number| pairs.insert(pair(number), BY));
        assert!(pairs.refusal(&BY, 1, false).unwrap().contains("its session"));
        assert_eq!(pairs.refusal(&BY, 0, false), None);
        assert_eq!(pairs.refusal(&BY, 1, true), None, "the gateway's are not bounded here");
        assert_eq!(pairs.refusal(&SessionId([3; 16]), 1, false), None);
        let rest = MAX_ALL_PAIRS - MAX_PAIRS;
        assert_eq!(pairs.refusal(&BY, rest, true), None);
        assert!(pairs.refusal(&BY, rest + 1, true).unwrap().contains("there would be"));
        assert!(pairs.remove(&pair(0)) && !pairs.remove(&pair(0)));
        assert_eq!(pairs.refusal(&BY, 1, false), None);
        (1..most).for_each(|number| assert!(pairs.remove(&pair(number))));
        assert!(pairs.made.is_empty() && pairs.len() == 0);
    }

    #[test]
    fn a_repeated_question_or_grant_is_not_passed_on() {
        let mut pairs = Pairs::default();
        assert!(!pairs.attach(asks(pair(1), 64)), "there is no such pair");
        pairs.insert(pair(1), BY);
        assert!(!pairs.grant(grants(pair(1), 1)), "nobody asked");
        assert!(pairs.attach(asks(pair(1), 64)));
        assert!(!pairs.attach(Attach { after: Some(7), ..asks(pair(1), 64) }));
        assert!(pairs.grant(grants(pair(1), 1)));
        assert!(!pairs.grant(Granted { after: Some(7), ..grants(pair(1), 1) }));
        assert!(pairs.grant(grants(pair(1), 2)));
        assert_eq!(pairs.grant_of(&pair(1)).unwrap().generation, 2);
        // A reader that sends another request needs another answer.
        pairs.set_told(&pair(1), Some(&vec![Gid([9; 16])]));
        assert!(pairs.attach(asks(pair(1), 128)));
        assert!(pairs.grant_of(&pair(1)).is_none() && pairs.told(&pair(1)).is_none());
        assert_eq!(pairs.attached().count(), 1);
    }
}
