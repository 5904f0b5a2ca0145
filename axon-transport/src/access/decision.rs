//! The outcome of the rules, and the rule that decides.

use std::{fmt, sync::Arc};

/// The decision on an action of a party, and its reason.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Decision(pub(super) Reason);

#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Reason {
    /// There are no rules.
    NoRules,
    /// No `[[allow]]` names the party, and no `[[deny]]` denies the action.
    Open { file: Arc<str> },
    /// An `[[allow]]` names the party and the action.
    Allowed { file: Arc<str>, line: u32 },
    /// A `[[deny]]` names the party and the action. Or it hides the topic or service, and no `[[allow]]`
    /// names the party.
    Denied { file: Arc<str>, line: u32 },
    /// An `[[allow]]` names the party, and none names the action.
    NotAllowed { file: Arc<str> },
    /// `default = "deny"`, and no `[[allow]]` names the party.
    Default { file: Arc<str> },
}

impl Decision {
    /// Returns whether the party may do this.
    pub fn allowed(&self) -> bool {
        matches!(self.0, Reason::NoRules | Reason::Open { .. } | Reason::Allowed { .. })
    }

    /// Returns the line of the rule that decides, counted from 1, or `None` if no single rule decides.
    pub fn line(&self) -> Option<u32> {
        match self.0 {
            Reason::Allowed { line, .. } | Reason::Denied { line, .. } => Some(line),
            _ => None,
        }
    }
}

impl fmt::Display for Decision {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.0 {
            Reason::NoRules => f.write_str("allowed: there are no access rules"),
            Reason::Open { file } => write!(f, "allowed: no rule in {file} denies this"),
            Reason::Allowed { file, line } => write!(f, "allowed by line {line} of {file}"),
            Reason::Denied { file, line } => write!(f, "denied by line {line} of {file}"),
            Reason::NotAllowed { file } => {
                write!(f, "denied: no [[allow]] in {file} permits this")
            }
            Reason::Default { file } => {
                write!(f, "denied: default = \"deny\" in {file}, and no [[allow]] names the peer")
            }
        }
    }
}
