//! axon-tls's glue between quinn and rustls-axon, for configurations of a test's own.

#[allow(dead_code, reason = "the tests have a client alone")]
#[path = "../tls_memory/quic/axon.rs"]
pub(crate) mod axon;
#[allow(dead_code, reason = "a client makes no Retry")]
#[path = "../../../axon-tls/src/quic/protection.rs"]
mod protection;
