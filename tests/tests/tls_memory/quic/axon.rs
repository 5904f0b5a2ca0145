//! The glue on rustls-axon.

use std::sync::Arc;

pub(super) use rustls_axon as tls;

#[path = "../../../../axon-tls/src/quic/session.rs"]
#[allow(clippy::duplicate_mod, reason = "each copy is made for another `tls`")]
mod session;

pub(crate) fn client(config: tls::ClientConfig) -> Arc<dyn quinn::crypto::ClientConfig> {
    Arc::new(session::Client::new(config))
}

pub(crate) fn server(config: tls::ServerConfig) -> Arc<dyn quinn::crypto::ServerConfig> {
    Arc::new(session::Server::new(config))
}

fn negotiated(_: &tls::CommonState) -> Option<bool> {
    None
}
