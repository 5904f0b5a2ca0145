//! An index of the segments with a `*` that may follow in a pattern, by the text around their stars.
//!
//! A segment that fits begins with the text before the first star, and ends with the text after the last star.
//! Patterns that differ in either text are therefore not tried, whatever their number. A search makes one lookup for
//! each pair of lengths of the two texts.

use std::collections::HashMap;

use super::pattern::segment_fits;

/// Segments with a `*`, each with the number of the node that follows it.
#[derive(Debug, Default)]
pub(super) struct StarredSegments {
    /// Segments by the lengths, in bytes, of the text before the first star and of the text after the last star.
    lengths: Vec<(usize, usize, ByText)>,
}

/// Segments by the two texts, joined.
type ByText = HashMap<Box<[u8]>, Vec<(Box<str>, usize)>>;

/// Returns the text before the first star and the text after the last star.
fn around(segment: &str) -> (&[u8], &[u8]) {
    let bytes = segment.as_bytes();
    let is_star = |byte: &u8| *byte == b'*';
    let first = bytes.iter().position(is_star).unwrap_or(bytes.len());
    let last = bytes.iter().rposition(is_star).map_or(bytes.len(), |last| last + 1);
    (&bytes[..first], &bytes[last..])
}

impl StarredSegments {
    /// Returns the node that follows this segment, if the segment is known.
    pub(super) fn get(&self, segment: &str) -> Option<usize> {
        let (before, behind) = around(segment);
        let by_text =
            self.lengths.iter().find(|(b, a, _)| (*b, *a) == (before.len(), behind.len()));
        let same = by_text?.2.get(&*[before, behind].concat())?;
        same.iter().find(|(known, _)| **known == *segment).map(|(_, next)| *next)
    }

    /// Adds a segment that is not yet known.
    pub(super) fn insert(&mut self, segment: &str, next: usize) {
        let (before, behind) = around(segment);
        let lengths = (before.len(), behind.len());
        let known = self.lengths.iter().position(|(b, a, _)| (*b, *a) == lengths);
        let at = known.unwrap_or_else(|| {
            self.lengths.push((lengths.0, lengths.1, ByText::new()));
            self.lengths.len() - 1
        });
        let text = [before, behind].concat().into_boxed_slice();
        self.lengths[at].2.entry(text).or_default().push((segment.into(), next));
    }

    /// Calls `each` with the node that follows each segment of a pattern which fits a segment of a name.
    pub(super) fn each_fit(&self, name: &str, mut each: impl FnMut(usize)) {
        let bytes = name.as_bytes();
        let mut text = Vec::new();
        for (before, behind, by_text) in &self.lengths {
            if before + behind > bytes.len() {
                continue;
            }
            text.clear();
            text.extend_from_slice(&bytes[..*before]);
            text.extend_from_slice(&bytes[bytes.len() - behind..]);
            let segments = by_text.get(&*text).into_iter().flatten();
            segments.filter(|(star, _)| segment_fits(star, name)).for_each(|(_, next)| each(*next));
        }
    }
}
