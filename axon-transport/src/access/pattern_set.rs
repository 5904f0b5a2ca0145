//! Matches a name with many patterns. The time does not grow with their number.

use std::collections::HashMap;

use super::{pattern::TopicPattern, starred_segments::StarredSegments};

/// Patterns, each with its line, as a tree of their segments.
#[derive(Debug)]
pub(super) struct PatternSet {
    /// The nodes of the tree. The first is the root.
    nodes: Vec<PatternNode>,
}

#[derive(Debug, Default)]
struct PatternNode {
    /// The next nodes for segments of plain text.
    literal: HashMap<Box<str>, usize>,
    /// The next nodes for segments with a `*`.
    starred: StarredSegments,
    /// The next node for the segment `**`.
    any: Option<usize>,
    /// True if the node follows `**`, which takes any number of segments.
    stays: bool,
    /// The first line with a pattern that ends here.
    line: Option<u32>,
}

impl Default for PatternSet {
    fn default() -> Self {
        Self { nodes: vec![PatternNode::default()] }
    }
}

impl PatternSet {
    pub(super) fn insert(&mut self, pattern: &TopicPattern, line: u32) {
        let mut at = 0;
        for segment in pattern.segments() {
            at = self.child(at, segment);
        }
        let first = &mut self.nodes[at].line;
        *first = Some(first.map_or(line, |first| first.min(line)));
    }

    pub(super) fn is_empty(&self) -> bool {
        self.nodes.len() == 1
    }

    /// Returns whether one pattern fits each name of ROS 2: `**` or `/**`.
    pub(super) fn fits_all(&self) -> bool {
        let any = |node: &PatternNode| node.any.is_some_and(|any| self.nodes[any].line.is_some());
        let [root, ..] = &self.nodes[..] else { return false };
        any(root) || root.literal.get("").is_some_and(|slash| any(&self.nodes[*slash]))
    }

    /// Returns the node for a segment after a node. Adds it if there is none.
    fn child(&mut self, at: usize, segment: &str) -> usize {
        let node = &self.nodes[at];
        let known = match segment {
            "**" => node.any,
            _ if segment.contains('*') => node.starred.get(segment),
            _ => node.literal.get(segment).copied(),
        };
        if let Some(known) = known {
            return known;
        }
        let next = self.nodes.len();
        self.nodes.push(PatternNode { stays: segment == "**", ..PatternNode::default() });
        let node = &mut self.nodes[at];
        match segment {
            "**" => node.any = Some(next),
            _ if segment.contains('*') => node.starred.insert(segment, next),
            _ => drop(node.literal.insert(segment.into(), next)),
        }
        next
    }

    /// Returns the first line with a pattern that fits a name.
    pub(super) fn first_fit(&self, name: &str) -> Option<u32> {
        if self.is_empty() {
            return None;
        }
        let (mut at, mut next) = (Vec::new(), Vec::new());
        self.enter(&mut at, 0);
        for segment in name.split('/') {
            for node in at.drain(..) {
                let PatternNode { literal, starred, stays, .. } = &self.nodes[node];
                if *stays {
                    self.enter(&mut next, node);
                }
                if let Some(child) = literal.get(segment) {
                    self.enter(&mut next, *child);
                }
                starred.each_fit(segment, |child| self.enter(&mut next, child));
            }
            std::mem::swap(&mut at, &mut next);
            if at.is_empty() {
                return None;
            }
        }
        at.iter().filter_map(|node| self.nodes[*node].line).min()
    }

    /// Records that a node is reached, and with it the node after a `**` that takes no segment.
    fn enter(&self, at: &mut Vec<usize>, node: usize) {
        let mut reached = Some(node);
        while let Some(node) = reached.filter(|node| !at.contains(node)) {
            at.push(node);
            reached = self.nodes[node].any;
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn segments() -> impl Strategy<Value = String> {
        let segment = prop_oneof![
            Just("**"),
            Just("*"),
            Just("a"),
            Just("b"),
            Just("a*"),
            Just("*b"),
            Just("a*b"),
            Just("ab*a"),
            Just("a*b*a"),
            Just("\u{e9}*"),
            Just("*\u{e9}a"),
        ];
        prop::collection::vec(segment, 1..5).prop_map(|all| format!("/{}", all.join("/")))
    }

    fn names() -> impl Strategy<Value = String> {
        let segment = prop_oneof![
            Just("a"),
            Just("b"),
            Just("ab"),
            Just("aba"),
            Just("abba"),
            Just("\u{e9}"),
            Just("\u{e9}a"),
            Just(""),
        ];
        let absolute =
            prop::collection::vec(segment, 1..6).prop_map(|all| format!("/{}", all.join("/")));
        prop_oneof![absolute, Just(String::new()), Just("a".to_owned()), Just("/".to_owned())]
    }

    proptest! {
        #[test]
        fn the_first_line_that_fits_is_that_of_patterns_tried_one_by_one(
            patterns in prop::collection::vec(segments(), 0..12),
            all in prop::bool::weighted(0.1),
            name in names(),
        ) {
            let mut patterns: Vec<_> =
                patterns.iter().map(|text| TopicPattern::new(text).unwrap()).collect();
            patterns.extend(all.then(|| TopicPattern::new("**").unwrap()));
            let mut set = PatternSet::default();
            for (line, pattern) in (1..).zip(&patterns) {
                set.insert(pattern, line);
            }
            let expected = (1..).zip(&patterns).find(|(_, pattern)| pattern.fits(&name));
            prop_assert_eq!(set.first_fit(&name), expected.map(|(line, _)| line));
        }
    }

    #[test]
    fn many_patterns_that_all_fit_take_no_long_time() {
        let mut set = PatternSet::default();
        let text = format!("/{}b", "**/*a*/".repeat(140));
        set.insert(&TopicPattern::new(&text).unwrap(), 1);
        assert_eq!(set.first_fit(&"/aaaaaaaa".repeat(10_000)), None);
    }
}
