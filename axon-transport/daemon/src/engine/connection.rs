//! One QUIC connection and its control stream.

use std::{collections::HashMap, time::Duration};

use axon_transport::status::LinkStatus;
use quinn_proto::{ConnectionHandle, StreamId};

use super::{
    control::Control,
    marks::marks_reported,
    outbound::{Class, FlowId},
    protection::Seal,
};

/// Bulk that QUIC holds, at least and at most. Between them it is the congestion window and a little more: as much as
/// may be on the way, and what leaves before the next pass. All else waits in the flows, where a newer sample can
/// replace it.
const BULK: (u64, u64) = (128 << 10, 16 << 20);
/// Bulk that QUIC holds beyond the congestion window, at least.
const AHEAD: u64 = 64 << 10;
/// Bytes more that QUIC holds for all other classes.
const RESERVE: u64 = 1 << 20;

/// A QUIC connection.
pub(crate) struct Connection {
    /// The endpoint that it belongs to.
    pub(super) endpoint: usize,
    /// Its name at the endpoint.
    pub(super) handle: ConnectionHandle,
    /// The connection.
    pub(super) quic: quinn_proto::Connection,
    /// Its control stream.
    pub(super) control: Control,
    /// The flow of each data stream that this side opened.
    pub(super) flows: HashMap<StreamId, FlowId>,
    /// Whether it is in the list of connections with something to do.
    pub(super) is_dirty: bool,
    /// Whether it is in the list of connections that may transmit.
    pub(super) is_transmitting: bool,
    /// The deadline under which the engine knows it.
    pub(super) deadline: Option<std::time::Instant>,
    /// Datagrams that came with an ECN mark.
    pub(super) ecn_marks: u64,
}

impl Connection {
    pub(super) fn new(
        endpoint: usize,
        handle: ConnectionHandle,
        quic: quinn_proto::Connection,
    ) -> Self {
        Self {
            endpoint,
            handle,
            quic,
            control: Control::default(),
            flows: HashMap::new(),
            is_dirty: false,
            is_transmitting: false,
            deadline: None,
            ecn_marks: 0,
        }
    }

    /// Adds what QUIC measures to the link's status.
    pub(super) fn fill(&self, status: &mut LinkStatus) {
        let path = self.quic.stats().path;
        let micros = |time: Duration| u64::try_from(time.as_micros()).unwrap_or(u64::MAX);
        status.address = self.quic.remote_address().to_string();
        status.rtt_us = micros(self.quic.rtt());
        status.rtt_min_us = micros(self.quic.min_rtt());
        status.congestion_window = path.cwnd;
        status.congestion_events = path.congestion_events;
        status.packets_sent = path.sent_packets;
        status.packets_lost = path.lost_packets;
        status.bytes_lost = path.lost_bytes;
        status.mtu = path.current_mtu.into();
        status.mtu_black_holes = path.black_holes_detected;
        status.ecn_marks_in = self.ecn_marks;
        status.ecn_marks_out = marks_reported(&self.quic);
        status.waiting.control = self.control.queued() as u64;
    }

    /// The connection as a carrier of samples.
    pub(super) fn carrier<'a>(&'a mut self, seal: Seal<'a>) -> Carrier<'a> {
        let window = self.quic.congestion_state().window();
        let bulk = (window + AHEAD.max(window / 8)).clamp(BULK.0, BULK.1);
        Carrier {
            quic: &mut self.quic,
            seal,
            streams: &mut self.flows,
            flow: 0,
            taken: 0,
            window,
            bulk,
        }
    }
}

/// A connection that carries samples, for one pass.
pub(crate) struct Carrier<'a> {
    /// The connection.
    pub(super) quic: &'a mut quinn_proto::Connection,
    /// Protects the messages.
    pub(super) seal: Seal<'a>,
    /// The flow of each stream.
    pub(super) streams: &'a mut HashMap<StreamId, FlowId>,
    /// The flow whose turn it is.
    pub(super) flow: FlowId,
    /// Bytes that QUIC took in this pass.
    pub(super) taken: u64,
    window: u64,
    bulk: u64,
}

impl Carrier<'_> {
    /// The congestion window in bytes.
    pub(super) fn window(&self) -> u64 {
        self.window
    }

    /// Lets QUIC take what it may hold while a flow of this class writes.
    pub(super) fn limit(&mut self, class: Class) {
        let reserve = if class == Class::Bulk { 0 } else { RESERVE };
        self.quic.set_send_window(self.bulk + reserve);
    }

    /// Ends the pass. QUIC says that it takes more once it would of those that are blocked.
    pub(super) fn rest(&mut self, small_blocked: bool) {
        let reserve = if small_blocked { RESERVE } else { 0 };
        self.quic.set_send_window(self.bulk + reserve);
    }
}
