//! Samples that readers copy out: readers that are overtaken, and readers that hold the publisher back.

use loom::{
    sync::{Arc, atomic::AtomicU64},
    thread,
};

use crate::{
    ring::{
        layout::Location,
        protocol::{
            PayloadLocation, PositionState, RecordRead, about_to_write, bounds, copy_in, retire,
        },
    },
    session::lane,
    sync::{Ordering, Word},
    tests::model::{Cell, Ring, check, granted, record, zeros},
};

const DESCRIPTORS: u64 = 2;

fn place(position: u64) -> PayloadLocation {
    PayloadLocation::Block(Location { segment: 0, offset: position % 2 * 16 })
}

/// Returns the block of a position: two words, for every other sample.
fn block(blocks: &[AtomicU64], position: u64) -> &[AtomicU64] {
    let start = (position % 2) as usize * 2;
    &blocks[start..start + 2]
}

fn write(ring: &Ring, blocks: &[AtomicU64], position: u64) {
    about_to_write::<AtomicU64>();
    copy_in(block(blocks, position), &[position as u8 + 1; 16]);
    ring.publish(position, place(position));
}

/// Reads the sample at `cursor`. Returns whether it was read whole.
fn read(ring: &Ring, blocks: &[AtomicU64], cursor: u64) -> bool {
    match ring.view().look(cursor) {
        RecordRead::Lapped => false,
        RecordRead::Corrupt(what) => panic!("{what}"),
        RecordRead::Sample(found) => {
            let payload: Vec<u64> = block(blocks, cursor)
                .iter()
                .map(|word| Word::load(word, Ordering::Relaxed))
                .collect();
            if !ring.view().stands(cursor) {
                return false;
            }
            assert_eq!(found, record(cursor, place(cursor)));
            assert_eq!(payload, [u64::from_ne_bytes([cursor as u8 + 1; 8]); 2]);
            true
        }
    }
}

fn overtake(ring: &Ring, blocks: &[AtomicU64]) {
    for position in 1..3u64 {
        let tail = (position + 1).saturating_sub(DESCRIPTORS);
        if tail > 0 {
            retire(&ring.header, tail);
        }
        write(ring, blocks, position);
    }
}

/// `StampStore`, `StampLoad`, `ReuseFence`, `StandsFence`: a reader that reads only stamps takes whole samples or none.
#[test]
fn a_reader_takes_whole_samples_or_none_while_it_is_overtaken() {
    check(3, || {
        let (ring, blocks) = (Ring::new(), zeros(4));
        write(&ring, &blocks, 0);
        let publisher = {
            let (ring, blocks) = (ring.clone(), blocks.clone());
            thread::spawn(move || overtake(&ring, &blocks))
        };
        let mut cursor = 0;
        for _ in 0..3 {
            match ring.view().state(cursor) {
                PositionState::Here if read(&ring, &blocks, cursor) => cursor += 1,
                PositionState::Here | PositionState::Gone => {
                    let (tail, head) = bounds(&ring.header).unwrap();
                    assert!(tail <= head);
                    cursor = cursor.max(tail);
                }
                PositionState::Ahead => {}
            }
        }
        publisher.join().unwrap();
    });
}

/// `HeadStore`, `HeadLoad`: all samples below the head are published.
#[test]
fn the_head_is_never_ahead_of_the_stamps() {
    check(3, || {
        let ring = Ring::new();
        let publisher = {
            let ring = ring.clone();
            thread::spawn(move || (0..2).for_each(|position| ring.show(position)))
        };
        let (_, head) = bounds(&ring.header).unwrap();
        for position in 0..head {
            assert_eq!(ring.view().state(position), PositionState::Here);
        }
        publisher.join().unwrap();
    });
}

/// `CursorStore`, `CursorLoad`: a publisher that waits for the cursor overwrites no unread sample.
#[test]
fn a_publisher_that_waits_for_the_cursor_overwrites_nothing_unread() {
    check(3, || {
        let ring = Ring::new();
        let (lane, tenancy) = granted(0);
        let cells: Arc<[Cell; 2]> = Arc::new([Cell::new(0), Cell::new(0)]);
        cells[0].set(1);
        ring.show(0);
        let publisher = {
            let (ring, lane, cells) = (ring.clone(), lane.clone(), cells.clone());
            thread::spawn(move || {
                for position in 1..3u64 {
                    let tail = (position + 1).saturating_sub(DESCRIPTORS);
                    while tenancy.cursor(&lane[..]).expect("an open lane") < tail {
                        thread::yield_now();
                    }
                    if tail > 0 {
                        retire(&ring.header, tail);
                    }
                    cells[(position % 2) as usize].set(position + 1);
                    ring.show(position);
                }
            })
        };
        for position in 0..2 {
            while ring.view().state(position) == PositionState::Ahead {
                thread::yield_now();
            }
            assert_eq!(cells[position as usize].get(), position + 1, "nothing unread was given up");
            lane::advance(&lane[..], position + 1);
        }
        publisher.join().unwrap();
    });
}

/// `TailStore`, `TailLoad`: a reader never sees a tail above the head.
#[test]
fn a_reader_never_sees_a_tail_above_the_head() {
    check(3, || {
        let ring = Ring::new();
        let publisher = {
            let ring = ring.clone();
            thread::spawn(move || {
                (0..2).for_each(|position| ring.show(position));
                retire(&ring.header, 2);
            })
        };
        bounds(&ring.header).unwrap();
        publisher.join().unwrap();
    });
}
