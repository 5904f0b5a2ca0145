//! Faults on demand.

use std::collections::VecDeque;
use std::time::Duration;

/// What a KME does wrong to a request. Injected by [`Kme::inject`](super::Kme::inject).
///
/// Except where it says otherwise the request is served first, so that keys asked for are gone.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Fault {
    /// The TCP connection is closed before the TLS handshake. Nothing is served. Meets new
    /// connections only.
    HandshakeRefused,
    /// The answer comes this much later.
    Latency(Duration),
    /// The answer never comes.
    Silence,
    /// The answer comes a byte at a time, with this pause between two.
    Drip(Duration),
    /// 503 as from an empty store. Nothing is served.
    Empty,
    /// 503 that asks to come back after so many seconds. Nothing is served.
    Busy(u64),
    /// Another status, without a JSON body. Nothing is served.
    Status(u16),
    /// The connection is reset after the request.
    ResetAfterRequest,
    /// The connection is closed in the middle of the answer's body.
    CutAnswer,
    /// The answer's body is no JSON.
    Garbage,
    /// The answer's body never ends, and has no Content-Length.
    Endless,
    /// The Content-Length says more than any client should take.
    LyingLength,
    /// Keys are one byte short.
    WrongLength,
    /// All keys have the first one's key_ID.
    RepeatKeyId,
    /// The first key is missing.
    KeyMissing,
    /// key_IDs in upper case.
    UpperCaseIds,
    /// key_IDs that nobody asked for.
    OtherIds,
    /// The answer is labelled `text/plain`.
    WrongMediaType,
    /// The answer is HTTP/1.0 and ends with the connection.
    Http10,
}

/// Faults that wait for their requests, first in first out.
#[derive(Debug, Default)]
pub(super) struct Faults(VecDeque<(Fault, u32)>);

impl Faults {
    pub(super) fn push(&mut self, fault: Fault, times: u32) {
        if times > 0 {
            self.0.push_back((fault, times));
        }
    }

    pub(super) fn clear(&mut self) {
        self.0.clear();
    }

    /// The fault for a new connection, if that is the next one.
    pub(super) fn next_for_connection(&mut self) -> bool {
        let next = matches!(self.0.front(), Some((Fault::HandshakeRefused, _)));
        if next {
            self.pop();
        }
        next
    }

    /// The fault for a request.
    pub(super) fn next_for_request(&mut self) -> Option<Fault> {
        match self.0.front() {
            Some((Fault::HandshakeRefused, _)) | None => None,
            Some(_) => self.pop(),
        }
    }

    fn pop(&mut self) -> Option<Fault> {
        let (fault, times) = self.0.front_mut()?;
        *times -= 1;
        let (fault, left) = (fault.clone(), *times);
        if left == 0 {
            self.0.pop_front();
        }
        Some(fault)
    }
}
