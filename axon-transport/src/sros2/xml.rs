//! An XML document of limited size and depth, without a DTD: no entity is expanded and nothing is loaded.

use roxmltree::{Document, Node, ParsingOptions};

/// The largest document, in bytes.
pub const LARGEST: u64 = 1 << 20;
/// The deepest element. Policies have eight levels.
const DEEPEST: usize = 16;
/// The longest start tag, in bytes. Attributes are compared with each other, which takes quadratic time.
const LONGEST_TAG: usize = 8192;
/// The most declarations of namespaces, because each element keeps the declarations around it.
const MOST_NAMESPACES: usize = 16;

/// Parses a document.
///
/// # Errors
/// The text is no such document; the error says why.
pub fn parse(text: &str) -> Result<Document<'_>, String> {
    if text.matches("xmlns").count() > MOST_NAMESPACES {
        return Err(format!("more than {MOST_NAMESPACES} declarations of namespaces"));
    }
    let tags = text.split('<').skip(1).filter(|tag| !tag.starts_with(['!', '?']));
    if tags.map(|tag| tag.find('>').unwrap_or(tag.len())).any(|length| length > LONGEST_TAG) {
        return Err(format!("a tag of more than {LONGEST_TAG} bytes"));
    }
    let options = ParsingOptions { allow_dtd: false, nodes_limit: 200_000, ..Default::default() };
    let document = Document::parse_with_options(text, options).map_err(|error| match error {
        roxmltree::Error::DtdDetected => "it has a DTD, which is not accepted".to_owned(),
        error => format!("not XML: {error}"),
    })?;
    let deep = |node: Node<'_, '_>| node.ancestors().take(DEEPEST + 3).count() > DEEPEST + 2;
    if document.descendants().any(deep) {
        return Err(format!("elements deeper than {DEEPEST}"));
    }
    Ok(document)
}

/// The line numbers of a document.
#[derive(Debug)]
pub struct Lines {
    ends: Vec<usize>,
    before: usize,
}

impl Lines {
    /// Creates the line numbers of a document that begins `before` lines after the start of its file.
    pub fn new(text: &str, before: usize) -> Self {
        Self { ends: text.match_indices('\n').map(|(at, _)| at).collect(), before }
    }

    /// Returns the line of an element, counted from 1.
    pub fn of(&self, node: Node<'_, '_>) -> u32 {
        let ended = self.ends.partition_point(|end| *end < node.range().start);
        u32::try_from(self.before + ended + 1).unwrap_or(u32::MAX)
    }
}

/// Returns the child elements of an element.
pub fn elements<'a, 'i>(node: Node<'a, 'i>) -> impl Iterator<Item = Node<'a, 'i>> {
    node.children().filter(Node::is_element)
}

/// Returns the first child element with this name.
pub fn child<'a, 'i>(node: Node<'a, 'i>, name: &str) -> Option<Node<'a, 'i>> {
    elements(node).find(|child| child.tag_name().name() == name)
}

/// Returns the text of an element, without surrounding white space. A comment inside does not split it.
pub fn text(node: Node<'_, '_>) -> String {
    let parts = node.children().filter(Node::is_text).filter_map(|part| part.text());
    parts.collect::<String>().trim().to_owned()
}
