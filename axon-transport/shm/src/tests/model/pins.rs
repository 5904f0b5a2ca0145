//! Samples that readers read in place, and memory that the publisher reuses.

use loom::{
    sync::{Arc, atomic::AtomicU64},
    thread,
};

use crate::{
    ring::{
        pins::{about_to_scan, free, pin, unpin},
        protocol::{bounds, retire},
    },
    session::{
        lane::{self, LaneId},
        pin_lanes::{Pinned, scan},
    },
    tests::model::{Cell, Ring, check, granted},
};

/// Returns whether `position`, which is below the tail, may be overwritten.
fn is_free(lane: &[AtomicU64], tenancy: &LaneId, position: u64) -> bool {
    about_to_scan::<AtomicU64>();
    let mut found = Pinned::default();
    found.refresh(|found| _ = scan(tenancy, lane, found));
    !found.keeps(position, 1)
}

/// Reads the next sample from `cursor` on in place, if there is one.
fn take(ring: &Ring, lane: &[AtomicU64], cursor: &mut u64, read: impl Fn(u64)) {
    let (tail, head) = bounds(&ring.header).unwrap();
    *cursor = tail.max(*cursor);
    if *cursor < head && pin(lane, 0, *cursor, ring.tail()) {
        read(*cursor);
        unpin(lane, 0);
        *cursor += 1;
    }
}

/// `ReclaimFence`, `PinFence`, `ScanLoad`, `UnpinStore`: a pinned sample is not overwritten.
#[test]
fn a_sample_that_is_pinned_is_not_written_over() {
    check(3, || {
        let ring = Ring::new();
        let (lane, tenancy) = granted(0);
        let cell = Arc::new(Cell::new(1));
        ring.show(0);
        let publisher = {
            let (ring, lane, cell) = (ring.clone(), lane.clone(), cell.clone());
            thread::spawn(move || {
                retire(&ring.header, 1);
                for _ in 0..2 {
                    if is_free(&lane, &tenancy, 0) {
                        cell.set(2);
                        return ring.show(1);
                    }
                    thread::yield_now();
                }
            })
        };
        let mut cursor = 0;
        for _ in 0..2 {
            take(&ring, &lane, &mut cursor, |position| {
                assert_eq!(cell.get(), position + 1);
            });
        }
        publisher.join().unwrap();
    });
}

/// `PinStore`: the publisher may learn that a sample was read from a later pin in the same record.
#[test]
fn a_record_that_pins_another_sample_says_that_the_last_was_read() {
    check(3, || {
        let ring = Ring::new();
        let (lane, tenancy) = granted(0);
        let cells = Arc::new([Cell::new(1), Cell::new(2)]);
        ring.show(0);
        ring.show(1);
        let publisher = {
            let (ring, lane, cells) = (ring.clone(), lane.clone(), cells.clone());
            thread::spawn(move || {
                retire(&ring.header, 1);
                if is_free(&lane, &tenancy, 0) {
                    cells[0].set(3);
                }
            })
        };
        let mut cursor = 0;
        for _ in 0..2 {
            take(&ring, &lane, &mut cursor, |position| {
                assert_eq!(cells[position as usize].get(), position + 1);
            });
        }
        publisher.join().unwrap();
    });
}

/// `FreeLoad`: one thread drops a sample while another takes the next.
#[test]
fn a_record_that_another_thread_freed_says_that_it_has_read() {
    check(3, || {
        let ring = Ring::new();
        let (lane, tenancy) = granted(0);
        let cell = Arc::new(Cell::new(1));
        ring.show(0);
        ring.show(1);
        assert!(pin(&lane, 0, 0, ring.tail()));
        let holder = {
            let (lane, cell) = (lane.clone(), cell.clone());
            thread::spawn(move || {
                assert_eq!(cell.get(), 1);
                unpin(&lane, 0);
            })
        };
        let publisher = {
            let (ring, lane, cell) = (ring.clone(), lane.clone(), cell.clone());
            thread::spawn(move || {
                retire(&ring.header, 1);
                if is_free(&lane, &tenancy, 0) {
                    cell.set(3);
                }
            })
        };
        if let Some(record) = free(&lane, 1) {
            assert!(pin(&lane, record, 1, ring.tail()));
        }
        holder.join().unwrap();
        publisher.join().unwrap();
    });
}

/// `ReclaimFence`, `PinFence`: a publisher gives up samples behind a reader's cursor, which the reader may still pin.
#[test]
fn a_sample_that_is_kept_beyond_the_cursor_is_not_written_over() {
    check(3, || {
        let ring = Ring::new();
        let (lane, tenancy) = granted(0);
        let cell = Arc::new(Cell::new(1));
        ring.show(0);
        let publisher = {
            let (ring, lane, cell) = (ring.clone(), lane.clone(), cell.clone());
            thread::spawn(move || {
                if tenancy.cursor(&lane[..]) == Some(1) {
                    retire(&ring.header, 1);
                    if is_free(&lane, &tenancy, 0) {
                        cell.set(2);
                    }
                }
            })
        };
        if pin(&lane, 0, 0, ring.tail()) {
            lane::advance(&lane[..], 1);
            assert_eq!(cell.get(), 1);
            unpin(&lane, 0);
        }
        publisher.join().unwrap();
    });
}
