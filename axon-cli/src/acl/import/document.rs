//! What a document says, in the order in which it says it.

use roxmltree::Node;

use super::{
    notes::{Effect, Notes},
    xml::Lines,
};

/// As many expressions as the part of a document may have that is imported.
const MOST: usize = 8192;

/// What a participant of DDS does with a topic of DDS.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Does {
    Publish,
    Subscribe,
}

/// One expression.
#[derive(Debug)]
pub(super) struct Says {
    pub(super) allows: bool,
    pub(super) does: Does,
    /// For topics of DDS.
    pub(super) expression: String,
    pub(super) line: u32,
}

/// What one enclave may do.
#[derive(Debug)]
pub(super) struct Grant {
    pub(super) enclave: String,
    pub(super) says: Vec<Says>,
    pub(super) allows_by_default: bool,
}

impl Grant {
    /// # Errors
    /// There is too much.
    pub(super) fn push(&mut self, says: Says) -> Result<(), String> {
        if self.says.len() == MOST {
            return Err(format!("more than {MOST} expressions for {:?}", self.enclave));
        }
        self.says.push(says);
        Ok(())
    }
}

/// The one part of a document that is about an enclave. `all` has the parts, each with the names that it goes by.
///
/// # Errors
/// There is none, or more than one.
pub(super) fn choose<'a, 'i>(
    all: Vec<(Node<'a, 'i>, Vec<String>)>,
    what: &str,
    enclave: Option<&str>,
) -> Result<(Node<'a, 'i>, String), String> {
    let named = |names: &[String]| names.first().cloned().unwrap_or_default();
    let known: Vec<_> =
        all.iter().take(20).map(|(_, names)| format!("{:?}", named(names))).collect();
    let known = known.join(", ");
    let count = all.len();
    let fits = |names: &[String]| enclave.is_none_or(|one| names.iter().any(|name| name == one));
    let mut chosen = all.into_iter().filter(|(_, names)| fits(names));
    match (chosen.next(), chosen.next(), enclave) {
        _ if count == 0 => Err(format!("it has no {what}")),
        (Some((node, names)), None, _) => Ok((node, named(&names))),
        (Some(_), Some(_), None) => {
            Err(format!("it has {count} {what}s: name one with --enclave: {known}"))
        }
        (Some(_), Some(_), Some(one)) => Err(format!("it has more than one {what} for {one:?}")),
        (None, ..) => Err(format!("it has no {what} for that enclave; it has {known}")),
    }
}

/// Notes an element that nobody knows here.
pub(super) fn unknown(node: Node<'_, '_>, lines: &Lines, effect: Effect, notes: &mut Notes) {
    let name = node.tag_name().name();
    notes.add(
        effect,
        lines.of(node),
        format!("element <{name}> is not known, and was not looked at"),
    );
}

/// The value of an element or attribute that says ALLOW or DENY.
///
/// # Errors
/// It says neither.
pub(super) fn allows(value: &str, line: u32) -> Result<bool, String> {
    match value {
        "ALLOW" => Ok(true),
        "DENY" => Ok(false),
        other => Err(format!("line {line}: {other:?}; accepted: ALLOW, DENY")),
    }
}
