//! Shared memory between the processes of one host. Each session has a segment of memory, a sealed
//! memfd that holds the words by which it is woken, the rings of its publishers, their samples of up
//! to 4 KiB, and its readers' cursors and pins. A publisher of longer samples has a segment for
//! them (and for loans of more than 512 bytes, if it [expects](PublisherOptions::expected_len)
//! such), and a session that needs more room has further ones. Others map what they read from.
//!
//! ```
//! use std::{os::unix::net::UnixDatagram, thread, time::Duration};
//!
//! use axon_shm::{Context, Publisher, PublisherOptions, Subscriber, SubscriberOptions, qos::Qos};
//!
//! // Two ends of a socket, usually in two processes. It is needed only to come together. Any socket
//! // of unix that keeps packets apart will do, of a pair, or accepted from a listener.
//! let (ours, theirs) = UnixDatagram::pair()?;
//! let patience = Some(Duration::from_secs(10));
//! let publisher = Publisher::new(&Context::new()?, PublisherOptions::new(Qos::default()))?;
//! let there = Context::new()?;
//! let mut subscriber = thread::scope(|scope| {
//!     scope.spawn(|| publisher.serve(&ours, patience));
//!     Subscriber::connect(&there, &theirs, SubscriberOptions::new(Qos::default()), patience)
//! })?;
//!
//! // A large sample is written and read in place.
//! let mut image = publisher.loan(640 * 480 * 3)?;
//! image.fill(0x7f);
//! image.publish_now()?;
//! let sample = subscriber.recv(patience)?.expect("the image");
//! assert!(sample.is_borrowed());
//! let mut pixel = [0; 3];
//! sample.read_at(sample.len() - 3, &mut pixel);
//! assert_eq!(pixel, [0x7f; 3]);
//!
//! // A small one is copied in and out.
//! publisher.publish(b"hello")?;
//! let mut text = Vec::new();
//! subscriber.recv(patience)?.expect("the greeting").copy_to(&mut text)?;
//! assert_eq!(text, b"hello");
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! Every shared word has exactly one writer process; there is no lock, reference count or
//! compare-and-swap between processes, so a process that dies leaves only its own pages stale.
//! Readers map read-only. What another process wrote is hostile input: layouts are checked and
//! copied when they are mapped, and each word is read once and range-checked. Samples in
//! a session's segment are copied, with a check afterwards that they were not overwritten
//! meanwhile; those in a publisher's own are pinned, so that it leaves them alone. A publisher waits
//! for no reader but one that is, like itself, RELIABLE and KEEP_ALL.
//!
//! Who does what when: a publisher calls [`Publisher::reap`] now and then to forget subscribers that
//! have left, and [`Publisher::tend`] about once a second to give memory back; a subscriber that does
//! not [`recv`](Subscriber::recv) calls [`Subscriber::tend`] as often. The example `two_processes`
//! has the two ends in two processes, [`ExternalLeader`] one in tokio.
//!
//! Nothing in here starts a thread, but to close what other processes sent, or knows a daemon.
#![deny(unsafe_code)]

#[cfg(not(all(target_pointer_width = "64", target_endian = "little")))]
compile_error!("rings are laid out for 64-bit little-endian machines");

mod absent;
mod allowance;
mod area;
mod atfork;
mod attachment;
mod audience;
mod blocks;
mod classes;
mod clock;
mod connect;
mod context;
mod copy;
mod error;
mod fork;
mod headroom;
mod heap;
mod history;
pub mod ids;
mod inherit;
mod inspect;
mod lane;
mod layout;
mod limbo;
mod lines;
mod loan;
mod memory;
mod orphans;
mod passed;
mod peer;
mod pi_mutex;
mod pins;
mod prefetch;
mod probe;
mod process;
mod publisher;
pub mod qos;
mod quota;
mod reader;
mod ring;
mod room;
mod sample;
mod samples;
mod seats;
mod segment_message;
mod segments;
mod session;
mod signals;
mod slots;
mod subscriber;
mod sync;
mod tally;
mod tenure;
mod times;
mod types;
mod wait;
mod writer;

#[cfg(test)]
mod tests;

pub use connect::ConnectError;
pub use context::Context;
pub use error::{Keeper, PublishError, ShmError, TakeError};
pub use loan::Loan;
pub use publisher::{Publisher, PublisherOptions};
pub use sample::{Sample, SampleReader};
pub use subscriber::{Subscriber, SubscriberOptions};
pub use types::{Meta, Published};
pub use wait::ExternalLeader;

pub(crate) use fork::ForkToken;
pub(crate) use lane::Lane;
pub(crate) use layout::{Location, SegmentKind};
pub(crate) use peer::{Peer, PeerDescriptors, PeerSession};
pub(crate) use reader::{Reader, ReaderOptions};
pub(crate) use segment_message::{SegmentName, SegmentOpened};
pub(crate) use segments::{SegmentEvent, SegmentInfo};
pub(crate) use session::SessionSegment;
pub(crate) use types::{Grant, ReaderInfo, RingOptions, Taken, Terms};
pub(crate) use writer::Writer;

/// What the other crates of AXON use of this one. It is not part of its interface, and changes with any
/// release.
#[doc(hidden)]
pub mod internal {
    pub use crate::{
        audience::holds,
        clock::{monotonic, wall},
        connect::reencode_packet,
        fork::ForkToken,
        inherit::{close_inherited, survive_file_size_limit},
        lane::Lane,
        layout::{Location, SegmentKind},
        peer::{Peer, PeerDescriptors, PeerSession},
        probe::{out_of_reach, probe},
        process::{Made, PerProcess, is_elevated},
        reader::{Reader, ReaderOptions},
        segment_message::{Segment, SegmentName, SegmentOpened},
        segments::{SegmentEvent, SegmentInfo},
        session::SessionSegment,
        signals::BlockedSignals,
        times::Times,
        types::{Grant, ReaderInfo, RingOptions, Taken, Terms},
        wait::{Look, PassedOn, Purpose},
        writer::{MAX_GAP, Writer},
    };

    /// What rings and lanes say of themselves.
    pub mod inspect {
        pub use crate::inspect::{LaneCounts, RingCounts, committed, timestamp};
    }

    /// Descriptors that go from process to process.
    pub mod passed {
        pub use crate::passed::{
            Packet, PassedFd, carries_descriptors, has_too_many_strangers, is_scarce, is_short,
            receive, share,
        };
    }
}
