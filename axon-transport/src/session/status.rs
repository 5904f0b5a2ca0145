//! The daemon's status, asked for over a connection that does nothing else.

use std::{
    os::fd::OwnedFd,
    time::{Duration, Instant},
};

use rustix::event::{PollFd, PollFlags, Timespec, poll};

use super::{
    error::SessionError,
    message::Message,
    socket::{self, SocketError},
    state::StatusText,
};

/// The text of the status.
pub(super) fn ask(
    socket: &OwnedFd,
    address: &str,
    patience: Duration,
) -> Result<Vec<u8>, SessionError> {
    let silent = || SessionError::Silent { address: address.to_owned() };
    let protocol = |e: SocketError| SessionError::Protocol(e.to_string());
    let deadline = Instant::now() + patience;
    socket::send(socket, &Message::StatusRequest.encode()?, &[]).map_err(protocol)?;
    let (mut text, mut buffer) = (StatusText::default(), Vec::new());
    loop {
        match socket::receive(socket, &mut buffer) {
            Ok(received) => {
                if let Message::Status(part) = received.message
                    && let Some(whole) = text.add(&part)
                {
                    return Ok(whole);
                }
            }
            Err(SocketError::NotReady) => {
                let left = deadline.saturating_duration_since(Instant::now());
                let timeout = Timespec::try_from(left).unwrap_or_default();
                let mut fds = [PollFd::new(socket, PollFlags::IN)];
                if left.is_zero() || poll(&mut fds, Some(&timeout)) == Ok(0) {
                    return Err(silent());
                }
            }
            Err(SocketError::Closed) => return Err(SessionError::Disconnected),
            Err(error) => return Err(protocol(error)),
        }
    }
}
