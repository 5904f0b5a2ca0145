//! The glue on rustls as released.

use std::sync::Arc;

pub(super) use rustls as tls;

#[path = "../../../../axon-tls/src/quic/session.rs"]
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
