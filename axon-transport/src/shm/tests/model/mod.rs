//! The protocols under the model checker: every interleaving, and every reordering that the memory
//! model allows, for small rings and a few threads. Each model names the orderings without which
//! it fails, of which [`super::mutation`] makes sure.
//!
//! The checker runs the loads of a thread in their order. That a read comes before the store that
//! says so therefore shows only where what is read is a [`Cell`], on which it sees any race.

mod lanes;
mod pins;
mod ring;

use loom::sync::{Arc, atomic::AtomicU64};

use super::super::{
    Grant,
    lane::{self, Tenancy},
    layout::LANE_WORDS,
    ring::{Geometry, Place, Record, about_to_write, publish},
};

/// Payload that is read and written like any memory.
struct Cell(loom::cell::UnsafeCell<u64>);

// SAFETY: as below.
unsafe impl Send for Cell {}
// SAFETY: the model checker itself finds any two accesses that are not ordered.
unsafe impl Sync for Cell {}

impl Cell {
    fn new(value: u64) -> Self {
        Self(loom::cell::UnsafeCell::new(value))
    }

    fn get(&self) -> u64 {
        // SAFETY: the checker fails the model if anything writes meanwhile.
        self.0.with(|value| unsafe { *value })
    }

    fn set(&self, to: u64) {
        // SAFETY: the checker fails the model if anything reads or writes meanwhile.
        self.0.with_mut(|value| unsafe { *value = to });
    }
}

fn check(preemptions: usize, model: impl Fn() + Sync + Send + 'static) {
    let mut builder = loom::model::Builder::new();
    builder.preemption_bound = Some(preemptions);
    builder.check(model);
}

fn zeros(count: usize) -> Arc<Vec<AtomicU64>> {
    Arc::new((0..count).map(|_| AtomicU64::new(0)).collect())
}

/// A ring of two slots, whose payload is elsewhere.
fn small() -> (Arc<Vec<AtomicU64>>, Geometry) {
    let geometry = Geometry { head: 0, tail: 1, slots: 2, mask: 1, payload: 34, payload_words: 0 };
    (zeros(34), geometry)
}

/// Publishes a sample whose payload is elsewhere.
fn show(words: &[AtomicU64], geometry: &Geometry, position: u64) {
    let record = Record { sequence: position, timestamp: 0, len: 0, place: Place::Inline };
    about_to_write::<AtomicU64>();
    publish(words, geometry, position, &record, &[]);
}

/// A lane that a reader has opened to take `first` next.
fn granted(first: u64) -> (Arc<Vec<AtomicU64>>, Tenancy) {
    let lane = zeros(LANE_WORDS);
    lane::ask(&lane[..], 1);
    let tenancy = Tenancy::grant(&lane[..]);
    lane::open(&lane[..], Grant { generation: tenancy.generation(), first });
    (lane, tenancy)
}
