//! The control stream of a connection. It carries messages of the link protocol, each in a frame after its length
//! (`docs/formats.md`, section 4).

use std::{collections::VecDeque, rc::Rc, time::Duration};

use bytes::{Buf, Bytes};
use quinn_proto::{ReadError, ReadableError, StreamId, WriteError};

use crate::{
    engine::account::{Account, Charge, Meter, cost, cost_of_frame, decoded_length},
    link::{
        CloseCode, FrameError, LinkMessage, MAX_FRAME, MAX_FRAME_BEFORE_HELLO, MAX_INFLATED,
        is_known, read_length,
    },
};

/// Most bytes of messages that wait for a peer that does not read them.
const MAX_QUEUED: usize = 64 << 20;
/// The priority of the stream: before all data.
const PRIORITY: i32 = i32::MAX;

/// The reason for which no more messages arrive.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub(crate) enum ControlError {
    /// The peer violated the format.
    #[error(transparent)]
    Frame(#[from] FrameError),
    /// The stream ended.
    #[error("the control stream ended: {0}")]
    Ended(String),
    /// The peer does not read the messages.
    #[error("control messages are not read")]
    Unread,
}

impl ControlError {
    /// Returns the code with which the link is closed; `None` if the stream ended.
    pub(crate) fn code(&self) -> Option<CloseCode> {
        match self {
            Self::Frame(FrameError::TooLarge { .. }) | Self::Unread => Some(CloseCode::TooLarge),
            Self::Frame(_) => Some(CloseCode::Malformed),
            Self::Ended(_) => None,
        }
    }
}

/// The limits of a frame at each stage of the link's opening.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct FrameLimits {
    /// Most bytes of a frame.
    pub(crate) frame: usize,
    /// Most bytes of a decompressed frame.
    pub(crate) inflated: usize,
}

impl FrameLimits {
    /// Limits before the peer's HELLO was checked.
    pub(crate) const BEFORE_HELLO: Self =
        Self { frame: MAX_FRAME_BEFORE_HELLO, inflated: MAX_FRAME_BEFORE_HELLO };
    /// Limits after HELLO, before the peer has proven its identity.
    pub(crate) const UNPROVEN: Self = Self { frame: MAX_FRAME, inflated: MAX_FRAME_BEFORE_HELLO };
    /// Limits after the peer has proven its identity.
    pub(crate) const PROVEN: Self = Self { frame: MAX_FRAME, inflated: MAX_INFLATED };
}

/// The result of a read of a control stream.
#[derive(Debug)]
pub(crate) enum ControlInput {
    /// A message, with its charge on the account until it is handled.
    Message(Box<LinkMessage>, Option<Charge>),
    /// No complete message has arrived, or the peer has to wait.
    Nothing,
    /// A complete message has arrived. It is decompressed once messages of the same identity are handled.
    NoRoom,
}

/// The control stream.
#[derive(Debug)]
pub(crate) struct ControlStream {
    stream: Option<StreamId>,
    limits: FrameLimits,
    /// Waiting frames, each with its charge on the account.
    out: VecDeque<(Bytes, Option<Charge>)>,
    queued: usize,
    meter: Option<Rc<Meter>>,
    /// The memory of messages that are decompressed and not handled yet.
    decoded: Option<Rc<Meter>>,
    /// True if nothing is sent after the waiting frames.
    finishing: bool,
    finished: bool,
    /// The rest of the last chunk that QUIC returned.
    piece: Bytes,
    /// The length and body of the frame that is being read.
    frame: Vec<u8>,
    /// The cost of the frame that was read, once it was charged to the peer's rate.
    paid: Option<u32>,
    /// The time until which no further frame is read, because the peer has used up its rate.
    paused_until: Option<Duration>,
    readable: bool,
    ended: bool,
}

impl Default for ControlStream {
    fn default() -> Self {
        Self {
            stream: None,
            limits: FrameLimits::BEFORE_HELLO,
            out: VecDeque::new(),
            queued: 0,
            meter: None,
            decoded: None,
            finishing: false,
            finished: false,
            piece: Bytes::new(),
            frame: Vec::new(),
            paid: None,
            paused_until: None,
            readable: false,
            ended: false,
        }
    }
}

impl ControlStream {
    /// Uses this stream as the control stream.
    pub(in crate::engine) fn open(&mut self, stream: StreamId, quic: &mut quinn_proto::Connection) {
        self.stream = Some(stream);
        self.readable = true;
        let _ = quic.send_stream(stream).set_priority(PRIORITY);
    }

    /// Returns the stream, once there is one.
    pub(in crate::engine) fn stream(&self) -> Option<StreamId> {
        self.stream
    }

    /// Sets the limits of the next frames.
    pub(in crate::engine) fn set_limits(&mut self, limits: FrameLimits) {
        self.limits = limits;
    }

    /// Charges messages that are queued or decompressed from now on to this account.
    pub(in crate::engine) fn charge_to(&mut self, account: &Account) {
        self.meter = Some(Rc::clone(&account.unsent));
        self.decoded = Some(Rc::clone(&account.decoded));
    }

    /// Queues a message.
    ///
    /// # Errors
    /// The message is too large, or the peer does not read.
    pub(in crate::engine) fn send(&mut self, message: &LinkMessage) -> Result<(), ControlError> {
        if self.finishing {
            return Ok(());
        }
        let frame = message.to_frame()?;
        let charge = self.meter.as_ref().map(|meter| meter.charge(frame.len()));
        if self.queued > MAX_QUEUED || matches!(charge, Some(None)) {
            return Err(ControlError::Unread);
        }
        self.queued += frame.len();
        self.out.push_back((frame.into(), charge.flatten()));
        Ok(())
    }

    /// Ends the output after the waiting messages.
    pub(in crate::engine) fn finish(&mut self) {
        self.finishing = true;
    }

    /// Stops reading, because the connection is closed.
    pub(in crate::engine) fn close(&mut self) {
        self.paused_until = None;
        self.ended = true;
    }

    /// Returns the bytes that wait to be sent, and the bytes that arrived and are not handled.
    #[cfg(test)]
    pub(in crate::engine) fn held(&self) -> (usize, usize) {
        (self.queued, self.piece.len() + self.frame.len())
    }

    /// Returns whether frames, or the end of the output, wait to be sent.
    pub(in crate::engine) fn has_output(&self) -> bool {
        !self.out.is_empty() || self.finishing && !self.finished
    }

    /// Returns the bytes of messages that wait for QUIC.
    pub(in crate::engine) fn queued(&self) -> usize {
        self.queued
    }

    /// Hands frames to QUIC. Returns whether it took any.
    pub(in crate::engine) fn write(&mut self, quic: &mut quinn_proto::Connection) -> bool {
        let Some(stream) = self.stream else { return false };
        // Control messages are small, and go before all other data that QUIC holds.
        quic.set_send_window(u64::MAX);
        let mut wrote = false;
        while let Some((frame, _)) = self.out.front_mut() {
            match quic.send_stream(stream).write(frame) {
                Ok(taken) => {
                    wrote = true;
                    self.queued -= taken;
                    frame.advance(taken);
                    if !frame.has_remaining() {
                        self.out.pop_front();
                    }
                }
                Err(WriteError::Blocked) => return wrote,
                Err(WriteError::Stopped(_) | WriteError::ClosedStream) => {
                    self.out.clear();
                    self.queued = 0;
                    return wrote;
                }
            }
        }
        if self.finishing && !self.finished {
            self.finished = true;
            let _ = quic.send_stream(stream).finish();
            wrote = true;
        }
        wrote
    }

    /// Records that QUIC has more data of the stream.
    pub(in crate::engine) fn handle_readable(&mut self) {
        self.readable = true;
    }

    /// Returns when reading continues, if the peer has used up its rate.
    pub(in crate::engine) fn poll_timeout(&self) -> Option<Duration> {
        self.paused_until
    }

    /// Returns whether there may be a message.
    pub(in crate::engine) fn has_input(&self, now: Duration) -> bool {
        !self.ended
            && (self.readable || !self.piece.is_empty() || self.paid.is_some())
            && self.paused_until.is_none_or(|until| until <= now)
    }

    /// Returns the next message, if there is one. The function calls `owe` with the cost of the message; `owe` returns
    /// the time that the peer then has to wait.
    ///
    /// # Errors
    /// No more messages arrive.
    pub(in crate::engine) fn read(
        &mut self,
        quic: &mut quinn_proto::Connection,
        mut owe: impl FnMut(u32) -> Duration,
        now: Duration,
    ) -> Result<ControlInput, ControlError> {
        let result = self.try_read(quic, &mut owe, now);
        self.ended |= result.is_err();
        result
    }

    fn try_read(
        &mut self,
        quic: &mut quinn_proto::Connection,
        owe: &mut impl FnMut(u32) -> Duration,
        now: Duration,
    ) -> Result<ControlInput, ControlError> {
        if !self.has_input(now) {
            return Ok(ControlInput::Nothing);
        }
        self.paused_until = None;
        loop {
            if !self.gather(quic)? {
                return Ok(ControlInput::Nothing);
            }
            let paid = match self.paid {
                Some(paid) => paid,
                None => {
                    let cost = cost_of_frame(&self.frame[4..]);
                    self.paid = Some(cost);
                    if self.pause(owe(cost), now) {
                        return Ok(ControlInput::Nothing);
                    }
                    cost
                }
            };
            let body = &self.frame[4..];
            let room = match &self.decoded {
                Some(decoded) => {
                    let Some(room) = decoded.charge(decoded_length(body)) else {
                        return Ok(ControlInput::NoRoom);
                    };
                    Some(room)
                }
                None => None,
            };
            let message = match is_known(body) {
                true => LinkMessage::from_frame(body, self.limits.inflated)?,
                false => None,
            };
            (self.frame, self.paid) = (Vec::new(), None);
            if let Some(message) = message {
                if let more @ 1.. = cost(&message).saturating_sub(paid) {
                    self.pause(owe(more), now);
                }
                return Ok(ControlInput::Message(Box::new(message), room));
            }
        }
    }

    fn pause(&mut self, wait: Duration, now: Duration) -> bool {
        self.paused_until = (!wait.is_zero()).then(|| now + wait);
        self.paused_until.is_some()
    }

    /// Reads until a frame is complete. The memory grows with the bytes that arrive, not with the length that the peer
    /// states.
    fn gather(&mut self, quic: &mut quinn_proto::Connection) -> Result<bool, ControlError> {
        loop {
            let wanted = match self.frame.first_chunk::<4>() {
                Some(prefix) => 4 + read_length(*prefix, self.limits.frame)?,
                None => 4,
            };
            if wanted > 4 && self.frame.len() == wanted {
                return Ok(true);
            }
            if self.piece.is_empty() && !self.next_piece(quic)? {
                return Ok(false);
            }
            let taken = self.piece.split_to(self.piece.len().min(wanted - self.frame.len()));
            self.frame.extend_from_slice(&taken);
        }
    }

    fn next_piece(&mut self, quic: &mut quinn_proto::Connection) -> Result<bool, ControlError> {
        let Some(stream) = self.stream.filter(|_| self.readable) else { return Ok(false) };
        let mut stream = quic.recv_stream(stream);
        let mut chunks = match stream.read(true) {
            Ok(chunks) => chunks,
            Err(ReadableError::ClosedStream) => {
                return Err(ControlError::Ended("it is closed".into()));
            }
            Err(ReadableError::IllegalOrderedRead) => {
                return Err(ControlError::Ended("it was read out of order".into()));
            }
        };
        let next = chunks.next(usize::MAX);
        // The packets that QUIC now wants to send leave with the pass.
        let _ = chunks.finalize();
        match next {
            Ok(Some(chunk)) => {
                self.piece = chunk.bytes;
                Ok(true)
            }
            Ok(None) => Err(ControlError::Ended("the peer finished it".into())),
            Err(ReadError::Blocked) => {
                self.readable = false;
                Ok(false)
            }
            Err(ReadError::Reset(_)) => Err(ControlError::Ended("the peer reset it".into())),
        }
    }
}
