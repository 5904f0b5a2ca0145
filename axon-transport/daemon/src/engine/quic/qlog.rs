//! QUIC's events of each connection, in the format qlog.
//!
//! QUIC writes the headers of packets, losses, and what its congestion controller measures. It writes no payload. What
//! is written says the address of the peer and nothing that a peer chose, such as a name.

use std::{io, net::SocketAddr, time::Instant};

use quinn_proto::{QlogConfig, QlogStream};

use crate::link::Side;

/// Where the events go. The daemon has files, which no call here waits for.
pub(crate) trait Qlogs {
    /// A writer for the events of a new connection. Its writes never fail: QUIC would log each failure.
    fn open(&self, side: Side) -> Option<Box<dyn io::Write + Send + Sync>>;
}

/// The stream of a new connection's events, where they are written.
pub(in crate::engine) fn stream(
    qlogs: Option<&dyn Qlogs>,
    side: Side,
    peer: SocketAddr,
    now: Instant,
) -> Option<QlogStream> {
    let writer = qlogs?.open(side)?;
    let mut config = QlogConfig::default();
    let role = match side {
        Side::Client => "client",
        Side::Server => "server",
    };
    config
        .writer(writer)
        .title(Some(format!("axon {}", env!("CARGO_PKG_VERSION"))))
        .description(Some(format!("{role}, peer at {peer}")))
        .start_time(now);
    config.into_stream()
}
