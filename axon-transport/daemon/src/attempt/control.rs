//! The control stream of an attempt.

use quinn::{RecvStream, SendStream};

use crate::{
    engine::quic::control_stream::FrameLimits,
    link::{FrameError, LinkMessage, read_length},
};

/// Bytes that one read takes from the stream.
const READ: usize = 64 << 10;

/// Why no further message comes.
#[derive(Debug)]
pub(super) enum Unreadable {
    /// The daemon broke the format.
    Frame(FrameError),
    /// The stream, or its connection, ended.
    Ended(String),
}

/// Both directions of the control stream.
pub(super) struct AttemptControl {
    sending: SendStream,
    /// Frames that wait to be written.
    out: Vec<u8>,
    receiving: RecvStream,
    incoming: ReceivedBytes,
}

impl AttemptControl {
    /// Uses the streams of one bidirectional stream.
    pub(super) fn new((sending, receiving): (SendStream, RecvStream)) -> Self {
        // Before all data.
        let _ = sending.set_priority(i32::MAX);
        Self { sending, out: Vec::new(), receiving, incoming: ReceivedBytes::default() }
    }

    /// Bounds the frames that are read from now on.
    pub(super) fn set_limits(&mut self, limits: FrameLimits) {
        self.incoming.limits = limits;
    }

    /// Queues a message. [`flush`](Self::flush) and [`next`](Self::next) write it.
    ///
    /// # Errors
    /// The message is too large.
    pub(super) fn send(&mut self, message: &LinkMessage) -> Result<(), FrameError> {
        self.out.extend(message.to_frame()?);
        Ok(())
    }

    /// Writes the queued messages. Cancel safe.
    ///
    /// # Errors
    /// The stream ended.
    pub(super) async fn flush(&mut self) -> Result<(), Unreadable> {
        while !self.out.is_empty() {
            write(&mut self.sending, &mut self.out).await?;
        }
        Ok(())
    }

    /// Writes the queued messages. Returns the next message of a known type; if not `reads`, no message. Cancel safe.
    ///
    /// # Errors
    /// No further message comes.
    pub(super) async fn next(&mut self, reads: bool) -> Result<LinkMessage, Unreadable> {
        loop {
            if reads && let Some(message) = self.incoming.take().map_err(Unreadable::Frame)? {
                return Ok(message);
            }
            tokio::select! {
                written = write(&mut self.sending, &mut self.out), if !self.out.is_empty() => {
                    written?;
                }
                chunk = self.receiving.read_chunk(READ, true), if reads => match chunk {
                    Ok(Some(chunk)) => self.incoming.bytes.extend_from_slice(&chunk.bytes),
                    Ok(None) => return Err(Unreadable::Ended("the peer finished it".into())),
                    Err(error) => return Err(Unreadable::Ended(error.to_string())),
                },
                else => std::future::pending().await,
            }
        }
    }
}

/// Writes the front of `out`. Cancel safe.
async fn write(sending: &mut SendStream, out: &mut Vec<u8>) -> Result<(), Unreadable> {
    let written = sending.write(out).await.map_err(|e| Unreadable::Ended(e.to_string()))?;
    out.drain(..written);
    Ok(())
}

/// Bytes of the daemon that are not yet a message.
struct ReceivedBytes {
    bytes: Vec<u8>,
    limits: FrameLimits,
}

impl Default for ReceivedBytes {
    fn default() -> Self {
        Self { bytes: Vec::new(), limits: FrameLimits::BEFORE_HELLO }
    }
}

impl ReceivedBytes {
    /// Takes the next message of a known type, if it is complete.
    fn take(&mut self) -> Result<Option<LinkMessage>, FrameError> {
        while let Some(prefix) = self.bytes.first_chunk::<4>() {
            let end = 4 + read_length(*prefix, self.limits.frame)?;
            let Some(frame) = self.bytes.get(4..end) else { return Ok(None) };
            let message = LinkMessage::from_frame(frame, self.limits.inflated)?;
            self.bytes.drain(..end);
            if message.is_some() {
                return Ok(message);
            }
        }
        Ok(None)
    }
}

#[cfg(test)]
mod tests {
    use axon_shm::ids::Gid;

    use super::*;
    use crate::link::{Elected, RouteReady};

    fn elected(election: u64) -> LinkMessage {
        LinkMessage::Elected(Elected { link: [7; 16], election, standby: None })
    }

    #[test]
    fn frames_split_anywhere_are_read_and_unknown_types_are_skipped() {
        let unknown = [0, 0, 0, 3, 0x7f, 1, 2];
        let frames =
            [&elected(1).to_frame().unwrap()[..], &unknown, &elected(2).to_frame().unwrap()];
        let mut incoming = ReceivedBytes::default();
        let mut read = Vec::new();
        for byte in frames.concat() {
            incoming.bytes.push(byte);
            read.extend(incoming.take().unwrap());
        }
        assert_eq!(read, [elected(1), elected(2)]);
        assert!(incoming.bytes.is_empty());
        incoming.bytes = frames.concat();
        assert_eq!(incoming.take().unwrap(), Some(elected(1)));
        assert_eq!(incoming.take().unwrap(), Some(elected(2)));
        assert_eq!(incoming.take().unwrap(), None);
    }

    #[test]
    fn frame_beyond_its_limit_is_refused_before_it_has_arrived() {
        let length = u32::try_from(FrameLimits::BEFORE_HELLO.frame).unwrap() + 1;
        let bytes = length.to_be_bytes().to_vec();
        let mut incoming = ReceivedBytes { bytes, ..ReceivedBytes::default() };
        assert!(matches!(incoming.take(), Err(FrameError::TooLarge { .. })));
        incoming.limits = FrameLimits::UNPROVEN;
        assert_eq!(incoming.take().unwrap(), None);
    }

    #[test]
    fn long_map_is_not_decompressed_before_the_proof() {
        let ready = RouteReady { route: 1, publishers: vec![Gid::default(); 1000] };
        let ready = LinkMessage::RouteReady(ready);
        let mut incoming =
            ReceivedBytes { bytes: ready.to_frame().unwrap(), limits: FrameLimits::UNPROVEN };
        assert!(matches!(incoming.take(), Err(FrameError::TooLarge { .. })));
        incoming.limits = FrameLimits::PROVEN;
        assert_eq!(incoming.take().unwrap(), Some(ready));
    }
}
