//! The ring's protocol under the model checker: every interleaving and every reordering that the
//! memory model allows, for a small ring.

use loom::{
    sync::{Arc, atomic::AtomicU64},
    thread,
};

use super::super::{
    ring::{
        Geometry, Look, Place, Record, about_to_write, bounds, copy_in, data, look, publish,
        retire, stands,
    },
    sync::{Ordering, Word},
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

fn check(preemptions: usize, model: impl Fn() + Sync + Send + 'static) {
    let mut builder = loom::model::Builder::new();
    builder.preemption_bound = Some(preemptions);
    builder.check(model);
}

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

#[test]
fn a_publisher_that_waits_for_the_cursor_overwrites_nothing_unread() {
    check(3, || {
        let words = words();
        let cursor = Arc::new(AtomicU64::new(0));
        write(&words, 0);
        let (shared, seen) = (words.clone(), cursor.clone());
        let publisher = thread::spawn(move || {
            for position in 1..3u64 {
                let tail = (position + 1).saturating_sub(SLOTS as u64);
                while seen.load(Ordering::Acquire) < tail {
                    thread::yield_now();
                }
                if tail > 0 {
                    retire(&shared, &GEOMETRY, tail);
                }
                write(&shared, position);
            }
        });
        for position in 0..2 {
            loop {
                let (_, head) = bounds(&words, &GEOMETRY).unwrap();
                if position < head {
                    break;
                }
                thread::yield_now();
            }
            assert!(read(&words, position), "nothing that was unread was given up");
            cursor.store(position + 1, Ordering::Release);
        }
        publisher.join().unwrap();
    });
}

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
