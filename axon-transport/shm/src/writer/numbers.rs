//! The numbers of a publisher's samples.

use crate::{error::PublishError, ring::types::Meta};

/// Maximum number of samples by which a remote publisher may be ahead of its last sample here: more than an hour of
/// outage at a million samples a second.
pub const MAX_GAP: u64 = 1 << 32;
/// Maximum number of samples that it may have published before the first one here.
const MAX_FIRST: u64 = 1 << 48;

/// The numbering of a sample.
#[derive(Clone, Copy)]
pub(crate) enum Numbering {
    /// The sample has this number and time.
    Given(Meta),
    /// The next number after the last, with this source timestamp.
    Next(i64),
}

/// The last sample's number, and the number of samples.
#[derive(Debug, Default)]
pub(crate) struct WriterNumbers {
    /// The last sample's sequence number.
    last: u64,
    /// Number of samples published, read or not.
    published: u64,
}

impl WriterNumbers {
    /// Returns the last sample's sequence number.
    pub(super) fn last(&self) -> u64 {
        self.last
    }

    /// Refuses a number from another process or host that would make readers count impossible losses.
    pub(super) fn judge(&self, numbering: Numbering) -> Result<(), PublishError> {
        let Numbering::Given(Meta { sequence, .. }) = numbering else { return Ok(()) };
        let last = self.last;
        let most = if last == 0 { MAX_FIRST } else { last.saturating_add(MAX_GAP) };
        if sequence > most { Err(PublishError::Sequence { sequence, last }) } else { Ok(()) }
    }

    /// Numbers a sample.
    #[inline]
    pub(super) fn number(&mut self, numbering: Numbering) -> Meta {
        let meta = match numbering {
            Numbering::Given(meta) => meta,
            Numbering::Next(source_timestamp) => {
                Meta::at_nanos(self.last.saturating_add(1), source_timestamp)
            }
        };
        self.last = meta.sequence;
        meta
    }

    /// Counts a sample that is published now, read or not. Returns the total.
    #[inline]
    pub(super) fn count(&mut self) -> u64 {
        self.published += 1;
        self.published
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn given(sequence: u64) -> Numbering {
        Numbering::Given(Meta::at_nanos(sequence, 7).with_published_nanos(8))
    }

    #[test]
    fn samples_are_numbered_from_one_or_as_given() {
        let mut numbers = WriterNumbers::default();
        assert_eq!(numbers.number(Numbering::Next(5)).sequence, 1);
        let meta = numbers.number(given(40));
        assert_eq!((meta.sequence, meta.source_nanos, meta.published_nanos), (40, 7, 8));
        assert_eq!(numbers.number(Numbering::Next(5)).sequence, 41);
        assert_eq!(numbers.last(), 41);
        assert_eq!(
            (numbers.count(), numbers.count()),
            (1, 2),
            "not what is numbered, but published"
        );
    }

    #[test]
    fn a_number_that_no_publisher_can_have_reached_is_refused() {
        let mut numbers = WriterNumbers::default();
        assert!(numbers.judge(given(MAX_FIRST)).is_ok());
        assert!(numbers.judge(given(MAX_FIRST + 1)).is_err());
        numbers.number(given(10));
        assert!(numbers.judge(given(10 + MAX_GAP)).is_ok());
        assert!(matches!(
            numbers.judge(given(11 + MAX_GAP)),
            Err(PublishError::Sequence { last: 10, .. })
        ));
        numbers.number(given(u64::MAX));
        assert!(numbers.judge(given(u64::MAX)).is_ok());
        assert!(numbers.judge(Numbering::Next(0)).is_ok());
        assert_eq!(numbers.number(Numbering::Next(0)).sequence, u64::MAX);
    }
}
