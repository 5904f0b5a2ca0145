//! Permissions of DDS Security, as `permissions.xml` has them: all that they say, in their order.

use roxmltree::Node;

use super::{
    names::TopicUse,
    signed,
    xml::{self, Lines, child, elements, text},
};

/// As many expressions as one grant may have.
pub const MOST_EXPRESSIONS: usize = 8192;

/// What one subject may do.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SubjectGrant {
    /// Its attribute `name`.
    pub name: Option<String>,
    /// The line of its start.
    pub line: u32,
    /// The subject of the certificate that it is for, and the line that says so.
    pub subject: Option<(String, u32)>,
    /// When it counts.
    pub validity: Option<Validity>,
    /// Its rules.
    pub rules: Vec<SubjectRule>,
    /// Whether it allows what no rule fits, and the line that says so.
    pub default: Option<(bool, u32)>,
    /// Elements that are known to nobody here.
    pub unknown: Vec<UnknownElement>,
}

/// When a grant counts, as it is written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Validity {
    /// The first moment.
    pub not_before: String,
    /// The last one.
    pub not_after: String,
    /// The line that says so.
    pub line: u32,
}

/// An `allow_rule` or `deny_rule`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SubjectRule {
    /// Whether it allows.
    pub allows: bool,
    /// The line of its start.
    pub line: u32,
    /// The domains that it is for, of each element that names some.
    pub domains: Vec<Domains>,
    /// What it is about.
    pub criteria: Vec<Criteria>,
    /// The lines of what it says of relays.
    pub relays: Vec<u32>,
    /// Elements that are known to nobody here.
    pub unknown: Vec<UnknownElement>,
}

/// Domains that a rule is for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Domains {
    /// The first and the last of each range, as they are written.
    pub ranges: Vec<(Option<String>, Option<String>)>,
    /// The line that says so.
    pub line: u32,
}

/// A `publish` or `subscribe`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Criteria {
    /// What is done.
    pub does: TopicUse,
    /// The line of its start.
    pub line: u32,
    /// Expressions for topics of DDS.
    pub topics: Vec<ExpressionEntry>,
    /// Expressions for partitions, where it has an element for some.
    pub partitions: Option<Vec<String>>,
    /// Whether it has an element for data tags.
    pub has_data_tags: bool,
}

/// One expression.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ExpressionEntry {
    /// The expression.
    pub text: String,
    /// Its line.
    pub line: u32,
}

/// An element that is known to nobody here.
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
/// It has no such document, or a value that is none of those that there are; the error says which, and where.
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
/// As [`parse`].
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

/// Sets what a grant may say once.
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

/// The value of an element or attribute that says ALLOW or DENY.
///
/// # Errors
/// It says neither.
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

/// The texts of the elements of a name.
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

/// The common name of a certificate's subject: `/arm` of `CN=/arm,O=x`.
pub fn common_name(subject: &str) -> Option<&str> {
    subject.split(',').find_map(|part| part.trim().strip_prefix("CN="))
}
