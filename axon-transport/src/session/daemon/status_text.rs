//! A status that the daemon sends in parts.

use crate::wire::session::StatusPart;

/// The parts of a status that have arrived.
#[derive(Debug, Default)]
pub(in crate::session) struct StatusText {
    text: Vec<u8>,
    next: u32,
}

/// Maximum length of a status in bytes.
const MAX_STATUS: usize = 64 << 20;

impl StatusText {
    /// Adds the next part. Returns the whole status if this was the last part. The first part may come again, for a
    /// caller that asks again; any other part belongs to an answer that no caller waits for any more.
    pub(in crate::session) fn add(&mut self, part: &StatusPart) -> Option<Vec<u8>> {
        if part.part == 0 {
            *self = Self::default();
        }
        if part.part != self.next || self.text.len() + part.text.len() > MAX_STATUS {
            return None;
        }
        self.text.extend_from_slice(&part.text);
        self.next += 1;
        (self.next >= part.parts).then(|| std::mem::take(&mut self.text))
    }
}

/// The answer to a request for the status.
#[derive(Debug, Default)]
pub(in crate::session) enum StatusAnswer {
    #[default]
    None,
    Parts(StatusText),
    Whole(Vec<u8>),
    Lost,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_status_is_put_together_of_its_own_parts_only() {
        let mut status = StatusText::default();
        let mut add =
            |part, text: &[u8]| status.add(&StatusPart { part, parts: 3, text: text.into() });
        assert_eq!(add(2, b"the end of another"), None);
        assert_eq!(add(0, b"first"), None);
        assert_eq!(add(2, b"one was lost"), None);
        assert_eq!(add(0, b"a"), None, "it begins again");
        assert_eq!(add(1, b"b"), None);
        assert_eq!(add(2, b"c"), Some(b"abc".to_vec()));
    }
}
