//! A follower of a journal, which looks only at the rings that the journal names.

use loom::{
    sync::{Arc, Condvar, Mutex, atomic::AtomicU64},
    thread,
};

use crate::{
    ring::journal::{Journal, JournalCursor, RingsToRead},
    sync::{Ordering, Word},
    tests::model::{check, zeros},
    wake::{arm, due, settle},
};

/// The words of a session with two rings, and those of its follower.
#[derive(Clone)]
struct Words {
    noted: Arc<AtomicU64>,
    entries: Arc<Vec<AtomicU64>>,
    rings: Arc<Vec<AtomicU64>>,
    armed: Arc<AtomicU64>,
    rung: Arc<AtomicU64>,
    bell: Arc<(Mutex<bool>, Condvar)>,
}

impl Words {
    fn new() -> Self {
        Self {
            noted: Arc::new(AtomicU64::new(0)),
            entries: zeros(2),
            rings: zeros(2),
            armed: Arc::new(AtomicU64::new(0)),
            rung: Arc::new(AtomicU64::new(0)),
            bell: Arc::new((Mutex::new(false), Condvar::new())),
        }
    }

    fn journal(&self) -> Journal<'_, AtomicU64> {
        Journal { noted: &self.noted, entries: &self.entries }
    }

    fn publish(&self, ring: u32) {
        // Relaxed: only the journal orders the sample.
        Word::store(&self.rings[ring as usize], 1, Ordering::Relaxed);
        self.journal().note(ring);
        settle::<AtomicU64>();
        if due(&*self.armed, &*self.rung) {
            *self.bell.0.lock().unwrap() = true;
            self.bell.1.notify_one();
        }
    }

    /// Sleeps and checks until there is a sample in each ring.
    fn follow(&self) {
        let (mut place, mut found) = (JournalCursor::end(self.journal()), [false; 2]);
        // All rings have to be checked first, as for a reader that was just attached.
        let mut all = true;
        let mut ticket = 0;
        loop {
            ticket += 1;
            arm(&*self.armed, ticket);
            let mut named = Vec::new();
            all |= place.read(self.journal(), |ring| named.push(ring)) == RingsToRead::All;
            for ring in 0..2 {
                if all || named.contains(&ring) {
                    let sample = Word::load(&self.rings[ring as usize], Ordering::Relaxed);
                    found[ring as usize] |= sample == 1;
                }
            }
            all = false;
            if found == [true; 2] {
                return;
            }
            let mut rung = self.bell.0.lock().unwrap();
            while !*rung {
                // The model fails here if no thread is left to ring.
                rung = self.bell.1.wait(rung).unwrap();
            }
            *rung = false;
        }
    }
}

/// `NotedAdd`, `NotedLoad`: a follower that sees the count finds the sample; a follower that does
/// not see it is woken.
#[test]
fn a_follower_finds_each_sample_in_the_rings_that_are_named() {
    check(3, || {
        let words = Words::new();
        let publisher = {
            let words = words.clone();
            thread::spawn(move || (0..2).for_each(|ring| words.publish(ring)))
        };
        words.follow();
        publisher.join().unwrap();
    });
}

/// An entry that another thread has counted but not stored names no ring, and hides none.
#[test]
fn a_follower_finds_entries_that_threads_note_concurrently() {
    check(2, || {
        let words = Words::new();
        let publishers = [0, 1].map(|ring| {
            let words = words.clone();
            thread::spawn(move || words.publish(ring))
        });
        words.follow();
        publishers.into_iter().for_each(|publisher| publisher.join().unwrap());
    });
}
