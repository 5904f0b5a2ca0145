//! Streams of copies with any content.

use std::time::Duration;

use axon_envelope::{Delivery, Kind, Route, TopicHash};
use axon_shm::ids::Gid;
use axon_transport::MessageInfo;
use bytes::Bytes;

use crate::engine::{
    rings::RingSample,
    sample::{
        frames::Frames,
        protection::{Seal, call},
        stream_header::StreamHeader,
    },
    sim::rings::payload,
};

/// A stream of kind 3, or of kind 1 if it is no copy.
#[derive(Clone, Debug)]
pub(super) struct CopyStream {
    pub(super) is_copy: bool,
    pub(super) kind: Kind,
    pub(super) topic: &'static str,
    pub(super) route: u32,
    /// The endpoint that the header names.
    pub(super) of: Gid,
    /// The endpoint that the message names.
    pub(super) writer: Gid,
    pub(super) number: u64,
    /// The number of the sample before it.
    pub(super) after: u64,
    /// Bytes of payload behind the 24 that the simulated rings check.
    pub(super) length: usize,
    /// Bytes of the stream that are sent.
    pub(super) cut: Option<usize>,
}

impl CopyStream {
    pub(super) fn new(topic: &'static str, route: u32, of: Gid, number: u64) -> Self {
        Self {
            is_copy: true,
            kind: Kind::Topic,
            topic,
            route,
            of,
            writer: of,
            number,
            after: number.saturating_sub(1),
            length: 10,
            cut: None,
        }
    }

    /// Returns the bytes of the stream.
    pub(super) fn encode(&self) -> Bytes {
        let header = StreamHeader {
            copy: self.is_copy,
            acknowledged: self.kind != Kind::Topic,
            ..StreamHeader::plain(self.route, self.of)
        };
        let mut bytes = header.encode().to_vec();
        if self.is_copy {
            bytes.extend_from_slice(&self.after.to_be_bytes());
        }
        let number = match self.kind {
            Kind::Topic => 0,
            Kind::Request => 1,
            Kind::Response => 2,
        };
        let topic = TopicHash::new(number, self.topic, "T").unwrap();
        let info = MessageInfo::of(self.writer, self.number);
        let payload = payload(self.writer, self.number, self.length);
        let mut sample = RingSample::new(info, payload.into(), Duration::ZERO);
        sample.call = (self.kind != Kind::Topic).then(|| call(self.of, self.number));
        let route = Route { kind: self.kind, topic };
        let mut frames = Frames::default();
        Seal::Link
            .write(&sample, route, Delivery::Reliable, None, &mut frames, Duration::ZERO)
            .unwrap();
        frames.take().iter().for_each(|piece| bytes.extend_from_slice(piece));
        bytes.truncate(self.cut.unwrap_or(usize::MAX));
        bytes.into()
    }
}
