//! axon-tls's glue between quinn and each rustls, for configurations of a test's own.

#[path = "../tls_memory/quic/axon.rs"]
pub(crate) mod axon;
#[allow(dead_code, reason = "nobody here makes a Retry")]
#[path = "../../../axon-tls/src/quic/protection.rs"]
mod protection;
#[path = "../tls_memory/quic/released.rs"]
pub(crate) mod released;
