//! One QUIC connection and its control stream.

use std::{
    collections::HashMap,
    net::{IpAddr, SocketAddr},
    time::Duration,
};

use axon_envelope::Route;
use axon_transport::status::LinkStatus;
use quinn_proto::{ConnectionHandle, StreamId, Transmit};
use rustls_pki_types::CertificateDer;

use super::{
    answers::{AnswerWatch, Exchange},
    burst::DatagramBurst,
    control_stream::ControlStream,
    copies::{CopyBatch, CopyStreams, SampleCopy},
    link_rate::LinkRate,
};
use crate::{
    engine::{
        congestion::marks::marks_reported,
        limits::{Egress, InterfaceLimits},
        rank::{Class, FlowId, Priorities, Rank},
        rings::RingSample,
        sample::{frames::Frames, protection::Seal, stream_header::StreamHeader},
    },
    owner::{ChannelBinding, EXPORTER},
};

/// Most bulk that QUIC holds, in bytes. Below this limit QUIC holds the congestion window and a little more: the bytes
/// in flight, and the bytes that leave before the next pass. All other bulk waits in the flows, where a newer sample
/// can replace it.
const MOST_BULK: u64 = 16 << 20;
/// Bulk that QUIC holds beyond the congestion window, in bytes, but at most half of the window and at least an eighth
/// of it. On a slow path 64 KiB would take a quarter of a second.
const AHEAD: u64 = 64 << 10;
/// Interval between measurements of the share of lost packets, and least number of packets in a measurement.
const LOSS_EVERY: (Duration, u64) = (Duration::from_millis(100), 20);
/// A share of lost packets below this does not raise the amount of bulk.
const NOTABLE_LOSS: f64 = 0.001;
/// A link that loses at least this share of its packets counts as lossy.
const LOSES: f64 = 0.01;
/// Maximum factor by which loss raises the amount of bulk.
const MOST_ROUNDS: f64 = 6.0;
/// Additional bytes that QUIC holds for all other classes.
const RESERVE: u64 = 1 << 20;
/// If a limit lets fewer bytes than [`RESERVE`] leave in this time, QUIC holds that number instead.
const RESERVE_TIME: Duration = Duration::from_millis(80);

/// A QUIC connection.
pub(crate) struct Connection {
    /// The endpoint that it belongs to.
    pub(in crate::engine) endpoint: usize,
    /// The handle of the connection at the endpoint.
    pub(in crate::engine) handle: ConnectionHandle,
    /// The peer's address at the start of the connection: the peer received the packets of the handshake there.
    pub(in crate::engine) began_at: SocketAddr,
    /// The address of this host that packets leave from, if it is known.
    local: Option<IpAddr>,
    /// The connection.
    pub(in crate::engine) quic: quinn_proto::Connection,
    /// The control stream.
    pub(in crate::engine) control: ControlStream,
    /// The flow of each data stream that this side opened.
    pub(in crate::engine) flows: HashMap<StreamId, FlowId>,
    /// The limits on its output.
    pub(in crate::engine) egress: Egress,
    /// The share of lost packets.
    loss: PacketLoss,
    /// The rate that the connection carries.
    rate: LinkRate,
    /// The datagrams that leave together.
    pub(in crate::engine) burst: DatagramBurst,
    /// True if it is in the list of connections with something to do.
    pub(in crate::engine) is_dirty: bool,
    /// True if it is in the list of connections that may transmit.
    pub(in crate::engine) is_transmitting: bool,
    /// The deadline under which the engine knows it.
    pub(in crate::engine) deadline: Option<std::time::Instant>,
    /// The number of datagrams that arrived with an ECN mark.
    pub(in crate::engine) ecn_marks: u64,
    /// Since when the peer has not answered, if both hosts have two paths.
    pub(in crate::engine) watch: Option<AnswerWatch>,
    /// The copies of samples in flight, which left while it stood by.
    pub(in crate::engine) copies: CopyStreams,
}

impl Connection {
    pub(in crate::engine) fn new(
        endpoint: usize,
        handle: ConnectionHandle,
        quic: quinn_proto::Connection,
    ) -> Self {
        Self {
            endpoint,
            handle,
            began_at: quic.remote_address(),
            local: None,
            quic,
            control: ControlStream::default(),
            flows: HashMap::new(),
            egress: Egress::default(),
            loss: PacketLoss::default(),
            rate: LinkRate::default(),
            burst: DatagramBurst::default(),
            is_dirty: false,
            is_transmitting: false,
            deadline: None,
            ecn_marks: 0,
            watch: None,
            copies: CopyStreams::default(),
        }
    }

    /// Handles a datagram that came to this address of this host. A server's packets leave from the address at which
    /// the connection began. The kernel chooses the address of a client's packets; it is taken for the address at which
    /// the peer's packets arrive.
    pub(in crate::engine) fn set_local(
        &mut self,
        came_to: Option<IpAddr>,
        limits: &mut InterfaceLimits,
    ) {
        let local = self.quic.local_ip().or(came_to);
        if local.is_some() && self.local != local {
            self.local = local;
            self.limit_interface(limits);
            limits.handle_address();
        }
    }

    /// Returns the address of this host that packets leave from, if it is known.
    pub(in crate::engine) fn local(&self) -> Option<IpAddr> {
        self.local
    }

    /// Applies the limits of the interface that packets leave by.
    pub(in crate::engine) fn limit_interface(&mut self, limits: &InterfaceLimits) {
        let Some(local) = self.local else { return };
        self.egress.set_interface(limits, local);
        if limits.misses(local) {
            tracing::warn!(address = %local, "no network interface has the address of a link: no limit of an interface \
                                              acts on it");
        }
    }

    /// Returns the peer's certificates, or its raw public key.
    pub(in crate::engine) fn peer_chain(&self) -> Vec<CertificateDer<'static>> {
        let shown = self.quic.crypto_session().peer_identity();
        shown.and_then(|shown| shown.downcast().ok()).map(|shown| *shown).unwrap_or_default()
    }

    /// Returns bytes that both ends of the connection share and no other connection has.
    pub(in crate::engine) fn binding(&self) -> Option<ChannelBinding> {
        let mut binding = [0; 32];
        let session = self.quic.crypto_session();
        session.export_keying_material(&mut binding, EXPORTER, b"").ok()?;
        Some(binding)
    }

    /// Adds QUIC's measurements to the link's status.
    pub(in crate::engine) fn fill(&self, status: &mut LinkStatus) {
        let path = self.quic.stats().path;
        status.address = self.quic.remote_address().to_string();
        status.rtt = self.quic.rtt();
        status.rtt_min = self.quic.min_rtt();
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
        status.limits.extend(self.egress.interface_status());
    }

    /// Counts packets that leave, with their headers of IP and UDP.
    pub(in crate::engine) fn count_sent(&mut self, transmit: &Transmit, now: Duration) {
        if let Some(watch) = &mut self.watch {
            watch.handle_sent(|| Exchange::from(&self.quic.stats()), now);
        }
        let each = transmit.segment_size.unwrap_or(transmit.size).max(1);
        let packets = transmit.size.div_ceil(each);
        self.burst.handle_sent(packets);
        let packets = packets as u64;
        let headers = if transmit.destination.is_ipv4() { 28 } else { 48 };
        self.egress.sent(packets, transmit.size as u64 + packets * headers, now);
    }

    /// Returns the connection as a carrier of samples.
    pub(in crate::engine) fn carrier<'a>(
        &'a mut self,
        seal: Seal<'a>,
        now: Duration,
    ) -> Carrier<'a> {
        let window = self.quic.congestion_state().window();
        let window = self.egress.window(window, self.quic.rtt());
        self.loss.measure(&self.quic, now);
        let rounds = self.loss.rounds(window, self.quic.current_mtu());
        let ahead = AHEAD.min(window / 2).max(window / 8);
        let bulk = (((window + ahead) as f64 * rounds) as u64).min(MOST_BULK);
        Carrier {
            quic: &mut self.quic,
            seal,
            streams: &mut self.flows,
            flow: 0,
            priorities: Priorities::default(),
            lender: None,
            closed_from: None,
            taken: 0,
            window,
            bulk,
            reserve: self.egress.window(RESERVE, RESERVE_TIME),
            loses: self.loss.share >= LOSES,
            rate: self.rate.get(now).into_iter().chain(self.egress.rate()).reduce(f64::min),
            measured: &mut self.rate,
            burst: &mut self.burst,
            copies: CopyBatch::default(),
        }
    }
}

/// The recent share of lost packets.
#[derive(Debug, Default)]
struct PacketLoss {
    /// The time of the next measurement.
    due: Duration,
    /// Packets sent and lost at the last measurement.
    sent: u64,
    lost: u64,
    share: f64,
}

impl PacketLoss {
    fn measure(&mut self, quic: &quinn_proto::Connection, now: Duration) {
        if now < self.due {
            return;
        }
        let path = quic.stats().path;
        let sent = path.sent_packets.saturating_sub(self.sent);
        self.due = now + LOSS_EVERY.0;
        if sent < LOSS_EVERY.1 {
            return;
        }
        let lost = path.lost_packets.saturating_sub(self.lost) as f64 / sent as f64;
        (self.sent, self.lost) = (path.sent_packets, path.lost_packets);
        self.share += (lost.min(0.9) - self.share) / 2.0;
    }

    /// Returns the number of windows of bulk that QUIC needs to keep the path full. QUIC counts all bytes of a stream
    /// from the first unacknowledged one. All but one packet of a window of n packets have arrived after r rounds,
    /// where `share` to the power of r is 1/n. The bytes that were sent in these rounds behind the last packet count
    /// too.
    fn rounds(&self, window: u64, mtu: u16) -> f64 {
        if self.share < NOTABLE_LOSS {
            return 1.0;
        }
        let packets = (window as f64 / f64::from(mtu)).max(2.0);
        (1.0 + packets.ln() / -self.share.ln()).min(MOST_ROUNDS)
    }
}

/// A connection that carries samples, for one pass.
pub(crate) struct Carrier<'a> {
    /// The connection.
    pub(in crate::engine) quic: &'a mut quinn_proto::Connection,
    /// The protection of the messages.
    pub(in crate::engine) seal: Seal<'a>,
    /// The flow of each stream.
    pub(in crate::engine) streams: &'a mut HashMap<StreamId, FlowId>,
    /// The current flow.
    pub(in crate::engine) flow: FlowId,
    /// The priorities of the routes.
    pub(in crate::engine) priorities: Priorities,
    /// The rank as which the flow sends, if it is not its own.
    pub(in crate::engine) lender: Option<Rank>,
    /// The place of the highest rank whose flows wait for credit.
    pub(in crate::engine) closed_from: Option<usize>,
    /// Bytes that QUIC took in this pass.
    pub(in crate::engine) taken: u64,
    window: u64,
    bulk: u64,
    /// Additional bytes that QUIC may hold for all other classes.
    reserve: u64,
    /// True if the link loses packets.
    pub(in crate::engine) loses: bool,
    /// The rate that the link carries in bytes per second, if the link was full lately or a limit states the rate.
    pub(in crate::engine) rate: Option<f64>,
    measured: &'a mut LinkRate,
    burst: &'a mut DatagramBurst,
    /// The copies that are to leave over the link that stands by.
    pub(in crate::engine) copies: CopyBatch,
}

impl Carrier<'_> {
    /// Copies a sample for the second path. Where samples have envelopes, the copy has one of its own, because envelopes are
    /// bound to their connection. It does not leave if it has no key.
    pub(in crate::engine) fn copy(
        &mut self,
        header: StreamHeader,
        route: Route,
        sample: &RingSample,
        after: u64,
        now: Duration,
    ) {
        if !self.copies.takes(&header, sample.payload.len()) {
            return;
        }
        let mut frames = Frames::default();
        if self.seal.write_copy(sample, route, self.copies.connection, &mut frames, now).is_ok() {
            let frames = frames.take();
            self.copies.add(SampleCopy { header, after, frames });
        }
    }

    /// Returns the congestion window in bytes.
    pub(in crate::engine) fn window(&self) -> u64 {
        self.window
    }

    /// Returns the bytes that QUIC may hold while a flow of this rank writes. Bytes of lower priorities do not block a
    /// higher priority.
    pub(in crate::engine) fn limit_of(&self, rank: Rank) -> u64 {
        let reserve = if rank.class == Class::Bulk { 0 } else { self.reserve };
        (1 + self.priorities.below(rank.priority)) * self.bulk + reserve
    }

    /// Returns the rank as which a flow of this rank writes.
    pub(in crate::engine) fn rank(&self, own: Rank) -> Rank {
        self.lender.unwrap_or(own)
    }

    /// Returns whether a flow of this rank may use credit: no flow of its rank or a higher one waits for credit.
    pub(in crate::engine) fn is_open_to(&self, own: Rank) -> bool {
        self.closed_from.is_none_or(|place| self.rank(own).place() < place)
    }

    /// Sets the bytes that QUIC may hold while a flow of this rank writes.
    pub(in crate::engine) fn limit(&mut self, rank: Rank) {
        self.quic.set_send_window(self.limit_of(rank));
    }

    /// Ends the pass. QUIC reports that it takes more bytes once it would take more of each blocked flow: `least` is
    /// the least of their limits. With a higher value it would report at once, and again and again, if it took more of
    /// one flow while another cannot write because the peer does not read its stream. A flow with a higher limit has
    /// samples in QUIC until then. The link `is_full` while a flow waits for QUIC.
    pub(in crate::engine) fn rest(&mut self, least: Option<u64>, is_full: bool, now: Duration) {
        self.quic.set_send_window(least.unwrap_or(self.bulk));
        self.burst.set_full(is_full);
        let left = || {
            let stats = self.quic.stats();
            stats.udp_tx.bytes.saturating_sub(stats.path.lost_bytes)
        };
        self.measured.handle_pass(now, is_full, left, self.window, self.quic.rtt());
    }
}
