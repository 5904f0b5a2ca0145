//! Reads permissions of DDS Security from an enclave's `permissions.xml`, and notes what no rule can express.

use axon_transport::internal::sros2::document::{self, Domains, SubjectRule, UnknownElement};

use super::{
    document::{Grant, Says, choose, unknown},
    notes::{Effect, Notes},
};

/// Returns the grant for an enclave.
///
/// # Errors
/// No grant, or more than one, is for the enclave; or the grant has too many expressions.
pub(super) fn choose_and_note(
    grants: Vec<document::SubjectGrant>,
    enclave: Option<&str>,
    notes: &mut Notes,
) -> Result<Grant, String> {
    let named = grants.into_iter().map(|grant| {
        let names = names(&grant);
        (grant, names)
    });
    let (grant, enclave) = choose(named.collect(), "grant", enclave)?;
    let allows_by_default = grant.default.is_some_and(|(allows, _)| allows);
    let mut read = Grant { enclave, says: Vec::new(), allows_by_default };
    if let Some((subject, line)) = &grant.subject {
        let what = format!(
            "{subject:?} is an enclave's identity; here it is a host's or a user's, and all its processes may \
             do this"
        );
        notes.add(Effect::More, *line, what);
    }
    if let Some(document::Validity { not_before, not_after, line }) = &grant.validity {
        let what = format!("valid from {not_before} to {not_after}; rules here have no dates");
        notes.add(Effect::More, *line, what);
    }
    all_unknown(&grant.unknown, Effect::None, notes);
    for rule in grant.rules {
        self::rule(rule, &mut read, notes)?;
    }
    let what = "the signature (permissions.p7s) was not verified: the rights of the rules file decide who may change the rules";
    notes.add(Effect::None, 0, what);
    let what = "governance.xml is not read: AXON encrypts and authenticates between all hosts, or AXON_SECURITY_MODE \
                says otherwise";
    notes.add(Effect::None, 0, what);
    Ok(read)
}

/// Returns the names of a grant: its own name, the common name in its subject, and the subject.
fn names(grant: &document::SubjectGrant) -> Vec<String> {
    let subject = grant.subject.clone().map(|(subject, _)| subject).unwrap_or_default();
    let common = document::common_name(&subject).map(str::to_owned);
    grant.name.clone().into_iter().chain(common).chain([subject]).collect()
}

fn rule(rule: SubjectRule, read: &mut Grant, notes: &mut Notes) -> Result<(), String> {
    let allows = rule.allows;
    // Rules that omit a part of an allow_rule allow less, and rules that omit a part of a deny_rule allow more. Rules
    // that take a restricted part without its restriction do the reverse.
    let (left_out, in_whole) =
        if allows { (Effect::Less, Effect::More) } else { (Effect::More, Effect::Less) };
    for of in &rule.domains {
        let domains = domains(of);
        let what = format!("for domains {domains}; rules here count in all domains of the daemon");
        notes.add(in_whole, of.line, what);
    }
    for line in rule.relays {
        notes.add(left_out, line, "relay: there is no such right here");
    }
    all_unknown(&rule.unknown, left_out, notes);
    for criteria in rule.criteria {
        // An endpoint of ROS is in the partition without a name.
        let is_of_ros = criteria
            .partitions
            .is_none_or(|all| all.iter().any(|name| name.bytes().all(|byte| byte == b'*')));
        if !is_of_ros || criteria.has_data_tags {
            let done = match allows {
                true => "left out",
                false => "denied whatever their partition or tag",
            };
            let what =
                format!("topics of a partition or with a data tag, which AXON has not: {done}");
            notes.add(Effect::Less, criteria.line, what);
            if allows {
                continue;
            }
        }
        for topic in criteria.topics {
            let (expression, line) = (topic.text, topic.line);
            read.push(Says { allows, does: criteria.does, expression, line })?;
        }
    }
    Ok(())
}

fn all_unknown(all: &[UnknownElement], effect: Effect, notes: &mut Notes) {
    for UnknownElement { name, line } in all {
        unknown(name, *line, effect, notes);
    }
}

fn domains(of: &Domains) -> String {
    let one = |(first, last): &(Option<String>, Option<String>)| {
        let [first, last] = [first, last].map(|bound| bound.as_deref().unwrap_or_default());
        if first == last { first.to_owned() } else { format!("{first} to {last}") }
    };
    of.ranges.iter().map(one).collect::<Vec<_>>().join(", ")
}
