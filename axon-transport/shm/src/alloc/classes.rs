//! The size classes of slots: four for each power of two, in whole pages.
//!
//! Any sample of about the same size can reuse a free slot. At most a quarter of the slot, or a page, is wasted.

/// Slots are multiples of this many bytes.
pub(crate) const PAGE: u64 = 4096;
/// The number of classes; the largest is 4 GiB.
pub(crate) const CLASSES: usize = 76;

/// Returns the class of the smallest slots that hold `len` bytes; `len` is at most 4 GiB.
pub(crate) fn class(len: u64) -> usize {
    let pages = len.max(1).div_ceil(PAGE);
    // One class for each number of pages up to eight. Above, the steps are a quarter of the power of two below.
    let octave = pages.ilog2().saturating_sub(2);
    let quarters = pages.div_ceil(1 << octave) as usize;
    octave as usize * 4 + quarters - 1
}

/// Returns the bytes of a slot of `class`.
pub(crate) fn size(class: usize) -> u64 {
    let octave = (class / 4).saturating_sub(1);
    let quarters = class + 1 - 4 * octave;
    PAGE * ((quarters as u64) << octave)
}

/// Returns the bytes of the slot that `len` bytes take.
pub(crate) fn rounded(len: u64) -> u64 {
    size(class(len))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn classes_are_four_an_octave() {
        let pages: Vec<u64> = (0..16).map(|class| size(class) / PAGE).collect();
        assert_eq!(pages, [1, 2, 3, 4, 5, 6, 7, 8, 10, 12, 14, 16, 20, 24, 28, 32]);
        assert_eq!(size(CLASSES - 1), 1 << 32);
        assert_eq!(class(1 << 32), CLASSES - 1);
        assert_eq!(class(0), 0);
    }

    #[test]
    fn each_size_is_of_its_own_class() {
        for index in 0..CLASSES {
            assert_eq!(class(size(index)), index);
            assert_eq!(class(size(index) - 1), index);
        }
    }

    proptest! {
        #[test]
        fn a_slot_holds_its_sample_and_little_more(len in 1u64..=1 << 32) {
            let slot = rounded(len);
            prop_assert!(slot >= len && slot.is_multiple_of(PAGE));
            prop_assert!(slot - len < PAGE.max(len / 4 + 1), "{len} takes {slot}");
            let class = class(len);
            prop_assert!(class == 0 || size(class - 1) < len, "a smaller class would do");
        }
    }
}
