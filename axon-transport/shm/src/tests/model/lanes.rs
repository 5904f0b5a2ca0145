//! Readers that attach and leave, and lanes that pass from one reader to another.

use loom::{sync::Arc, thread};

use crate::{
    alloc::pin_limit::PinLimit,
    ring::{
        layout::{LANE_WORDS, lane::CURSOR},
        pins::{about_to_scan, pin, unpin},
        protocol::retire,
        types::Grant,
    },
    session::{
        lane::{self, LaneId, LaneState},
        pin_lanes::{Pinned, scan},
    },
    sync::{Ordering, Word},
    tests::model::{Cell, Ring, check, granted, zeros},
};

/// `OpenStore`, `GenerationLoad`: the cursor of the lane's last reader is not mistaken for this reader's.
#[test]
fn a_lane_that_is_open_shows_the_cursor_of_its_reader() {
    check(3, || {
        let lane = zeros(LANE_WORDS);
        Word::store(&lane[CURSOR], 9, Ordering::Relaxed);
        lane::ask(&lane[..], 1);
        let tenancy = LaneId::grant(&lane[..], PinLimit::ALL);
        let reader = {
            let lane = lane.clone();
            thread::spawn(move || {
                lane::open(&lane[..], Grant { generation: tenancy.generation(), first: 3 });
                lane::advance(&lane[..], 4);
            })
        };
        match tenancy.cursor(&lane[..]) {
            None => assert_ne!(tenancy.standing(&lane[..]), LaneState::Left),
            Some(cursor) => assert!((3..=4).contains(&cursor)),
        }
        reader.join().unwrap();
    });
}

/// `CursorStore`, `CursorLoad`: given-up samples are counted once the cursor has passed them, and only for their own
/// publisher.
#[test]
fn given_up_samples_are_counted_before_the_cursor_passes() {
    check(3, || {
        let (lane, tenancy) = granted(0);
        let reader = {
            let lane = lane.clone();
            thread::spawn(move || {
                lane::give_up(&lane[..], tenancy.generation(), 2);
                lane::advance(&lane[..], 5);
                lane::close(&lane[..]);
                lane::ask(&lane[..], 2);
                let next = LaneId::grant(&lane[..], PinLimit::ALL).generation();
                lane::open(&lane[..], Grant { generation: next, first: 0 });
                lane::give_up(&lane[..], next, 7);
            })
        };
        let cursor = tenancy.cursor(&lane[..]);
        let given_up = tenancy.given_up(&lane[..]);
        match cursor {
            // The lane may belong to another reader by now.
            Some(5) => assert!([Some(2), None].contains(&given_up), "{given_up:?}"),
            _ => assert!([Some(0), Some(2), None].contains(&given_up), "{given_up:?}"),
        }
        reader.join().unwrap();
    });
}

/// `CloseStore`, `AskStore`, `GenerationLoad`: a publisher that sees a lane closed need not scan its pins.
#[test]
fn a_reader_that_has_left_has_read_all() {
    check(3, || {
        let ring = Ring::new();
        let (lane, tenancy) = granted(0);
        let cell = Arc::new(Cell::new(1));
        ring.show(0);
        let reader = {
            let (ring, lane, cell) = (ring.clone(), lane.clone(), cell.clone());
            thread::spawn(move || {
                if pin(&lane[..], 0, 0, ring.tail()) {
                    assert_eq!(cell.get(), 1);
                    unpin(&lane[..], 0);
                }
                lane::close(&lane[..]);
                // The next reader uses the lane, for another ring.
                lane::ask(&lane[..], 2);
            })
        };
        retire(&ring.header, 1);
        about_to_scan::<loom::sync::atomic::AtomicU64>();
        if scan(&tenancy, &lane[..], &mut Pinned::default()) == LaneState::Left {
            cell.set(2);
        }
        reader.join().unwrap();
    });
}

/// The fences of pins also cover the time before the publisher knows that the reader has seen its
/// grant.
#[test]
fn a_reader_that_opens_its_lane_and_pins_is_seen() {
    check(3, || {
        let ring = Ring::new();
        let lane = zeros(LANE_WORDS);
        lane::ask(&lane[..], 1);
        let tenancy = LaneId::grant(&lane[..], PinLimit::ALL);
        let cell = Arc::new(Cell::new(1));
        ring.show(0);
        let reader = {
            let (ring, lane, cell) = (ring.clone(), lane.clone(), cell.clone());
            thread::spawn(move || {
                lane::open(&lane[..], Grant { generation: tenancy.generation(), first: 0 });
                if pin(&lane[..], 0, 0, ring.tail()) {
                    assert_eq!(cell.get(), 1);
                    unpin(&lane[..], 0);
                }
            })
        };
        retire(&ring.header, 1);
        about_to_scan::<loom::sync::atomic::AtomicU64>();
        let mut found = Pinned::default();
        found.refresh(|found| _ = scan(&tenancy, &lane[..], found));
        if !found.keeps(0, 1) {
            cell.set(2);
        }
        reader.join().unwrap();
    });
}
