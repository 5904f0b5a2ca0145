//! The sources of a route's samples.

use std::{collections::HashMap, rc::Rc, time::Duration};

use axon_shm::{
    ids::Gid,
    qos::{History, Qos, Reliability},
};
use axon_transport::internal::session::TakeLimit;

use crate::engine::{
    rings::{RingReader, RingSample},
    route::RelaySpec,
    sample::protection::call,
    stand_in::StandIn,
};

/// Samples that one flow sent, dropped, or finished since the last report.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct FlowProgress {
    /// The sources may forget the samples up to this number.
    pub(super) sequence: Option<u64>,
    /// Number of samples among them that will never reach the peer.
    pub(super) given_up: u64,
}

/// The limit of one sample, whatever its length.
const ONE: TakeLimit = TakeLimit { samples: 1, bytes: 0 };

/// A source of samples.
#[derive(Clone)]
pub(crate) enum Source {
    /// Reads the local publishers of a topic.
    Relay(RelaySpec, Rc<dyn RingReader>),
    /// Reads the messages of a service's local endpoints for the peer's client or server.
    StandIn(Rc<StandIn>),
}

impl Source {
    /// Returns the publishers, or clients, that have samples to take.
    pub(super) fn with_data(&self) -> Vec<Gid> {
        match self {
            Self::Relay(_, reader) => reader.with_data(),
            Self::StandIn(stand_in) => stand_in.ring().with_calls(),
        }
    }

    /// Returns the publishers, or clients, that have samples to take, some of them written by `writer`.
    pub(super) fn with_data_of(&self, writer: &Gid) -> Vec<Gid> {
        match self {
            Self::Relay(_, reader) => {
                reader.has_data_of(writer).then_some(*writer).into_iter().collect()
            }
            // The responses to a client come from any of its servers.
            Self::StandIn(_) => self.with_data(),
        }
    }

    /// Returns whether it reads this publisher or client.
    pub(super) fn reads(&self, of: &Gid) -> bool {
        match self {
            Self::Relay(_, reader) => reader.reads(of),
            Self::StandIn(stand_in) => stand_in.ring().reads_calls_of(of),
        }
    }

    /// Returns the reader's own GID.
    pub(crate) fn gid(&self) -> Gid {
        match self {
            Self::Relay(_, reader) => reader.gid(),
            Self::StandIn(stand_in) => stand_in.gid(),
        }
    }

    /// Takes the next sample of a publisher or client.
    pub(super) fn take_of(&self, of: &Gid, now: Duration) -> Option<RingSample> {
        let mut taken = None;
        self.take_many(of, ONE, now, &mut |sample| taken = Some(sample));
        taken
    }

    /// Takes the next samples of a publisher or client, up to `most`. Returns their number.
    pub(super) fn take_many(
        &self,
        of: &Gid,
        most: TakeLimit,
        now: Duration,
        each: &mut dyn FnMut(RingSample),
    ) -> usize {
        match self {
            Self::Relay(_, reader) => reader.take_many(of, most, &mut |info, payload| {
                each(RingSample::new(info, payload, now))
            }),
            Self::StandIn(stand_in) => {
                let mut taken = 0;
                while taken < most.samples
                    && let Some((info, payload)) = stand_in.ring().take_call_of(of)
                {
                    let call = Some(call(*of, info.sequence));
                    let mut sample = RingSample::new(info, payload.into(), now);
                    sample.call = call;
                    each(sample);
                    taken += 1;
                }
                taken
            }
        }
    }

    /// Skips all samples of this publisher but the newest `depth`.
    pub(super) fn skip_of(&self, of: &Gid, depth: usize) {
        if let Self::Relay(_, reader) = self {
            reader.skip_of(of, depth as u64);
        }
    }

    /// Returns whether it may lose no sample of a publisher, and has some that it cannot return yet.
    pub(super) fn is_held_up(&self, of: &Gid) -> bool {
        match self {
            Self::Relay(spec, reader) => {
                let keeps_all = spec.qos.history == History::KeepAll
                    && spec.qos.reliability == Reliability::Reliable;
                keeps_all && reader.is_held_up(of)
            }
            Self::StandIn(_) => false,
        }
    }

    /// Returns the time after which a sample of this publisher may be taken, if none could be although some wait.
    pub(super) fn retry_of(&self, of: &Gid) -> Option<Duration> {
        match self {
            Self::Relay(_, reader) => reader.retry_of(of),
            Self::StandIn(_) => None,
        }
    }

    /// Returns how many samples of this publisher newer samples replaced before they were taken, or were skipped.
    pub(super) fn lost_of(&self, of: &Gid) -> u64 {
        match self {
            Self::Relay(_, reader) => reader.lost_of(of),
            Self::StandIn(_) => 0,
        }
    }

    /// Returns the QoS with which its samples are queued. No request or response is dropped.
    pub(super) fn qos(&self) -> Qos {
        match self {
            Self::Relay(spec, _) => spec.queued(),
            Self::StandIn(_) => Qos::keep_all(),
        }
    }

    /// Returns whether it is a relay of RELIABLE and KEEP_ALL subscriptions: its publishers keep samples that it has
    /// not acknowledged.
    pub(super) fn keeps_all(&self) -> bool {
        matches!(self, Self::Relay(spec, _) if spec.qos.reliability == Reliability::Reliable
            && spec.qos.history == History::KeepAll)
    }

    /// Acknowledges the samples of this publisher up to this number: they reached the peer, or never will.
    pub(super) fn acknowledge_of(&self, of: &Gid, sequence: u64) {
        if let Self::Relay(_, reader) = self {
            reader.acknowledge_of(of, sequence);
        }
    }

    /// Returns the number of unacknowledged RELIABLE samples, by publisher.
    pub(crate) fn unacknowledged(&self) -> HashMap<Gid, u64> {
        match self {
            Self::Relay(spec, reader) if spec.qos.reliability == Reliability::Reliable => {
                reader.unacknowledged()
            }
            _ => HashMap::new(),
        }
    }

    /// Returns how many samples, calls or responses it makes this publisher, client or server keep.
    pub(super) fn kept_of(&self, of: &Gid) -> Option<u64> {
        match self {
            Self::Relay(..) => self.unacknowledged().get(of).copied(),
            Self::StandIn(stand_in) => {
                Some(stand_in.ring().calls_of(of)).filter(|calls| *calls > 0)
            }
        }
    }

    /// Returns whether it has unacknowledged samples of this publisher.
    pub(crate) fn has_unacknowledged(&self, of: &Gid) -> bool {
        self.reads(of) && self.unacknowledged().contains_key(of)
    }

    /// Returns the bytes of its ring that the unacknowledged samples of this publisher take.
    pub(super) fn unacknowledged_bytes_of(&self, of: &Gid) -> u64 {
        match self {
            Self::Relay(_, reader) => reader.unacknowledged_bytes_of(of),
            Self::StandIn(_) => 0,
        }
    }

    /// Returns how many publishes of this publisher found no space, if this source may be the reason for the next one.
    pub(super) fn refused_of(&self, of: &Gid) -> Option<u64> {
        match self {
            Self::Relay(_, reader) => reader.refused_of(of),
            Self::StandIn(stand_in) => stand_in.ring().refused_of(of),
        }
    }

    /// Gives up `samples` samples of a publisher, which will never reach the peer.
    pub(super) fn give_up(&self, of: Gid, samples: u64) {
        if let Self::Relay(_, reader) = self {
            reader.give_up(of, samples);
        }
    }

    /// Returns the publishers, or the local endpoints of a service, that it reads.
    pub(crate) fn writers(&self) -> Vec<Gid> {
        match self {
            Self::Relay(_, reader) => reader.matched(),
            Self::StandIn(stand_in) => stand_in.ring().partners(),
        }
    }

    /// Returns whether it is the same source as `other`.
    pub(crate) fn is(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Relay(_, one), Self::Relay(_, other)) => Rc::ptr_eq(one, other),
            (Self::StandIn(one), Self::StandIn(other)) => Rc::ptr_eq(one, other),
            _ => false,
        }
    }
}
