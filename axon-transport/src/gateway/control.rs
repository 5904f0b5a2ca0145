//! The control stream: whole, bounded messages over quinn's byte streams.

use quinn::{RecvStream, SendStream};

use crate::link::{
    CloseCode, FrameError, MAX_FRAME, MAX_FRAME_BEFORE_HELLO, Message, read_length,
};

/// Why no further message came.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub(super) enum ControlError {
    /// The peer sent what is not of the protocol.
    #[error(transparent)]
    Frame(#[from] FrameError),
    /// The connection or the stream ended.
    #[error("the control stream ended: {0}")]
    Ended(String),
}

impl ControlError {
    /// The code to close with, when it is this side that closes.
    pub(super) fn code(&self) -> Option<CloseCode> {
        match self {
            Self::Frame(FrameError::TooLarge { .. }) => Some(CloseCode::TooLarge),
            Self::Frame(_) => Some(CloseCode::Malformed),
            Self::Ended(_) => None,
        }
    }
}

/// Reads messages.
#[derive(Debug)]
pub(super) struct ControlReader {
    stream: RecvStream,
    limit: usize,
}

impl ControlReader {
    pub(super) fn new(stream: RecvStream) -> Self {
        Self { stream, limit: MAX_FRAME_BEFORE_HELLO }
    }

    /// Both HELLOs were checked: larger frames are allowed from now on.
    pub(super) fn hello_checked(&mut self) {
        self.limit = MAX_FRAME;
    }

    /// The next message of a known type. Not cancel safe: a cancelled read loses its place.
    pub(super) async fn next(&mut self) -> Result<Message, ControlError> {
        let ended = |e: &dyn std::fmt::Display| ControlError::Ended(e.to_string());
        loop {
            let mut prefix = [0; 4];
            self.stream.read_exact(&mut prefix).await.map_err(|e| ended(&e))?;
            let length = read_length(prefix, self.limit)?;
            let mut frame = vec![0; length];
            self.stream.read_exact(&mut frame).await.map_err(|e| ended(&e))?;
            if let Some(message) = Message::from_frame(&frame)? {
                return Ok(message);
            }
        }
    }
}

/// Writes messages.
#[derive(Debug)]
pub(super) struct ControlWriter {
    stream: SendStream,
}

impl ControlWriter {
    pub(super) fn new(stream: SendStream) -> Self {
        // Above every data stream: the graph and keys go on while a bulk topic fills the link.
        let _ = stream.set_priority(i32::MAX);
        Self { stream }
    }

    pub(super) async fn send(&mut self, message: &Message) -> Result<(), ControlError> {
        let frame = message.to_frame()?;
        self.stream.write_all(&frame).await.map_err(|e| ControlError::Ended(e.to_string()))
    }
}
