//! The counters of a subscription.

/// The sample counters of a subscription. The caller passes the counts of the attached readers as `attached`.
#[derive(Default)]
pub(super) struct Counts {
    /// Samples that were taken.
    pub(super) received: u64,
    /// Samples that were older than their lifespan.
    pub(super) expired: u64,
    /// Losses that no attached reader counts.
    lost: u64,
    /// Losses that were reported.
    reported: u64,
    /// Samples that came from writers that are gone.
    arrived: u64,
    /// All samples that were announced to the callback.
    announced: u64,
}

impl Counts {
    /// Counts losses that no attached reader counts.
    pub(super) fn add_lost(&mut self, samples: u64) {
        self.lost = self.lost.saturating_add(samples);
    }

    /// Takes over the counts of a reader that is given up.
    pub(super) fn retire(&mut self, lost: u64, arrived: u64) {
        self.add_lost(lost);
        self.arrived += arrived;
    }

    /// Returns all losses.
    pub(super) fn losses(&self, attached: u64) -> u64 {
        self.lost.saturating_add(attached)
    }

    /// Returns whether there are losses to report, or fewer losses than were reported.
    pub(super) fn has_new_losses(&self, attached: u64) -> bool {
        self.losses(attached) != self.reported
    }

    /// Returns the losses since the last call.
    pub(super) fn new_losses(&mut self, attached: u64) -> u64 {
        let losses = self.losses(attached);
        losses.saturating_sub(std::mem::replace(&mut self.reported, losses))
    }

    /// Returns the samples that came since the last call.
    pub(super) fn new_arrivals(&mut self, attached: u64) -> u64 {
        let arrived = self.arrived + attached;
        // The sum can fall: the count of a writer is lost when its memory is corrupt.
        arrived.saturating_sub(std::mem::replace(&mut self.announced, arrived))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_loss_is_reported_once_whether_its_reader_is_attached_or_gone() {
        let mut counts = Counts::default();
        assert_eq!((counts.new_losses(3), counts.has_new_losses(3)), (3, false));
        counts.retire(3, 10);
        assert!(!counts.has_new_losses(0), "the reader that counted them is gone");
        counts.add_lost(2);
        assert!(counts.has_new_losses(0));
        assert_eq!((counts.new_losses(1), counts.losses(1)), (3, 6));
        counts.add_lost(u64::MAX);
        assert_eq!(counts.losses(u64::MAX), u64::MAX, "it does not wrap");
    }

    #[test]
    fn arrivals_of_a_reader_whose_numbers_are_gone_are_no_new_ones() {
        let mut counts = Counts::default();
        assert_eq!(counts.new_arrivals(7), 7);
        assert_eq!(counts.new_arrivals(2), 0, "its memory is corrupt");
        counts.retire(0, 2);
        assert_eq!((counts.new_arrivals(1), counts.new_arrivals(4)), (1, 3));
    }
}
