//! The parts of QUIC that the engine uses: endpoints, connections with their control stream, and the settings of both.

pub(crate) mod answers;
pub(crate) mod burst;
pub(crate) mod connection;
pub(crate) mod control_stream;
pub(crate) mod copies;
pub(crate) mod endpoints;
pub(crate) mod link_rate;
pub(crate) mod qlog;
pub(crate) mod tls_settings;
pub(crate) mod transport;
