//! The rules that concern one party, compiled.

use std::sync::Arc;

use super::{
    Decision, EgressLimit, PlacedLimit, Verb, decision::Reason, limit::LimitRule,
    pattern_set::PatternSet,
};

/// The permissions of one party. They are cheap to clone. The time of a decision does not grow with the number of
/// rules.
#[derive(Clone, Debug, Default)]
pub struct Permissions {
    rules: Option<Arc<Compiled>>,
    limits: Arc<[Arc<LimitRule>]>,
}

#[derive(Debug)]
pub(super) struct Compiled {
    pub(super) file: Arc<str>,
    pub(super) allow: VerbPatterns,
    pub(super) deny: VerbPatterns,
    pub(super) otherwise: DefaultDecision,
}

/// The decision if no pattern fits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum DefaultDecision {
    /// No `[[allow]]` names the party.
    Allow,
    /// An `[[allow]]` names the party.
    NotAllowed,
    /// No `[[allow]]` names the party, and the default is to deny.
    DenyByDefault,
}

/// Patterns by verb.
#[derive(Debug, Default)]
pub(super) struct VerbPatterns([PatternSet; Verb::ALL.len()]);

impl VerbPatterns {
    pub(super) fn of(&self, verb: Verb) -> &PatternSet {
        &self.0[verb as usize]
    }

    pub(super) fn of_mut(&mut self, verb: Verb) -> &mut PatternSet {
        &mut self.0[verb as usize]
    }
}

impl Permissions {
    pub(super) fn new(rules: Option<Compiled>, limits: Arc<[Arc<LimitRule>]>) -> Self {
        Self { rules: rules.map(Arc::new), limits }
    }

    /// Returns whether no rules allow or deny anything.
    pub fn are_unrestricted(&self) -> bool {
        self.rules.is_none()
    }

    /// Returns the limits on this use of the topic or service with this full name. Each limit applies.
    pub fn limits(&self, verb: Verb, name: &str) -> impl Iterator<Item = &PlacedLimit> {
        self.limits.iter().filter_map(move |limit| limit.of(verb, name))
    }

    /// Returns the limits on all output to the party. Each limit applies.
    pub fn egress(&self) -> impl Iterator<Item = &EgressLimit> {
        self.limits.iter().filter_map(|limit| limit.egress())
    }

    /// Returns whether the party may do this with the topic, service or node of this full name.
    pub fn allows(&self, verb: Verb, name: &str) -> bool {
        self.are_unrestricted() || self.check(verb, name).allowed()
    }

    /// Returns whether the party may publish, subscribe to, serve or call anything.
    pub(crate) fn allow_any_use(&self) -> bool {
        let Some(rules) = &self.rules else { return true };
        let open =
            rules.otherwise == DefaultDecision::Allow && !rules.deny.of(Verb::See).fits_all();
        Verb::ALL.into_iter().filter(|verb| *verb != Verb::See).any(|verb| {
            (open || !rules.allow.of(verb).is_empty()) && !rules.deny.of(verb).fits_all()
        })
    }

    /// Like [`allows`](Self::allows), but returns the deciding rule, too. A `[[deny]]` of [`Verb::See`] denies each
    /// use that no `[[allow]]` names, because a hidden endpoint cannot be used.
    pub fn check(&self, verb: Verb, name: &str) -> Decision {
        let Some(rules) = &self.rules else { return Decision(Reason::NoRules) };
        let file = || Arc::clone(&rules.file);
        if let Some(line) = rules.deny.of(verb).first_fit(name) {
            return Decision(Reason::Denied { file: file(), line });
        }
        if let Some(line) = rules.allow.of(verb).first_fit(name) {
            return Decision(Reason::Allowed { file: file(), line });
        }
        if rules.otherwise == DefaultDecision::Allow
            && let Some(line) = rules.deny.of(Verb::See).first_fit(name)
        {
            return Decision(Reason::Denied { file: file(), line });
        }
        Decision(match rules.otherwise {
            DefaultDecision::Allow => Reason::Open { file: file() },
            DefaultDecision::NotAllowed => Reason::NotAllowed { file: file() },
            DefaultDecision::DenyByDefault => Reason::Default { file: file() },
        })
    }
}
