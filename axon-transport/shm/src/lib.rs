#![doc = include_str!("../README.md")]
//!
//! # How it works
//!
//! Each context has a segment of memory: a sealed memfd. The segment holds the words for its wake-ups, the rings of
//! its publishers, their samples of up to 4 KiB, and the cursors and pins of its readers. A publisher of longer
//! samples has a separate segment for them, and for loans of more than 512 bytes if it
//! [expects](PublisherOptions::expected_len) such samples. A context that needs more room has further segments.
//! Other processes map the segments that they read from.
#![deny(unsafe_code)]

#[cfg(not(all(target_pointer_width = "64", target_endian = "little")))]
compile_error!("rings are laid out for 64-bit little-endian machines");

mod alloc;
mod direct;
mod error;
pub mod ids;
mod limits;
mod memory;
mod os;
pub mod qos;
mod reader;
mod ring;
mod session;
mod sync;
mod wake;
mod writer;

#[cfg(test)]
mod tests;

pub use direct::{
    connect::ConnectError,
    context::Context,
    publisher::{Publisher, PublisherOptions},
    subscriber::{Subscriber, SubscriberOptions},
};
pub use error::{PinHolder, PublishError, ShmError, TakeError};
pub use reader::{
    sample::{Sample, SampleReader},
    slice::{SampleSlice, TrustPublishers},
};
pub use ring::types::{Meta, Published};
pub use session::leader::ExternalLeader;
pub use writer::loan::Loan;

/// The items that other crates of AXON use. They are not part of this crate's public interface: any release may change
/// them.
#[doc(hidden)]
pub mod internal {
    pub use crate::{
        alloc::{
            budget::MemoryBudget,
            segments::{SegmentEvent, SegmentInfo},
        },
        direct::connect::reencode_packet,
        error::OwnLimit,
        memory::{
            locked::LockedPages,
            probe::{out_of_reach, probe},
        },
        os::{
            clock::{from_unix_nanos, monotonic, unix_nanos, wall},
            fork::ForkToken,
            heap::{ErasingHeap, erase_from_now_on, return_free_memory},
            inherited::{close_inherited, survive_file_size_limit},
            peer_process::{PeerProcess, peer_pidfd, peer_process},
            per_process::{Made, PerProcess, is_elevated},
            signals::BlockedSignals,
        },
        qos::nanoseconds::nanoseconds,
        reader::{Reader, ReaderOptions},
        ring::{
            layout::{Location, SegmentKind},
            times::Times,
            types::{Grant, RingOptions, Taken},
            window::holds,
        },
        session::{
            known_peers::KnownPeers,
            lane::Lane,
            peer::{PeerDescriptors, PeerSession, RingPeer},
            reader_info::{ReaderInfo, Terms},
            segment::SessionSegment,
            segment_message::{Segment, SegmentName, SegmentOpened},
        },
        wake::{ForwardedWakeups, Purpose, WakeCheck},
        writer::{CarrierState, MAX_GAP, Writer},
    };

    /// Counters that rings and lanes keep about themselves.
    pub mod inspect {
        pub use crate::ring::inspect::{LaneCounts, RingCounts, committed, timestamp};
    }

    /// Descriptors that one process passes to another.
    pub mod descriptors {
        pub use crate::os::descriptors::{
            FEW_DESCRIPTORS, PassedFd, SocketPacket, carries_descriptors, close_queue_is_full,
            is_clogged, is_scarce, is_tight, limit, look, open, receive, receive_few, share,
        };
    }
}
