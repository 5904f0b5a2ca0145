//! The contents of a document, in the document's order.

use axon_transport::internal::sros2::{document::MOST_EXPRESSIONS, names::TopicUse};

use super::notes::{Effect, Notes};

/// One expression of a document.
#[derive(Debug)]
pub(super) struct Says {
    pub(super) allows: bool,
    pub(super) does: TopicUse,
    /// The expression, which fits names of DDS topics.
    pub(super) expression: String,
    pub(super) line: u32,
}

/// The permissions of one enclave.
#[derive(Debug)]
pub(super) struct Grant {
    pub(super) enclave: String,
    pub(super) says: Vec<Says>,
    pub(super) allows_by_default: bool,
}

impl Grant {
    /// # Errors
    /// The grant already has `MOST_EXPRESSIONS` expressions.
    pub(super) fn push(&mut self, says: Says) -> Result<(), String> {
        if self.says.len() == MOST_EXPRESSIONS {
            return Err(format!("more than {MOST_EXPRESSIONS} expressions for {:?}", self.enclave));
        }
        self.says.push(says);
        Ok(())
    }
}

/// Returns the one part of a document that belongs to an enclave. `all` holds the parts, each with its names.
///
/// # Errors
/// No part, or more than one, belongs to the enclave.
pub(super) fn choose<T>(
    all: Vec<(T, Vec<String>)>,
    what: &str,
    enclave: Option<&str>,
) -> Result<(T, String), String> {
    let named = |names: &[String]| names.first().cloned().unwrap_or_default();
    let known: Vec<_> =
        all.iter().take(20).map(|(_, names)| format!("{:?}", named(names))).collect();
    let known = known.join(", ");
    let count = all.len();
    let fits = |names: &[String]| enclave.is_none_or(|one| names.iter().any(|name| name == one));
    let mut chosen = all.into_iter().filter(|(_, names)| fits(names));
    match (chosen.next(), chosen.next(), enclave) {
        _ if count == 0 => Err(format!("it has no {what}")),
        (Some((part, names)), None, _) => Ok((part, named(&names))),
        (Some(_), Some(_), None) => {
            Err(format!("it has {count} {what}s: name one with --enclave: {known}"))
        }
        (Some(_), Some(_), Some(one)) => Err(format!("it has more than one {what} for {one:?}")),
        (None, ..) => Err(format!("it has no {what} for that enclave; it has {known}")),
    }
}

/// Adds a note about an element that this importer does not know.
pub(super) fn unknown(name: &str, line: u32, effect: Effect, notes: &mut Notes) {
    notes.add(effect, line, format!("element <{name}> is not known, and was not looked at"));
}
