//! Reports keys for which the two KMEs returned different bytes.

use std::{fmt, time::Duration};

use axon_envelope::KeyId;

/// Minimum time between two reports.
const REPORT_EVERY: Duration = Duration::from_secs(10);

/// A report that the peer holds other keys under the same key_IDs.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Disagreement {
    /// The key_ID of the last such key.
    pub key_id: KeyId,
    /// The number of such keys since the last report.
    pub keys: u64,
}

impl fmt::Display for Disagreement {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "key_ID {}", self.key_id)?;
        match self.keys {
            0 | 1 => Ok(()),
            keys => write!(f, " and {} more since the last report", keys - 1),
        }
    }
}

/// The keys that have to be reported.
#[derive(Default)]
pub(super) struct Disagreements {
    pending: Option<Disagreement>,
    reported: Option<Duration>,
}

impl Disagreements {
    pub(super) fn add(&mut self, key_id: KeyId) {
        let keys = self.pending.take().map_or(0, |pending| pending.keys) + 1;
        self.pending = Some(Disagreement { key_id, keys });
    }

    pub(super) fn take(&mut self, now: Duration) -> Option<Disagreement> {
        let due = self.reported.is_none_or(|at| now.saturating_sub(at) >= REPORT_EVERY);
        let report = self.pending.take_if(|_| due)?;
        self.reported = Some(now);
        Some(report)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn id(text: &str) -> KeyId {
        KeyId::new(text).unwrap()
    }

    #[test]
    fn reports_are_ten_seconds_apart_and_count_disagreements_in_between() {
        let s = Duration::from_secs;
        let mut disagreements = Disagreements::default();
        assert_eq!(disagreements.take(s(5)), None);
        disagreements.add(id("a"));
        let report = disagreements.take(s(5)).unwrap();
        assert_eq!(report.to_string(), "key_ID a");
        for key_id in ["b", "c", "d"] {
            disagreements.add(id(key_id));
        }
        assert_eq!(disagreements.take(s(14)), None);
        let report = disagreements.take(s(15)).unwrap();
        assert_eq!(report.to_string(), "key_ID d and 2 more since the last report");
        assert_eq!(disagreements.take(s(60)), None);
    }
}
