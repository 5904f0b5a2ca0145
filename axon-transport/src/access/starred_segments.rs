//! The segments with a `*` that may follow in a pattern, found by the text around their stars.
//!
//! A segment that fits begins with the text before the first star and ends with that behind the last one. So patterns that
//! differ in either are not tried, however many there are: one look for each pair of lengths of these texts.

use std::collections::HashMap;

use super::pattern::segment_fits;

/// Segments with a `*`, each with the number of what is behind it.
#[derive(Debug, Default)]
pub(super) struct StarredSegments {
    /// By the lengths of the text before the first star and of that behind the last one, in bytes.
    lengths: Vec<(usize, usize, ByText)>,
}

/// By these texts, one behind the other.
type ByText = HashMap<Box<[u8]>, Vec<(Box<str>, usize)>>;

/// The text before the first star, and that behind the last one.
fn around(segment: &str) -> (&[u8], &[u8]) {
    let bytes = segment.as_bytes();
    let is_star = |byte: &u8| *byte == b'*';
    let first = bytes.iter().position(is_star).unwrap_or(bytes.len());
    let last = bytes.iter().rposition(is_star).map_or(bytes.len(), |last| last + 1);
    (&bytes[..first], &bytes[last..])
}

impl StarredSegments {
    /// What is behind this segment, if it is known.
    pub(super) fn get(&self, segment: &str) -> Option<usize> {
        let (before, behind) = around(segment);
        let by_text =
            self.lengths.iter().find(|(b, a, _)| (*b, *a) == (before.len(), behind.len()));
        let same = by_text?.2.get(&*[before, behind].concat())?;
        same.iter().find(|(known, _)| **known == *segment).map(|(_, next)| *next)
    }

    /// Adds a segment that is not known.
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

    /// Names what is behind each segment that one of a name fits.
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
