//! Descriptors that move to a larger array, and memory that is added at the same time.

use loom::{
    sync::{Arc, atomic::AtomicU64},
    thread,
};

use crate::{
    ring::{
        layout::{DESCRIPTOR_WORDS, LANE_WORDS, RING_WORDS},
        protocol::{
            PayloadLocation, PositionState, RecordRead, View, about_to_write, array,
            copy_descriptors, publish, replace, retire,
        },
    },
    session::lane,
    sync::{Ordering, Word},
    tests::model::{Cell, check, record, zeros},
};

/// A ring with two arrays: first two descriptors, then four.
#[derive(Clone)]
struct Growing {
    header: Arc<Vec<AtomicU64>>,
    arrays: [Arc<Vec<AtomicU64>>; 2],
}

impl Growing {
    fn new() -> Self {
        let arrays = [zeros(2 * DESCRIPTOR_WORDS), zeros(4 * DESCRIPTOR_WORDS)];
        let ring = Self { header: zeros(RING_WORDS), arrays };
        for position in 0..2 {
            ring.show(0, position);
        }
        ring
    }

    fn show(&self, which: usize, position: u64) {
        about_to_write::<AtomicU64>();
        let record = record(position, PayloadLocation::Inline);
        publish(&self.header, &self.arrays[which], position, &record, &[]);
    }

    fn grow(&self, tail: u64, head: u64) {
        about_to_write::<AtomicU64>();
        copy_descriptors(&self.arrays[0], &self.arrays[1], tail, head);
        replace(&self.header, 1);
    }

    fn view(&self) -> View<'_, AtomicU64> {
        let word = array(&self.header[..]);
        View { ring: &self.header, word, array: &self.arrays[word as usize] }
    }
}

/// `ArrayStore`, `ArrayLoad`: kept samples are found in either array while the ring grows.
#[test]
fn samples_survive_the_growth_of_their_ring() {
    check(3, || {
        let ring = Growing::new();
        let publisher = {
            let ring = ring.clone();
            thread::spawn(move || {
                ring.grow(0, 2);
                ring.show(1, 2);
            })
        };
        for position in 0..2 {
            let view = ring.view();
            assert_eq!(view.state(position), PositionState::Here);
            match view.look(position) {
                RecordRead::Sample(found) => {
                    assert_eq!(found, record(position, PayloadLocation::Inline))
                }
                // The ring moved meanwhile.
                RecordRead::Lapped => {}
                RecordRead::Corrupt(what) => panic!("{what}"),
            }
        }
        publisher.join().unwrap();
    });
}

/// `ReuseFence`, `StandsFence`: data that another ring writes to the memory of the old array is not mistaken for a
/// descriptor.
#[test]
fn an_old_array_that_became_something_else_is_noticed() {
    check(3, || {
        let ring = Growing::new();
        let publisher = {
            let ring = ring.clone();
            thread::spawn(move || {
                ring.grow(0, 2);
                // Through the heap, the memory now belongs to another ring, with positions of its own.
                about_to_write::<AtomicU64>();
                for word in &ring.arrays[0][..DESCRIPTOR_WORDS] {
                    Word::store(word, 2, Ordering::Relaxed);
                }
            })
        };
        let view = ring.view();
        if view.state(0) == PositionState::Here {
            match view.look(0) {
                RecordRead::Sample(found) => assert_eq!(found, record(0, PayloadLocation::Inline)),
                RecordRead::Lapped => {}
                RecordRead::Corrupt(what) => panic!("{what}"),
            }
        }
        publisher.join().unwrap();
    });
}

/// In an array that both see for the first time, a late reader finds that it is late, and a reader that has taken all
/// finds that the next position is not published.
#[test]
fn a_new_array_shows_lapped_and_future_positions() {
    check(2, || {
        let ring = Growing::new();
        retire(&ring.header, 1);
        ring.show(0, 2);
        ring.grow(1, 3);
        let states: Vec<PositionState> =
            (0..6).map(|position| ring.view().state(position)).collect();
        assert!(!matches!(states[0], PositionState::Ahead), "given up, but not to come");
        assert_eq!(states[1..3], [PositionState::Here; 2]);
        assert_eq!(states[3..], [PositionState::Ahead; 3]);
        assert_eq!(ring.view().look(0), RecordRead::Lapped);
    });
}

/// `MappedStore`, `MappedLoad`: the reader finds objects that moved to a segment because it was mapped.
#[test]
fn a_segment_that_is_said_to_be_mapped_is() {
    check(3, || {
        let ring = Growing::new();
        let (lane, table) = (zeros(LANE_WORDS), Arc::new(Cell::new(0)));
        let control = {
            let (lane, table) = (lane.clone(), table.clone());
            thread::spawn(move || {
                table.set(1);
                lane::set_mapped(&lane[..], 1);
            })
        };
        let publisher = {
            let (ring, lane) = (ring.clone(), lane.clone());
            thread::spawn(move || {
                if lane::mapped(&lane[..]) >= 1 {
                    replace(&ring.header, 1);
                }
            })
        };
        if array(&ring.header[..]) == 1 {
            assert_eq!(table.get(), 1);
        }
        control.join().unwrap();
        publisher.join().unwrap();
    });
}
