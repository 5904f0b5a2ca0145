//! Services: requests that clients send to all servers, and responses that each server sends only to the requesting
//! client.
//!
//! A client has one ring, which its servers read; a server has a ring for each of its clients. A KEEP_ALL reader
//! skips no untaken message. A KEEP_LAST reader keeps the newest untaken messages of each client or server, up to
//! its depth, and skips older ones. No message within the depth is dropped to make room while its reader lives.

use axon_shm::{Sample, ShmError};

use crate::{
    ids::Gid,
    session::{
        endpoint_state::{NewDataCallback, PublisherInner, SubscriptionInner},
        error::SessionError,
        handle::Session,
    },
};

/// Takes the next message of one writer, in place.
pub(super) fn take_from_one(
    inner: &SubscriptionInner,
    session: &Session,
    writer: &Gid,
) -> Option<Sample> {
    if session.is_forked() {
        return None;
    }
    inner.sample_of(writer).map(|(sample, _)| sample)
}

/// Waits until a new endpoint is matched in both directions.
pub(super) fn await_both(writes: &PublisherInner, reads: &SubscriptionInner, session: &Session) {
    session.shared().await_pairs(&writes.endpoint, |other| {
        writes.events.is_matched(other) && reads.events.is_matched(other)
    });
}

/// Returns the endpoints that are attached in both directions.
pub(super) fn both(
    writes: &PublisherInner,
    reads: &SubscriptionInner,
    session: &Session,
) -> Vec<Gid> {
    if session.is_forked() {
        return Vec::new();
    }
    let mut gids = reads.events.matched_now();
    gids.retain(|gid| writes.events.is_matched(gid));
    gids
}

/// Returns the attached endpoints, including ended ones with pending data.
pub(super) fn attached(
    writes: &PublisherInner,
    reads: &SubscriptionInner,
    session: &Session,
) -> Vec<Gid> {
    let mut gids = both(writes, reads, session);
    if !session.is_forked() {
        let leaving = reads.lock().slots().leaving();
        gids.extend(leaving.into_iter().filter(|gid| writes.events.is_matched(gid)));
    }
    gids
}

/// Sets the callback for new messages.
pub(super) fn set_callback(
    inner: &SubscriptionInner,
    callback: Option<NewDataCallback>,
    session: &Session,
) -> Result<(), SessionError> {
    if session.is_forked() {
        return Err(ShmError::Forked.into());
    }
    Ok(inner.set_on_new_sample(callback, session.core())?)
}
