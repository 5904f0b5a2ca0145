//! What status says of a link.

use std::net::SocketAddr;

use axon_tls::{Negotiated, identity::Auth};
use quinn::Connection;

use super::{context::Context, hub::Summary};
use crate::{daemon::status::LinkStatus, link::Hello};

/// As whom the peer proved itself, in words.
pub(super) fn authenticated_as(
    context: &Context,
    hello: &Hello,
    negotiated: &Negotiated,
) -> String {
    if let (Some(_), Some(sae)) = (&context.keyring, &hello.sae) {
        return format!("SAE {sae} (KME key)");
    }
    let Some(peer) = &negotiated.peer else { return "UNAUTHENTICATED".into() };
    match context.auth() {
        Some(Auth::Pinned { trust, .. }) => {
            // The name can be gone by now: a pin that was removed after the handshake.
            let name = trust.name_of(peer).unwrap_or_else(|| "unpinned".into());
            format!("{name} ({peer})")
        }
        Some(Auth::Ca(_)) => format!("{} (certificate, {peer})", hello.host),
        _ => format!("UNAUTHENTICATED (key {peer})"),
    }
}

/// Tells whether two daemons are on the same host, by what they proved: the SAE, the pinned key, or
/// with nothing proven the address.
pub(super) fn host_identity(summary: &Summary, address: SocketAddr) -> String {
    match (&summary.hello.sae, &summary.negotiated.peer) {
        (Some(sae), _) => format!("sae {sae}"),
        (None, Some(peer)) if !summary.authenticated_as.starts_with("UNAUTHENTICATED") => {
            format!("key {peer}")
        }
        _ => format!("address {}", address.ip()),
    }
}

/// The status of a link, its counters aside.
pub(super) fn link(summary: &Summary, connection: &Connection, since_unix_ms: u64) -> LinkStatus {
    LinkStatus {
        peer: summary.hello.daemon.to_string(),
        host: summary.hello.host.clone(),
        sae: summary.hello.sae.clone(),
        address: connection.remote_address().to_string(),
        state: "connected".into(),
        key_exchange: summary.negotiated.key_exchange.to_string(),
        cipher: summary.negotiated.cipher.name().into(),
        authenticated_as: summary.authenticated_as.clone(),
        since_unix_ms,
        rtt_us: u64::try_from(connection.rtt().as_micros()).unwrap_or(u64::MAX),
        ..LinkStatus::default()
    }
}
