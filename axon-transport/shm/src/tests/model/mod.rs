//! The protocols under the model checker: every interleaving, and every reordering that the memory model allows, for
//! small rings and a few threads. Each model names the orderings without which it fails, and [`super::mutation`]
//! checks that.
//!
//! The checker runs the loads of a thread in their order. So a read that must come before a later store is checked
//! only if it reads a [`Cell`], on which the checker detects any race.

#![allow(unsafe_code)]

mod growth;
mod journal;
mod lanes;
mod lock;
mod pins;
mod ring;

use loom::sync::{Arc, atomic::AtomicU64};

use crate::{
    alloc::pin_limit::PinLimit,
    ring::{
        layout::{DESCRIPTOR_WORDS, LANE_WORDS, RING_WORDS, ring::TAIL},
        protocol::{PayloadLocation, Record, View, about_to_write, publish},
        types::Grant,
    },
    session::lane::{self, LaneId},
};

/// A payload that is read and written without atomics.
struct Cell(loom::cell::UnsafeCell<u64>);

// SAFETY: see `Sync` below.
unsafe impl Send for Cell {}
// SAFETY: the model checker itself detects any two accesses that are not ordered.
unsafe impl Sync for Cell {}

impl Cell {
    fn new(value: u64) -> Self {
        Self(loom::cell::UnsafeCell::new(value))
    }

    fn get(&self) -> u64 {
        // SAFETY: the checker fails the model if another thread writes meanwhile.
        self.0.with(|value| unsafe { *value })
    }

    fn set(&self, to: u64) {
        // SAFETY: the checker fails the model if another thread reads or writes meanwhile.
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

/// A ring and its descriptors.
#[derive(Clone)]
struct Ring {
    header: Arc<Vec<AtomicU64>>,
    array: Arc<Vec<AtomicU64>>,
}

impl Ring {
    /// Creates a ring with two descriptors.
    fn new() -> Self {
        Self { header: zeros(RING_WORDS), array: zeros(2 * DESCRIPTOR_WORDS) }
    }

    fn view(&self) -> View<'_, AtomicU64> {
        View { ring: &self.header, word: 0, array: &self.array }
    }

    fn tail(&self) -> &AtomicU64 {
        &self.header[TAIL]
    }

    /// Publishes a sample whose payload is outside the descriptor.
    fn show(&self, position: u64) {
        self.publish(position, PayloadLocation::Inline);
    }

    fn publish(&self, position: u64, place: PayloadLocation) {
        about_to_write::<AtomicU64>();
        publish(&self.header, &self.array, position, &record(position, place), &[]);
    }
}

fn record(position: u64, place: PayloadLocation) -> Record {
    Record { sequence: 10 + position, timestamp: 0, published: 0, len: 0, place }
}

/// Returns a lane that a reader has opened, with `first` as its next position.
fn granted(first: u64) -> (Arc<Vec<AtomicU64>>, LaneId) {
    let lane = zeros(LANE_WORDS);
    lane::ask(&lane[..], 1);
    let tenancy = LaneId::grant(&lane[..], PinLimit::ALL);
    lane::open(&lane[..], Grant { generation: tenancy.generation(), first });
    (lane, tenancy)
}
