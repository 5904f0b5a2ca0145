//! The qlog events of each QUIC connection.
//!
//! QUIC writes the headers of packets, losses, and the measurements of its congestion controller. It writes no payload.
//! The events contain the address of the peer and no text that a peer chose, such as a name.

use std::{io, net::SocketAddr, time::Instant};

use quinn_proto::{QlogConfig, QlogStream};

use crate::link::Side;

/// The destination of the events. The daemon writes to files, and no call here waits for them.
pub(crate) trait Qlogs {
    /// Returns a writer for the events of a new connection. Its writes never fail: QUIC would log each failure.
    fn open(&self, side: Side) -> Option<Box<dyn io::Write + Send + Sync>>;
}

/// Returns the stream of a new connection's events, if they are written.
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
