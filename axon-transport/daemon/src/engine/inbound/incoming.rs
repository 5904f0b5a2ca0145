//! Reads one data stream: a header, then messages behind their lengths.

use std::time::Duration;

use axon_envelope::{Route, inner};
use axon_shm::ids::Gid;
use bytes::{Bytes, BytesMut};
use quinn_proto::{ReadError, ReadableError, StreamId};

use super::copies::ReadCopy;
use crate::engine::{
    account::Charge,
    sample::{short_header::ShortHeaders, stream_header::StreamHeader},
};

/// The result of reading bytes from a stream.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Piece {
    /// All the bytes.
    Whole(Bytes),
    /// Not all have arrived.
    Later,
    /// The stream ended before all of them.
    End,
}

/// The next step of a stream, which names what the stream waits for.
#[derive(Debug)]
pub(super) enum StreamStep {
    /// Its header.
    Header,
    /// The election of its link. Its header was read.
    Election,
    /// For a copy, the number of the sample before it.
    After,
    /// The route, or the turn, of its flow, until this time.
    Turn(Duration),
    /// The length of the next message.
    Length,
    /// Memory for a message of this length.
    Room(usize),
    /// The message of this length.
    Body(usize),
    /// Memory for a message of this header, to decompress it.
    Unpack(inner::Header, Bytes),
    /// The stand-in of the message's writer, until this time.
    Writer(OpenedMessage, Duration),
    /// Space in the ring.
    Ring(OpenedMessage),
    /// The sample before a copy.
    Copy(ReadCopy),
    /// Its end: no more data is wanted from it.
    Over,
}

/// A message that was read and opened.
#[derive(Debug)]
pub(super) struct OpenedMessage {
    pub(super) writer: Gid,
    /// Its number in its flow, which rises. For a topic, and for requests, it is the sample's own number.
    pub(super) number: u64,
    pub(super) meta: axon_shm::Meta,
    pub(super) payload: Bytes,
}

/// A data stream.
#[derive(Debug)]
pub(super) struct IncomingStream {
    pub(super) step: StreamStep,
    pub(super) header: Option<(StreamHeader, Option<Route>)>,
    /// For a copy, the number of the sample before it in its flow; 0 if there is none.
    pub(super) after: u64,
    /// The last short header, if the messages have short headers.
    pub(super) headers: Option<ShortHeaders>,
    /// The rest of the last chunk from QUIC.
    pub(super) chunk: Bytes,
    /// A piece that came in several chunks.
    pub(super) gathered: BytesMut,
    /// The memory of a message that has not arrived completely.
    pub(super) room: Option<Charge>,
    /// The additional memory of the decompressed message.
    pub(super) unpacked: Option<Charge>,
    /// The time since which its message has waited for memory that other rings have.
    pub(super) short_since: Option<Duration>,
    pub(super) is_ready: bool,
    /// True if its link carries copies alone, since it stands by.
    pub(super) copies_alone: bool,
}

impl Default for IncomingStream {
    fn default() -> Self {
        Self {
            step: StreamStep::Header,
            header: None,
            after: 0,
            headers: None,
            chunk: Bytes::new(),
            gathered: BytesMut::new(),
            room: None,
            unpacked: None,
            short_since: None,
            is_ready: false,
            copies_alone: false,
        }
    }
}

impl IncomingStream {
    /// Returns whether the next `length` bytes were read from QUIC already.
    pub(super) fn has(&self, length: usize) -> bool {
        self.gathered.len() + self.chunk.len() >= length
    }

    /// Returns the next `length` bytes of the stream. A piece within one chunk is not copied.
    pub(super) fn take(
        &mut self,
        length: usize,
        id: StreamId,
        quic: &mut quinn_proto::Connection,
        read: &mut usize,
    ) -> Piece {
        loop {
            if self.gathered.is_empty() && self.chunk.len() >= length {
                return Piece::Whole(self.chunk.split_to(length));
            }
            let missing = length - self.gathered.len();
            if self.gathered.is_empty() && !self.chunk.is_empty() {
                self.gathered.reserve(length);
            }
            let more = self.chunk.split_to(self.chunk.len().min(missing));
            self.gathered.extend_from_slice(&more);
            if self.gathered.len() == length {
                return Piece::Whole(std::mem::take(&mut self.gathered).freeze());
            }
            match next_chunk(id, quic) {
                Ok(Some(chunk)) => {
                    *read += chunk.len();
                    self.chunk = chunk;
                }
                Ok(None) => return Piece::Later,
                Err(StreamEnd) => return Piece::End,
            }
        }
    }

    /// Returns whether a stream from which no more data is wanted is at its end. QUIC forgets a stream, and allows the
    /// peer another one, once its end was read. The end may come with the last bytes, without a separate event. A peer
    /// that sends more gets a STOP_SENDING.
    pub(super) fn is_over(&mut self, id: StreamId, quic: &mut quinn_proto::Connection) -> bool {
        (self.chunk, self.gathered) = (Bytes::new(), BytesMut::new());
        match next_chunk(id, quic) {
            Err(StreamEnd) => true,
            Ok(Some(_)) => {
                let _ = quic.recv_stream(id).stop(super::NO_ROUTE);
                true
            }
            Ok(None) => false,
        }
    }
}

#[cfg(test)]
impl IncomingStream {
    /// Returns the bytes of samples that were read from QUIC and are not delivered.
    pub(super) fn held(&self) -> usize {
        let message = match &self.step {
            StreamStep::Writer(message, _) | StreamStep::Ring(message) => message.payload.len(),
            StreamStep::Copy(copy) => copy.message.payload.len(),
            StreamStep::Unpack(_, sent) => sent.len(),
            _ => 0,
        };
        self.chunk.len() + self.gathered.len() + message
    }
}

/// The error of a stream that ended, was reset, or was stopped.
struct StreamEnd;

fn next_chunk(
    id: StreamId,
    quic: &mut quinn_proto::Connection,
) -> Result<Option<Bytes>, StreamEnd> {
    let mut stream = quic.recv_stream(id);
    let mut chunks = match stream.read(true) {
        Ok(chunks) => chunks,
        Err(ReadableError::ClosedStream | ReadableError::IllegalOrderedRead) => {
            return Err(StreamEnd);
        }
    };
    let next = chunks.next(usize::MAX);
    // QUIC sends the new window at the end of the pass.
    let _ = chunks.finalize();
    match next {
        Ok(Some(chunk)) => Ok(Some(chunk.bytes)),
        Ok(None) | Err(ReadError::Reset(_)) => Err(StreamEnd),
        Err(ReadError::Blocked) => Ok(None),
    }
}
