//! Samples that are copied out, by readers that are overtaken and by such that hold the publisher.

use loom::{
    sync::{Arc, atomic::AtomicU64},
    thread,
};

use super::{
    super::super::{
        lane,
        ring::{
            Geometry, Look, Place, Record, about_to_write, bounds, copy_in, data, look, publish,
            retire, stands,
        },
        sync::{Ordering, Word},
    },
    Cell, check, granted, small,
};

const SLOTS: usize = 2;
const GEOMETRY: Geometry =
    Geometry { head: 0, tail: 1, slots: 2, mask: 1, payload: 34, payload_words: 4 };

fn words() -> Arc<Vec<AtomicU64>> {
    Arc::new((0..38).map(|_| AtomicU64::new(0)).collect())
}

fn record(position: u64) -> Record {
    let place = Place::At(position % 2 * 16);
    Record { sequence: 10 + position, timestamp: 0, len: 16, place }
}

fn write(words: &[AtomicU64], position: u64) {
    about_to_write::<AtomicU64>();
    let byte = position as u8 + 1;
    let place = GEOMETRY.payload(words, position % 2 * 16, 16).unwrap();
    copy_in(place, &[byte; 16]);
    publish(words, &GEOMETRY, position, &record(position), &[]);
}

/// What a reader that stands at `cursor` finds there: `Ok(true)` for a whole sample.
fn read(words: &[AtomicU64], cursor: u64) -> bool {
    match look(words, &GEOMETRY, cursor) {
        Look::Lapped => false,
        Look::Corrupt(what) => panic!("{what}"),
        Look::Sample(found) => {
            let payload: Vec<u64> = data(words, &GEOMETRY, cursor, &found)
                .unwrap()
                .iter()
                .map(|word| Word::load(word, Ordering::Relaxed))
                .collect();
            if !stands(words, &GEOMETRY, cursor) {
                return false;
            }
            assert_eq!(found, record(cursor));
            assert_eq!(payload, [u64::from_ne_bytes([cursor as u8 + 1; 8]); 2]);
            true
        }
    }
}

/// `HeadStore`, `HeadLoad`, `ReuseFence`, `StandsFence`.
#[test]
fn a_reader_takes_whole_samples_or_none_while_it_is_overtaken() {
    check(3, || {
        let words = words();
        write(&words, 0);
        let shared = words.clone();
        let publisher = thread::spawn(move || {
            for position in 1..3u64 {
                let tail = (position + 1).saturating_sub(SLOTS as u64);
                if tail > 0 {
                    retire(&shared, &GEOMETRY, tail);
                }
                write(&shared, position);
            }
        });
        let mut cursor = 0;
        for _ in 0..3 {
            let (tail, head) = bounds(&words, &GEOMETRY).unwrap();
            assert!(tail <= head);
            cursor = cursor.max(tail);
            if cursor < head && read(&words, cursor) {
                cursor += 1;
            }
        }
        publisher.join().unwrap();
    });
}

/// `CursorStore`, `CursorLoad`.
#[test]
fn a_publisher_that_waits_for_the_cursor_overwrites_nothing_unread() {
    check(3, || {
        let (words, geometry) = small();
        let (lane, tenancy) = granted(0);
        let cells: Arc<[Cell; 2]> = Arc::new([Cell::new(0), Cell::new(0)]);
        cells[0].set(1);
        super::show(&words, &geometry, 0);
        let publisher = {
            let (words, lane, cells) = (words.clone(), lane.clone(), cells.clone());
            thread::spawn(move || {
                for position in 1..3u64 {
                    let tail = (position + 1).saturating_sub(SLOTS as u64);
                    while tenancy.cursor(&lane[..]).expect("an open lane") < tail {
                        thread::yield_now();
                    }
                    if tail > 0 {
                        retire(&words[..], &geometry, tail);
                    }
                    cells[(position % 2) as usize].set(position + 1);
                    super::show(&words, &geometry, position);
                }
            })
        };
        for position in 0..2 {
            while bounds(&words[..], &geometry).unwrap().1 <= position {
                thread::yield_now();
            }
            assert_eq!(cells[position as usize].get(), position + 1, "nothing unread was given up");
            lane::advance(&lane[..], position + 1);
        }
        publisher.join().unwrap();
    });
}

/// `TailStore`, `TailLoad`.
#[test]
fn a_reader_never_sees_a_tail_above_the_head() {
    check(3, || {
        let words = words();
        let shared = words.clone();
        let publisher = thread::spawn(move || {
            write(&shared, 0);
            write(&shared, 1);
            retire(&shared, &GEOMETRY, 2);
        });
        bounds(&words, &GEOMETRY).unwrap();
        publisher.join().unwrap();
    });
}
