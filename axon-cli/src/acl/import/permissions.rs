//! Permissions of DDS Security, as `permissions.xml` of an enclave has them.

use roxmltree::Node;

use super::{
    document::{Does, Grant, Says, allows, choose, unknown},
    notes::{Effect, Notes},
    xml::{Lines, child, elements, text},
};

/// Reads the grant for an enclave from the element `dds`.
///
/// # Errors
/// There is none, or its rules cannot be told apart.
pub(super) fn read(
    root: Node<'_, '_>,
    enclave: Option<&str>,
    lines: &Lines,
    notes: &mut Notes,
) -> Result<Grant, String> {
    let permissions = elements(root).filter(|node| node.has_tag_name("permissions"));
    let grants = permissions.flat_map(elements).filter(|node| node.has_tag_name("grant"));
    let grants = grants.map(|grant| (grant, names(grant))).collect();
    let (grant, enclave) = choose(grants, "grant", enclave)?;
    let mut read = Grant { enclave, says: Vec::new(), allows_by_default: false };
    for element in elements(grant) {
        let line = lines.of(element);
        match element.tag_name().name() {
            "subject_name" => {
                let subject = text(element);
                let what = format!(
                    "{subject:?} is an enclave's identity; here it is a host's or a user's, and all its processes may \
                     do this"
                );
                notes.add(Effect::More, line, what);
            }
            "validity" => {
                let until = child(element, "not_after").map(text).unwrap_or_default();
                let from = child(element, "not_before").map(text).unwrap_or_default();
                let what = format!("valid from {from} to {until}; rules here have no dates");
                notes.add(Effect::More, line, what);
            }
            "allow_rule" => rule(element, true, &mut read, lines, notes)?,
            "deny_rule" => rule(element, false, &mut read, lines, notes)?,
            "default" => read.allows_by_default = allows(&text(element), line)?,
            _ => unknown(element, lines, Effect::None, notes),
        }
    }
    let what = "the signature (permissions.p7s) was not verified: the rights of the rules file decide who may change the rules";
    notes.add(Effect::None, 0, what);
    let what = "governance.xml is not read: AXON encrypts and authenticates between all hosts, or AXON_SECURITY_MODE \
                says otherwise";
    notes.add(Effect::None, 0, what);
    Ok(read)
}

/// What a grant can be called: its name, its subject, and the common name in it.
fn names(grant: Node<'_, '_>) -> Vec<String> {
    let subject = child(grant, "subject_name").map(text).unwrap_or_default();
    let parts = subject.split(',').map(str::trim);
    let common = parts.filter_map(|part| part.strip_prefix("CN=")).next().map(str::to_owned);
    let name = grant.attribute("name").map(str::to_owned);
    name.into_iter().chain(common).chain([subject]).collect()
}

fn rule(
    rule: Node<'_, '_>,
    allows: bool,
    read: &mut Grant,
    lines: &Lines,
    notes: &mut Notes,
) -> Result<(), String> {
    // What is left out of an allow_rule allows less, and of a deny_rule more. What is taken in whole does the reverse.
    let (left_out, in_whole) =
        if allows { (Effect::Less, Effect::More) } else { (Effect::More, Effect::Less) };
    for element in elements(rule) {
        let does = match element.tag_name().name() {
            "publish" => Does::Publish,
            "subscribe" => Does::Subscribe,
            "domains" => {
                let what = format!(
                    "for domains {}; rules here count in all domains of the daemon",
                    domains(element)
                );
                notes.add(in_whole, lines.of(element), what);
                continue;
            }
            "relay" => {
                notes.add(left_out, lines.of(element), "relay: there is no such right here");
                continue;
            }
            _ => {
                unknown(element, lines, left_out, notes);
                continue;
            }
        };
        let mut topics = Vec::new();
        let mut is_of_ros = true;
        for part in elements(element) {
            match part.tag_name().name() {
                "topics" => topics.extend(elements(part)),
                "partitions" => {
                    // An endpoint of ROS is in the partition without a name.
                    let all: Vec<_> = elements(part).map(text).collect();
                    is_of_ros &= all.iter().any(|name| name.bytes().all(|byte| byte == b'*'));
                }
                "data_tags" => is_of_ros = false,
                _ => unknown(part, lines, left_out, notes),
            }
        }
        if !is_of_ros {
            let (effect, done) = match allows {
                true => (Effect::Less, "left out"),
                false => (Effect::Less, "denied whatever their partition or tag"),
            };
            let what =
                format!("topics of a partition or with a data tag, which AXON has not: {done}");
            notes.add(effect, lines.of(element), what);
            if allows {
                continue;
            }
        }
        for topic in topics {
            if topic.has_tag_name("topic") {
                let (expression, line) = (text(topic), lines.of(topic));
                read.push(Says { allows, does, expression, line })?;
            } else {
                unknown(topic, lines, left_out, notes);
            }
        }
    }
    Ok(())
}

fn domains(element: Node<'_, '_>) -> String {
    let one = |node: Node<'_, '_>| match node.tag_name().name() {
        "id_range" => {
            let bound = |name| child(node, name).map(text).unwrap_or_default();
            format!("{} to {}", bound("min"), bound("max"))
        }
        _ => text(node),
    };
    elements(element).map(one).collect::<Vec<_>>().join(", ")
}
