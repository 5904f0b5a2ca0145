//! The content of a DDS Security permissions file (`permissions.xml`), complete and in its order.

use roxmltree::Node;

use super::{
    names::TopicUse,
    signed,
    xml::{self, Lines, child, elements, text},
};

/// Most expressions of one grant.
pub const MOST_EXPRESSIONS: usize = 8192;

/// The permissions of one subject.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SubjectGrant {
    /// The attribute `name`.
    pub name: Option<String>,
    /// The line at which it starts.
    pub line: u32,
    /// The certificate's subject to which it applies, and the line of that element.
    pub subject: Option<(String, u32)>,
    /// The period in which it is valid.
    pub validity: Option<Validity>,
    /// Its rules.
    pub rules: Vec<SubjectRule>,
    /// True if its default is to allow, and the line of that element.
    pub default: Option<(bool, u32)>,
    /// Unknown elements.
    pub unknown: Vec<UnknownElement>,
}

/// The period in which a grant is valid, as text.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Validity {
    /// The first moment.
    pub not_before: String,
    /// The last moment.
    pub not_after: String,
    /// The line of the element.
    pub line: u32,
}

/// An `allow_rule` or `deny_rule`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SubjectRule {
    /// True for an `allow_rule`.
    pub allows: bool,
    /// The line at which it starts.
    pub line: u32,
    /// The domains to which it applies, for each `domains` element.
    pub domains: Vec<Domains>,
    /// The operations and topics that it allows or denies.
    pub criteria: Vec<Criteria>,
    /// The lines of its `relay` elements.
    pub relays: Vec<u32>,
    /// Unknown elements.
    pub unknown: Vec<UnknownElement>,
}

/// The domains to which a rule applies.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Domains {
    /// The first and the last domain of each range, as text.
    pub ranges: Vec<(Option<String>, Option<String>)>,
    /// The line of the element.
    pub line: u32,
}

/// A `publish` or `subscribe`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Criteria {
    /// The operation.
    pub does: TopicUse,
    /// The line at which it starts.
    pub line: u32,
    /// The expressions for DDS topics.
    pub topics: Vec<ExpressionEntry>,
    /// The expressions for partitions; `None` without a `partitions` element.
    pub partitions: Option<Vec<String>>,
    /// True if it has a `data_tags` element.
    pub has_data_tags: bool,
}

/// An expression with its line.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ExpressionEntry {
    /// The expression.
    pub text: String,
    /// Its line.
    pub line: u32,
}

/// An unknown element.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct UnknownElement {
    /// Its name.
    pub name: String,
    /// Its line.
    pub line: u32,
}

impl UnknownElement {
    fn of(node: Node<'_, '_>, lines: &Lines) -> Self {
        Self { name: node.tag_name().name().to_owned(), line: lines.of(node) }
    }
}

/// Reads all grants of a file, which may be signed.
///
/// # Errors
/// The file contains no such document, or an invalid value. The error says which, and in which line.
pub fn parse(file: &str) -> Result<Vec<SubjectGrant>, String> {
    let signed::Cleartext { text, lines_before } = signed::cleartext(file)?;
    let document = xml::parse(text)?;
    let root = document.root_element();
    match root.tag_name().name() {
        "dds" => grants(root, &Lines::new(text, lines_before)),
        other => Err(format!("its first element is <{other}>; accepted: <dds>")),
    }
}

/// Reads all grants from the element `dds`.
///
/// # Errors
/// The errors of [`parse`].
pub fn grants(root: Node<'_, '_>, lines: &Lines) -> Result<Vec<SubjectGrant>, String> {
    let permissions = elements(root).filter(|node| node.has_tag_name("permissions"));
    let grants = permissions.flat_map(elements).filter(|node| node.has_tag_name("grant"));
    grants.map(|node| grant(node, lines)).collect()
}

fn grant(node: Node<'_, '_>, lines: &Lines) -> Result<SubjectGrant, String> {
    let mut read = SubjectGrant {
        name: node.attribute("name").map(str::to_owned),
        line: lines.of(node),
        subject: None,
        validity: None,
        rules: Vec::new(),
        default: None,
        unknown: Vec::new(),
    };
    let mut left = MOST_EXPRESSIONS;
    for element in elements(node) {
        let line = lines.of(element);
        match element.tag_name().name() {
            "subject_name" => once(&mut read.subject, (text(element), line), element, line)?,
            "validity" => {
                let date = |name| child(element, name).map(text).unwrap_or_default();
                let (not_before, not_after) = (date("not_before"), date("not_after"));
                let validity = Validity { not_before, not_after, line };
                once(&mut read.validity, validity, element, line)?;
            }
            "allow_rule" | "deny_rule" => {
                let allows = element.has_tag_name("allow_rule");
                let rule = rule(element, allows, lines);
                let count = rule.criteria.iter().map(|criteria| criteria.topics.len()).sum();
                left = left.checked_sub(count).ok_or_else(|| {
                    let line = read.line;
                    format!("more than {MOST_EXPRESSIONS} expressions in the grant of line {line}")
                })?;
                read.rules.push(rule);
            }
            "default" => {
                let default = allows(&text(element), line)?;
                once(&mut read.default, (default, line), element, line)?;
            }
            _ => read.unknown.push(UnknownElement::of(element, lines)),
        }
    }
    Ok(read)
}

/// Sets a value that a grant may contain only once.
fn once<T>(
    place: &mut Option<T>,
    value: T,
    element: Node<'_, '_>,
    line: u32,
) -> Result<(), String> {
    match place.replace(value) {
        None => Ok(()),
        Some(_) => {
            let name = element.tag_name().name();
            Err(format!("line {line}: a second <{name}> in one grant"))
        }
    }
}

/// Parses the value of an element or attribute: true for ALLOW, false for DENY.
///
/// # Errors
/// It is neither of them.
pub fn allows(value: &str, line: u32) -> Result<bool, String> {
    match value {
        "ALLOW" => Ok(true),
        "DENY" => Ok(false),
        other => Err(format!("line {line}: {other:?}; accepted: ALLOW, DENY")),
    }
}

fn rule(node: Node<'_, '_>, allows: bool, lines: &Lines) -> SubjectRule {
    let mut read = SubjectRule {
        allows,
        line: lines.of(node),
        domains: Vec::new(),
        criteria: Vec::new(),
        relays: Vec::new(),
        unknown: Vec::new(),
    };
    for element in elements(node) {
        let does = match element.tag_name().name() {
            "publish" => TopicUse::Publish,
            "subscribe" => TopicUse::Subscribe,
            "domains" => {
                read.domains.push(domains(element, lines, &mut read.unknown));
                continue;
            }
            "relay" => {
                read.relays.push(lines.of(element));
                continue;
            }
            _ => {
                read.unknown.push(UnknownElement::of(element, lines));
                continue;
            }
        };
        read.criteria.push(criteria(element, does, lines, &mut read.unknown));
    }
    read
}

fn criteria(
    node: Node<'_, '_>,
    does: TopicUse,
    lines: &Lines,
    unknown: &mut Vec<UnknownElement>,
) -> Criteria {
    let mut read = Criteria {
        does,
        line: lines.of(node),
        topics: Vec::new(),
        partitions: None,
        has_data_tags: false,
    };
    for part in elements(node) {
        match part.tag_name().name() {
            "topics" => read.topics.extend(list(part, "topic", lines, unknown)),
            "partitions" => {
                let all = list(part, "partition", lines, unknown);
                read.partitions.get_or_insert_default().extend(all.into_iter().map(|one| one.text));
            }
            "data_tags" => read.has_data_tags = true,
            _ => unknown.push(UnknownElement::of(part, lines)),
        }
    }
    read
}

/// Returns the texts of the elements with this name, and collects unknown elements.
fn list(
    node: Node<'_, '_>,
    name: &str,
    lines: &Lines,
    unknown: &mut Vec<UnknownElement>,
) -> Vec<ExpressionEntry> {
    let mut all = Vec::new();
    for element in elements(node) {
        if element.has_tag_name(name) {
            all.push(ExpressionEntry { text: text(element), line: lines.of(element) });
            unknown.extend(elements(element).map(|inner| UnknownElement::of(inner, lines)));
        } else {
            unknown.push(UnknownElement::of(element, lines));
        }
    }
    all
}

fn domains(node: Node<'_, '_>, lines: &Lines, unknown: &mut Vec<UnknownElement>) -> Domains {
    let mut ranges = Vec::new();
    for element in elements(node) {
        match element.tag_name().name() {
            "id" => ranges.push((Some(text(element)), Some(text(element)))),
            "id_range" => {
                let bound = |name| child(element, name).map(text);
                ranges.push((bound("min"), bound("max")));
            }
            _ => unknown.push(UnknownElement::of(element, lines)),
        }
    }
    Domains { ranges, line: lines.of(node) }
}

/// Returns the common name of a certificate's subject: `/arm` of `CN=/arm,O=x`.
pub fn common_name(subject: &str) -> Option<&str> {
    subject.split(',').find_map(|part| part.trim().strip_prefix("CN="))
}
