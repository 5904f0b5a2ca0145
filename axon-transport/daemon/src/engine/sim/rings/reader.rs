//! A relay, from which the engine takes the samples of publishers.

use std::{collections::HashMap, rc::Rc, time::Duration};

use axon_shm::{
    ids::Gid,
    qos::{History, Reliability},
};
use axon_transport::{Lifetime, MessageInfo, internal::session::TakeLimit};
use bytes::Bytes;

use super::{Cursors, SimRings};
use crate::engine::rings::RingReader;

/// Maximum number of samples that one take passes over because they do not count, as in a session.
const PASSED_OVER: usize = 64;

/// A relay.
pub(super) struct SimReader {
    pub(super) rings: SimRings,
    pub(super) cursors: Rc<Cursors>,
}

impl Drop for SimReader {
    fn drop(&mut self) {
        self.cursors.closed.set(true);
        let is_killed = self.rings.state.borrow().is_killed;
        if is_killed && self.cursors.spec.qos.reliability == Reliability::Reliable {
            for (publisher, samples) in self.unacknowledged() {
                self.give_up(publisher, samples);
            }
        }
    }
}

impl SimReader {
    /// Returns the next sample of a publisher after this reader's cursor.
    fn peek(&self, publisher: &Gid) -> Option<(u64, Vec<u8>)> {
        let state = self.rings.state.borrow();
        let of = state.publishers.get(publisher)?;
        let read = self.cursors.read.borrow().get(publisher).copied().unwrap_or(0);
        let qos = &self.cursors.spec.qos;
        let skip = match (qos.reliability, qos.history) {
            (Reliability::Reliable, History::KeepAll) => 0,
            _ => of.published.saturating_sub(u64::from(qos.depth)),
        };
        let next = of.history.iter().find(|(sequence, _)| *sequence > read.max(skip));
        next.cloned()
    }

    /// Passes over the samples up to this number.
    fn pass_to(&self, publisher: &Gid, number: u64) {
        let mut read = self.cursors.read.borrow_mut();
        let read = read.entry(*publisher).or_default();
        *self.cursors.lost.borrow_mut().entry(*publisher).or_default() +=
            number.saturating_sub(*read);
        *read = number.max(*read);
    }
}

impl RingReader for SimReader {
    fn gid(&self) -> Gid {
        self.cursors.gid
    }

    fn with_data(&self) -> Vec<Gid> {
        self.matched().into_iter().filter(|publisher| self.has_data_of(publisher)).collect()
    }

    fn has_data_of(&self, publisher: &Gid) -> bool {
        self.rings.state.borrow_mut().looks += 1;
        self.peek(publisher).is_some()
    }

    fn reads(&self, publisher: &Gid) -> bool {
        let state = self.rings.state.borrow();
        state.publishers.get(publisher).is_some_and(|p| self.cursors.reads(&p.endpoint))
    }

    fn matched(&self) -> Vec<Gid> {
        let state = self.rings.state.borrow();
        let of = state.publishers_of(&self.cursors.spec.topic);
        of.filter(|(_, p)| self.cursors.reads(&p.endpoint)).map(|(gid, _)| *gid).collect()
    }

    fn take_many(
        &self,
        publisher: &Gid,
        most: TakeLimit,
        each: &mut dyn FnMut(MessageInfo, Bytes),
    ) -> usize {
        let state = self.rings.state.borrow();
        let expired = state.expired.get(publisher).copied();
        let lifespan = state.publishers.get(publisher).and_then(|of| of.endpoint.qos.lifespan);
        drop(state);
        let (mut samples, mut bytes, mut passed_over) = (0, 0, 0);
        while samples < most.samples
            && passed_over < PASSED_OVER
            && let Some((sequence, payload)) = self.peek(publisher)
            && (samples == 0 || bytes + payload.len() <= most.bytes)
        {
            self.pass_to(publisher, sequence - 1);
            self.cursors.read.borrow_mut().insert(*publisher, sequence);
            if Some(sequence) <= expired {
                passed_over += 1;
                continue;
            }
            (samples, bytes) = (samples + 1, bytes + payload.len());
            let mut info = MessageInfo::of(*publisher, sequence);
            info.source_timestamp = self.rings.wall.get();
            info.lifetime = lifespan.map(|lifespan| Lifetime::new(Duration::ZERO, lifespan));
            each(info, payload.into());
        }
        samples
    }

    fn retry_of(&self, publisher: &Gid) -> Option<Duration> {
        self.peek(publisher).map(|_| Duration::ZERO)
    }

    fn skip_of(&self, publisher: &Gid, depth: u64) {
        let state = self.rings.state.borrow();
        let published = state.publishers.get(publisher).map_or(0, |of| of.published);
        self.pass_to(publisher, published.saturating_sub(depth));
    }

    fn lost_of(&self, publisher: &Gid) -> u64 {
        // A look finds the losses, as with a ring in memory.
        if let Some((next, _)) = self.peek(publisher) {
            self.pass_to(publisher, next - 1);
        }
        self.cursors.lost.borrow().get(publisher).copied().unwrap_or(0)
    }

    fn acknowledge_of(&self, publisher: &Gid, sequence: u64) {
        let mut acknowledged = self.cursors.acknowledged.borrow_mut();
        let known = acknowledged.entry(*publisher).or_default();
        *known = sequence.max(*known);
    }

    fn take_back(&self) {
        self.cursors.read.borrow_mut().clone_from(&self.cursors.acknowledged.borrow());
    }

    fn unacknowledged(&self) -> HashMap<Gid, u64> {
        let state = self.rings.state.borrow();
        let acknowledged = self.cursors.acknowledged.borrow();
        let of = state.publishers_of(&self.cursors.spec.topic);
        let of = of.filter(|(_, p)| self.cursors.reads(&p.endpoint));
        let left = of.map(|(gid, publisher)| {
            let done = acknowledged.get(gid).copied().unwrap_or(0);
            (*gid, publisher.published.saturating_sub(done))
        });
        left.filter(|(_, left)| *left > 0).collect()
    }

    fn unacknowledged_bytes_of(&self, publisher: &Gid) -> u64 {
        let acknowledged = self.cursors.acknowledged.borrow().get(publisher).copied().unwrap_or(0);
        let state = self.rings.state.borrow();
        let history = state.publishers.get(publisher).map(|of| &of.history);
        let left = history.into_iter().flatten().filter(|(sequence, _)| *sequence > acknowledged);
        left.map(|(_, payload)| payload.len() as u64).sum()
    }

    fn refused_of(&self, publisher: &Gid) -> Option<u64> {
        let state = self.rings.state.borrow();
        let of = state.publishers.get(publisher)?;
        let (oldest, _) = of.history.front()?;
        let acknowledged = self.cursors.acknowledged.borrow().get(publisher).copied().unwrap_or(0);
        (acknowledged < *oldest).then_some(of.refused)
    }

    fn give_up(&self, publisher: Gid, samples: u64) {
        *self.rings.state.borrow_mut().given_up.entry(publisher).or_default() += samples;
    }

    fn assertions(&self) -> Vec<(Gid, u64)> {
        Vec::new()
    }

    fn set_stands_for(&self, gids: Vec<Gid>) {
        *self.cursors.stands_for.borrow_mut() = gids;
    }
}
