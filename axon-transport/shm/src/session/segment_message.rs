//! The message by which one process announces its segments to another. It is CBOR. It goes over the socket through
//! which the processes connected, or through the daemon (`docs/formats.md`, sections 8 and 9).

use minicbor::{Decode, Encode};

use crate::{
    alloc::segments::SegmentInfo,
    ids::{Gid, SessionId},
    ring::layout::SegmentKind,
};

/// A segment of a session's memory, besides the first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Encode, Decode)]
pub struct Segment {
    /// Its number.
    #[n(0)]
    pub number: u32,
    /// The publisher whose samples are in it, if it belongs to one publisher.
    #[n(1)]
    pub publisher: Option<Gid>,
}

impl From<SegmentInfo> for Segment {
    fn from(info: SegmentInfo) -> Self {
        let publisher = match info.kind {
            SegmentKind::Samples(gid) => Some(gid),
            SegmentKind::Session | SegmentKind::Heap => None,
        };
        Self { number: info.number, publisher }
    }
}

impl From<Segment> for SegmentInfo {
    fn from(segment: Segment) -> Self {
        let kind = segment.publisher.map_or(SegmentKind::Heap, SegmentKind::Samples);
        Self { number: segment.number, kind }
    }
}

/// The message that a session has opened a segment.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct SegmentOpened {
    /// The session.
    #[n(0)]
    pub session: SessionId,
    /// The segment.
    #[n(1)]
    pub segment: Segment,
}

/// The name of a segment of a session that is gone, or that another session needs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct SegmentName {
    /// The session.
    #[n(0)]
    pub session: SessionId,
    /// The segment's number.
    #[n(1)]
    pub number: u32,
}
