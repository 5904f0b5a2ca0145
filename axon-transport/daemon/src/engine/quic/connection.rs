//! One QUIC connection and its control stream.

use std::{
    collections::HashMap,
    net::{IpAddr, SocketAddr},
    time::Duration,
};

use axon_transport::status::LinkStatus;
use quinn_proto::{ConnectionHandle, StreamId, Transmit};
use rustls_pki_types::CertificateDer;

use super::{control_stream::ControlStream, link_rate::LinkRate};
use crate::{
    engine::{
        congestion::marks::marks_reported,
        limits::{Egress, InterfaceLimits},
        rank::{Class, FlowId, Priorities, Rank},
        sample::protection::Seal,
    },
    owner::{ChannelBinding, EXPORTER},
};

/// Bulk that QUIC holds at most. Below that it is the congestion window and a little more: as much as may be on the
/// way, and what leaves before the next pass. All else waits in the flows, where a newer sample can replace it.
const MOST_BULK: u64 = 16 << 20;
/// Bulk that QUIC holds beyond the congestion window: so much, or half as much as a smaller window, or an eighth of a
/// larger one. On a slow path 64 KiB would take a quarter of a second.
const AHEAD: u64 = 64 << 10;
/// How often the share of lost packets is measured, and how many packets make a measure.
const LOSS_EVERY: (Duration, u64) = (Duration::from_millis(100), 20);
/// Loss below this asks for no more bulk.
const NOTABLE_LOSS: f64 = 0.001;
/// A link that loses this share of its packets, or more, is one that loses packets.
const LOSES: f64 = 0.01;
/// Times that bulk is multiplied under loss, at most.
const MOST_ROUNDS: f64 = 6.0;
/// Bytes more that QUIC holds for all other classes.
const RESERVE: u64 = 1 << 20;
/// Where a limit lets less leave in this time, it holds that.
const RESERVE_TIME: Duration = Duration::from_millis(80);

/// A QUIC connection.
pub(crate) struct Connection {
    /// The endpoint that it belongs to.
    pub(in crate::engine) endpoint: usize,
    /// Its name at the endpoint.
    pub(in crate::engine) handle: ConnectionHandle,
    /// Where the peer was when the connection began: there it received what the handshake needs.
    pub(in crate::engine) began_at: SocketAddr,
    /// The address of this host that packets leave from, as far as it is known.
    local: Option<IpAddr>,
    /// The connection.
    pub(in crate::engine) quic: quinn_proto::Connection,
    /// Its control stream.
    pub(in crate::engine) control: ControlStream,
    /// The flow of each data stream that this side opened.
    pub(in crate::engine) flows: HashMap<StreamId, FlowId>,
    /// The limits on what it sends.
    pub(in crate::engine) egress: Egress,
    /// How much is lost on the way.
    loss: PacketLoss,
    /// How much it carries.
    rate: LinkRate,
    /// Whether it is in the list of connections with something to do.
    pub(in crate::engine) is_dirty: bool,
    /// Whether it is in the list of connections that may transmit.
    pub(in crate::engine) is_transmitting: bool,
    /// The deadline under which the engine knows it.
    pub(in crate::engine) deadline: Option<std::time::Instant>,
    /// Datagrams that came with an ECN mark.
    pub(in crate::engine) ecn_marks: u64,
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
            is_dirty: false,
            is_transmitting: false,
            deadline: None,
            ecn_marks: 0,
        }
    }

    /// A datagram came to this address of this host. A server's packets leave from the address that the connection began
    /// at; where those of a client leave, the kernel decides, and it is taken for the interface that the peer's come by.
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

    /// Keeps to the limits on the interface that packets leave by.
    pub(in crate::engine) fn limit_interface(&mut self, limits: &InterfaceLimits) {
        let Some(local) = self.local else { return };
        self.egress.set_interface(limits, local);
        if limits.misses(local) {
            tracing::warn!(address = %local, "no network interface has the address of a link: no limit of an interface \
                                              acts on it");
        }
    }

    /// The certificates, or the raw public key, that the peer showed.
    pub(in crate::engine) fn peer_chain(&self) -> Vec<CertificateDer<'static>> {
        let shown = self.quic.crypto_session().peer_identity();
        shown.and_then(|shown| shown.downcast().ok()).map(|shown| *shown).unwrap_or_default()
    }

    /// Bytes that both ends of the connection share and no other connection has.
    pub(in crate::engine) fn binding(&self) -> Option<ChannelBinding> {
        let mut binding = [0; 32];
        let session = self.quic.crypto_session();
        session.export_keying_material(&mut binding, EXPORTER, b"").ok()?;
        Some(binding)
    }

    /// Adds what QUIC measures to the link's status.
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

    /// These packets leave: they count with the headers of IP and UDP.
    pub(in crate::engine) fn count_sent(&self, transmit: &Transmit, now: Duration) {
        let each = transmit.segment_size.unwrap_or(transmit.size).max(1);
        let packets = transmit.size.div_ceil(each) as u64;
        let headers = if transmit.destination.is_ipv4() { 28 } else { 48 };
        self.egress.sent(packets, transmit.size as u64 + packets * headers, now);
    }

    /// The connection as a carrier of samples.
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
        }
    }
}

/// The share of packets that are lost lately.
#[derive(Debug, Default)]
struct PacketLoss {
    /// When it is measured again.
    due: Duration,
    /// Packets sent and lost at the last measure.
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

    /// Windows of bulk that QUIC needs to keep the path full. It counts all bytes of a stream from the first one that
    /// is not acknowledged. Of a window of n packets all but one have arrived after as many rounds as it takes until
    /// `share` to their power is 1/n; what was sent in these rounds behind the last one counts too.
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
    /// Protects the messages.
    pub(in crate::engine) seal: Seal<'a>,
    /// The flow of each stream.
    pub(in crate::engine) streams: &'a mut HashMap<StreamId, FlowId>,
    /// The flow whose turn it is.
    pub(in crate::engine) flow: FlowId,
    /// The priorities of the routes.
    pub(in crate::engine) priorities: Priorities,
    /// The rank as which the flow sends, where that is another one than its own.
    pub(in crate::engine) lender: Option<Rank>,
    /// The place of the highest rank of which flows wait for credit.
    pub(in crate::engine) closed_from: Option<usize>,
    /// Bytes that QUIC took in this pass.
    pub(in crate::engine) taken: u64,
    window: u64,
    bulk: u64,
    /// What QUIC may hold more of all other classes.
    reserve: u64,
    /// Whether the link loses packets.
    pub(in crate::engine) loses: bool,
    /// Bytes a second that the link carries, if it was full lately or a limit says it.
    pub(in crate::engine) rate: Option<f64>,
    measured: &'a mut LinkRate,
}

impl Carrier<'_> {
    /// The congestion window in bytes.
    pub(in crate::engine) fn window(&self) -> u64 {
        self.window
    }

    /// What QUIC may hold while a flow of this rank writes. What others filled is no obstacle to a higher priority.
    pub(in crate::engine) fn limit_of(&self, rank: Rank) -> u64 {
        let reserve = if rank.class == Class::Bulk { 0 } else { self.reserve };
        (1 + self.priorities.below(rank.priority)) * self.bulk + reserve
    }

    /// The rank as which a flow of this rank writes.
    pub(in crate::engine) fn rank(&self, own: Rank) -> Rank {
        self.lender.unwrap_or(own)
    }

    /// Whether a flow of this rank may use credit: none of its rank or a higher one waits for some.
    pub(in crate::engine) fn is_open_to(&self, own: Rank) -> bool {
        self.closed_from.is_none_or(|place| self.rank(own).place() < place)
    }

    /// Lets QUIC take what it may hold while a flow of this rank writes.
    pub(in crate::engine) fn limit(&mut self, rank: Rank) {
        self.quic.set_send_window(self.limit_of(rank));
    }

    /// Ends the pass. QUIC says that it takes more once it would of each flow that is blocked: `least` is the least of
    /// their limits. It would say so at once, and again and again, if it took more of one while another cannot write,
    /// whose stream the peer does not read. A flow with a higher limit has samples in QUIC until then.
    /// The link `is_full` while a flow waits for QUIC.
    pub(in crate::engine) fn rest(&mut self, least: Option<u64>, is_full: bool, now: Duration) {
        self.quic.set_send_window(least.unwrap_or(self.bulk));
        let left = || {
            let stats = self.quic.stats();
            stats.udp_tx.bytes.saturating_sub(stats.path.lost_bytes)
        };
        self.measured.handle_pass(now, is_full, left, self.window, self.quic.rtt());
    }
}
