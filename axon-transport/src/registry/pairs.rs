//! The pairs of writers and readers, and how far each has come.

use std::collections::{BTreeMap, HashMap};

use super::limits::{MAX_ALL_PAIRS, MAX_PAIRS};
use crate::{
    ids::{Gid, SessionId},
    wire::session::{Attach, Granted, Pair},
};

/// How far a pair has come.
#[derive(Debug)]
struct PairProgress {
    /// The session that announced the second of the two.
    by: SessionId,
    /// What its reader asked.
    attach: Option<Attach>,
    /// The subscriptions that the reader stands for, as last sent to the writer.
    stands_for: Option<Vec<Gid>>,
    /// What its writer answered. A reader that asks anew is answered anew.
    grant: Option<Granted>,
}

/// The pairs. Each counts for the session whose announcement made it.
#[derive(Debug, Default)]
pub(super) struct Pairs {
    all: BTreeMap<Pair, PairProgress>,
    /// How many each session made. No entry is zero.
    made: HashMap<SessionId, usize>,
}

impl Pairs {
    pub(super) fn len(&self) -> usize {
        self.all.len()
    }

    pub(super) fn contains(&self, pair: &Pair) -> bool {
        self.all.contains_key(pair)
    }

    /// Those of some pairs that there are.
    pub(super) fn existing(&self, pairs: Vec<Pair>) -> impl Iterator<Item = Pair> {
        pairs.into_iter().filter(|pair| self.contains(pair))
    }

    /// Why a session's announcement may not make so many pairs, if it may not. The gateway's stand-ins are bounded by
    /// its links, and not here.
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

    /// Returns whether there was such a pair.
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

    /// Stores what a reader asks. Returns whether its writer has to hear of it: a repetition is not passed on. Each
    /// session that should know has been told, is about to be, or is behind. Sessions that are told everything anew
    /// would otherwise set each other back without end.
    pub(super) fn attach(&mut self, attach: Attach) -> bool {
        let pair = Pair { reader: attach.reader, writer: attach.writer };
        // The pair may have ended while the message was on its way.
        let Some(progress) = self.all.get_mut(&pair) else { return false };
        let attach = Some(attach);
        let of = |attach: &Option<Attach>| attach.clone().map(|a| Attach { after: None, ..a });
        if of(&progress.attach) == of(&attach) {
            return false;
        }
        *progress = PairProgress { attach, stands_for: None, grant: None, by: progress.by };
        true
    }

    /// Stores what a writer grants a reader that asked. Returns whether the reader has to hear of it.
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

    /// What a pair's reader asked.
    pub(super) fn attach_of(&self, pair: &Pair) -> Option<&Attach> {
        self.all.get(pair)?.attach.as_ref()
    }

    /// What a pair's writer granted.
    pub(super) fn grant_of(&self, pair: &Pair) -> Option<&Granted> {
        self.all.get(pair)?.grant.as_ref()
    }

    /// The subscriptions that a reader stands for, as its writer was told last.
    pub(super) fn told(&self, pair: &Pair) -> Option<&Vec<Gid>> {
        self.all.get(pair)?.stands_for.as_ref()
    }

    /// Notes what a writer is told of the subscriptions that its reader stands for.
    pub(super) fn set_told(&mut self, pair: &Pair, stands_for: Option<&Vec<Gid>>) {
        if let Some(progress) = self.all.get_mut(pair) {
            progress.stands_for = stands_for.cloned();
        }
    }

    /// The pairs whose reader has asked its writer.
    pub(super) fn attached(&self) -> impl Iterator<Item = &Attach> {
        self.all.values().filter_map(|progress| progress.attach.as_ref())
    }
}

#[cfg(test)]
impl Pairs {
    pub(super) fn keys(&self) -> impl Iterator<Item = &Pair> {
        self.all.keys()
    }

    /// How many pairs a session made.
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
        // A reader that asks for something else is to be answered anew.
        pairs.set_told(&pair(1), Some(&vec![Gid([9; 16])]));
        assert!(pairs.attach(asks(pair(1), 128)));
        assert!(pairs.grant_of(&pair(1)).is_none() && pairs.told(&pair(1)).is_none());
        assert_eq!(pairs.attached().count(), 1);
    }
}
