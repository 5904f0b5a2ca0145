//! Checks after each pass that the memory of a host stays within its bounds, for any behaviour of its peers.

use crate::{
    engine::{Engine, quic::transport::STREAMS_OPEN},
    link::MAX_FRAME,
};

/// Links, as `links/election.rs` limits them.
const LINKS: usize = 160;
/// Links that stand by, as `links/paths/places.rs` limits them.
const STANDBY: usize = 64;
/// Copies of one peer that wait, as `inbound/copies.rs` limits them.
const COPIES: usize = 32;
/// Connections that are being opened: 64, and 16 of listed peers, that were dialled to this host, and its own dials.
const OPENING: usize = 64 + 16;
/// Bytes of the messages of one identity that have not all come, as `engine/account` limits them.
const OF_IDENTITY: usize = 80 << 20;
/// Additional bytes that a stream may hold: the rest of a packet, or a message that came in one.
const OF_STREAM: usize = 9_000;
/// A message beyond the memory of the identity, for each daemon id.
const SPARE: usize = 32 << 10;
/// Control messages of one connection that wait to be sent.
const UNSENT: usize = (64 << 20) + MAX_FRAME;
/// Maximum number of unread bytes of one connection, as `transport.rs` limits it.
const UNREAD: usize = 65 << 20;

/// Checks the bounds of a host that recently began `dials` dials.
///
/// # Panics
/// It holds more than it may.
pub(super) fn check(engine: &Engine, queue: usize, dials: usize) {
    let held = engine.links.held();
    assert!(held.links - held.standby <= LINKS && held.standby <= STANDBY, "{held:?}");
    assert!(held.opening <= OPENING + dials && held.dials <= dials, "{held:?}, {dials} dials");
    // The same number may be closed; they are forgotten after three probe timeouts.
    let open = LINKS + STANDBY + OPENING + dials;
    assert!(held.connections <= 2 * open, "{held:?}");
    assert!(held.unsent <= UNSENT && held.unhandled <= UNREAD, "{held:?}");
    // Control messages are handled one by one, so all events that a pass leaves to the next belong to data streams.
    assert!(held.events <= STREAMS_OPEN as usize * (held.links + 1), "{held:?}");
    let mut identities = std::collections::HashMap::new();
    for (_, peer) in engine.peers.iter() {
        let (streams, bytes) = peer.inbound.held();
        let most = 8 * STREAMS_OPEN as usize;
        assert!(streams <= most, "{streams} streams of one peer");
        assert!(peer.inbound.waiting_copies() <= COPIES);
        assert!(peer.inbound.listed() <= streams, "{} entries", peer.inbound.listed());
        let account = std::rc::Rc::as_ptr(peer.remote.account());
        let (held, most) = identities.entry(account).or_insert((0, OF_IDENTITY));
        *held += bytes;
        *most += SPARE + streams * OF_STREAM;
    }
    for (held, most) in identities.into_values() {
        assert!(held <= most, "{held} bytes of one identity have not come whole or wait for rings");
    }
    // One sample a flow may be more: none is longer than 64 MiB.
    let (waiting, _) = engine.backlog();
    assert!(waiting <= queue + (64 << 20), "{waiting} bytes wait, {queue} are allowed");
}
