//! SROS2's policy, from which SROS2 makes the permissions of enclaves. SROS2 writes denials first, so that they win, as
//! they do here.

use axon_transport::internal::{
    access::{ACTION_SERVICES, ACTION_TOPICS},
    sros2::{
        document::allows,
        names::{TopicPart, TopicUse},
        xml::{Lines, elements, text},
    },
};
use roxmltree::Node;

use super::{
    document::{Grant, Says, choose, unknown},
    notes::{Effect, Notes},
};

/// Reads the profiles of an enclave from the element `policy`.
///
/// # Errors
/// The policy has no such enclave, includes other files, or is not valid.
pub(super) fn read(
    root: Node<'_, '_>,
    enclave: Option<&str>,
    lines: &Lines,
    notes: &mut Notes,
) -> Result<Grant, String> {
    if root.descendants().any(|node| node.is_element() && node.tag_name().name() == "include") {
        return Err(
            "it includes other files: resolve them first, as xmllint --xinclude does".into()
        );
    }
    let enclaves = elements(root).filter(|node| node.has_tag_name("enclaves"));
    let enclaves = enclaves.flat_map(elements).filter(|node| node.has_tag_name("enclave"));
    let path = |node: Node<'_, '_>| node.attribute("path").map(str::to_owned).into_iter().collect();
    let (node, enclave) =
        choose(enclaves.map(|one| (one, path(one))).collect(), "enclave", enclave)?;
    let what = format!(
        "{enclave:?} is an enclave; identity here is a host's or a user's, and all its processes may do this"
    );
    notes.add(Effect::More, lines.of(node), what);
    let mut read = Grant { enclave, says: Vec::new(), allows_by_default: false };
    for profiles in elements(node) {
        for profile in elements(profiles) {
            match (profiles.tag_name().name(), profile.tag_name().name()) {
                ("profiles", "profile") => self::profile(profile, &mut read, lines, notes)?,
                _ => unknown_element(profile, lines, Effect::None, notes),
            }
        }
    }
    // SROS2 writes all denials before all other rules, and the first rule that fits decides.
    read.says.sort_by_key(|says| says.allows);
    Ok(read)
}

fn profile(
    profile: Node<'_, '_>,
    read: &mut Grant,
    lines: &Lines,
    notes: &mut Notes,
) -> Result<(), String> {
    let namespace = profile.attribute("ns").unwrap_or("/");
    let node = profile.attribute("node").unwrap_or_default();
    for group in elements(profile) {
        let (kind, line) = (group.tag_name().name(), lines.of(group));
        if !["topics", "services", "actions"].contains(&kind) {
            unknown_element(group, lines, Effect::None, notes);
            continue;
        }
        for attribute in group.attributes() {
            let expand: fn(&str) -> Vec<(TopicUse, String)> = match (kind, attribute.name()) {
                ("topics", "publish") => |name| vec![topic(TopicUse::Publish, name)],
                ("topics", "subscribe") => |name| vec![topic(TopicUse::Subscribe, name)],
                ("services", "request") => |name| service(TopicUse::Publish, name).into(),
                ("services", "reply") => |name| service(TopicUse::Subscribe, name).into(),
                ("actions", "call") => |name| action(TopicUse::Publish, TopicUse::Subscribe, name),
                ("actions", "execute") => {
                    |name| action(TopicUse::Subscribe, TopicUse::Publish, name)
                }
                // This attribute tells where an included file was.
                (_, "base") => continue,
                (_, other) => return Err(format!("line {line}: {kind} has no {other}")),
            };
            let allows = allows(attribute.value(), line)?;
            for entry in elements(group) {
                if !kind.strip_suffix('s').is_some_and(|one| entry.has_tag_name(one)) {
                    let effect = if allows { Effect::Less } else { Effect::More };
                    unknown_element(entry, lines, effect, notes);
                    continue;
                }
                let line = lines.of(entry);
                for (does, expression) in expand(&full(&text(entry), namespace, node)) {
                    read.push(Says { allows, does, expression, line })?;
                }
            }
        }
    }
    Ok(())
}

/// Returns the full name of a topic, service or action that a node calls `name`.
fn full(name: &str, namespace: &str, node: &str) -> String {
    let namespace = namespace.strip_suffix('/').unwrap_or(namespace);
    match name.strip_prefix('~') {
        _ if name.starts_with('/') => name.to_owned(),
        Some(rest) => format!("{namespace}/{node}{rest}"),
        None => format!("{namespace}/{name}"),
    }
}

fn unknown_element(node: Node<'_, '_>, lines: &Lines, effect: Effect, notes: &mut Notes) {
    unknown(node.tag_name().name(), lines.of(node), effect, notes);
}

fn topic(does: TopicUse, name: &str) -> (TopicUse, String) {
    (does, TopicPart::Topic.dds_name(name))
}

/// Returns the topics of a service. A client publishes requests, and a server subscribes to them.
fn service(requests: TopicUse, name: &str) -> [(TopicUse, String); 2] {
    let replies =
        if requests == TopicUse::Publish { TopicUse::Subscribe } else { TopicUse::Publish };
    [(requests, TopicPart::Request.dds_name(name)), (replies, TopicPart::Reply.dds_name(name))]
}

fn action(requests: TopicUse, topics: TopicUse, name: &str) -> Vec<(TopicUse, String)> {
    let services = ACTION_SERVICES.map(|part| service(requests, &format!("{name}/{part}")));
    let topics = ACTION_TOPICS.map(|part| topic(topics, &format!("{name}/{part}")));
    services.into_iter().flatten().chain(topics).collect()
}
