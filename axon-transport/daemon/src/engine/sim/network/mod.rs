//! A simulated IPv4 network that carries UDP datagrams between hosts.
//!
//! A packet passes, in this order: the sender's NAT, its interface's rate, the path's MTU, rate, loss, delay and
//! duplication, the receiver's interface's rate, its NAT, and the receive buffer of a paused host. Partitions,
//! addresses and NAT mappings are looked up when the packet is sent and again when it arrives, so a change also hits
//! packets in flight. A packet that is refused when it is sent uses nothing of a rate.
//!
//! The network is plain data. Its time is a `Duration` since the start of the run and does not go back. With
//! one seed and one sequence of calls, its deliveries are the same.

mod counters;
mod nat;
mod path;
mod queue;
mod routes;
mod topology;

#[cfg(test)]
mod tests;

use std::{
    cmp::Reverse,
    collections::{BinaryHeap, HashMap, VecDeque},
    net::{Ipv4Addr, SocketAddr, SocketAddrV4},
    time::Duration,
};

use bytes::Bytes;
use quinn_proto::EcnCodepoint;

pub(crate) use counters::{Cause, Counters};
pub(crate) use nat::Filtering;
pub(crate) use path::{BurstLoss, HEADERS, Path};
pub(crate) use queue::{QueueLimit, Rate};
pub(crate) use topology::{CutId, NatId};

use nat::Nat;
use path::{Fate, Link, mark};
use queue::Backlog;
use routes::Route;
use topology::{Cut, Owner};

/// Time that a packet of a host to itself takes. Not 0, so that a host which answers itself lets time pass.
const LOOPBACK_DELAY: u64 = 1_000;
/// Payload bytes that the kernel keeps for a paused host.
pub(crate) const RECEIVE_BUFFER: usize = 4 << 20;

/// A datagram that has arrived at a host.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Delivery {
    /// Index of the host.
    pub(crate) host: usize,
    /// The sender's own address and port, behind the NAT if there is one.
    pub(crate) at: SocketAddr,
    /// The sender, as the receiver sees it.
    pub(crate) from: SocketAddr,
    pub(crate) ecn: Option<EcnCodepoint>,
    pub(crate) bytes: Bytes,
}

/// A simulated network; see the [module](self).
pub(crate) struct Network {
    seed: u64,
    hosts: Vec<Host>,
    interfaces: Vec<Interface>,
    owners: HashMap<Ipv4Addr, Owner>,
    nats: Vec<Nat>,
    default_path: Path,
    /// Index of the link, by sending and receiving interface.
    rows: Vec<Vec<u32>>,
    links: Vec<Link>,
    cuts: Vec<(CutId, Cut)>,
    next_cut: u64,
    /// Time, sequence number and slot of each packet on its way.
    arrivals: BinaryHeap<Reverse<(u64, u64, u32)>>,
    sequence: u64,
    packets: Vec<Option<Packet>>,
    free: Vec<u32>,
    packets_in_flight: usize,
    bytes_in_flight: usize,
    max_packets: usize,
    max_bytes: usize,
    unknown_source: u64,
}

struct Host {
    listening: bool,
    paused: bool,
    buffered: VecDeque<Packet>,
    buffered_bytes: usize,
    counters: Counters,
}

struct Interface {
    host: usize,
    address: Ipv4Addr,
    nat: Option<NatId>,
    /// Ethernet segment: how far its multicast reaches.
    segment: usize,
    up: bool,
    egress: Option<(Rate, Backlog)>,
    ingress: Option<(Rate, Backlog)>,
}

#[derive(Debug)]
struct Packet {
    sender: usize,
    interface: u32,
    stage: Stage,
    from: SocketAddrV4,
    to: SocketAddrV4,
    ecn: Option<EcnCodepoint>,
    bytes: Bytes,
}

/// The progress of a packet at its time of arrival.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Stage {
    /// The packet has reached the end of the path.
    Path,
    /// Through the rate of the receiving interface.
    Interface,
    /// Into the receive buffer; `to` is the receiver's own address.
    Buffer,
}

impl Network {
    /// Creates a network without hosts.
    pub(crate) fn new(seed: u64) -> Self {
        Self {
            seed,
            hosts: Vec::new(),
            interfaces: Vec::new(),
            owners: HashMap::new(),
            nats: Vec::new(),
            default_path: Path::default(),
            rows: Vec::new(),
            links: Vec::new(),
            cuts: Vec::new(),
            next_cut: 0,
            arrivals: BinaryHeap::new(),
            sequence: 0,
            packets: Vec::new(),
            free: Vec::new(),
            packets_in_flight: 0,
            bytes_in_flight: 0,
            max_packets: 1 << 20,
            max_bytes: 1 << 30,
            unknown_source: 0,
        }
    }

    /// Sends `bytes` as one datagram, or as several of `segment_size` bytes with a shorter last one (GSO).
    ///
    /// A datagram from an address that no host has is dropped and counted in
    /// [`unknown_source`](Self::unknown_source).
    pub(crate) fn send(
        &mut self,
        now: Duration,
        from: SocketAddr,
        to: SocketAddr,
        ecn: Option<EcnCodepoint>,
        bytes: &[u8],
        segment_size: Option<usize>,
    ) {
        let now = nanos(now);
        let segment = segment_size.filter(|size| *size > 0).unwrap_or(bytes.len()).max(1);
        let Some((interface, from)) = self.own_address(from) else {
            self.unknown_source += bytes.len().div_ceil(segment).max(1) as u64;
            return;
        };
        let route = self.route(now, interface, from, to);
        let mut rest = bytes;
        loop {
            let (datagram, tail) = rest.split_at(rest.len().min(segment));
            self.send_one(now, interface, &route, ecn, datagram);
            rest = tail;
            if rest.is_empty() {
                return;
            }
        }
    }

    fn send_one(
        &mut self,
        now: u64,
        interface: u32,
        route: &Result<Route, Cause>,
        ecn: Option<EcnCodepoint>,
        bytes: &[u8],
    ) {
        let sender = self.count_sent(interface, bytes.len());
        let fate = route.as_ref().map_err(|cause| *cause).and_then(|route| {
            let Some(link) = route.link else {
                let arrival = now.saturating_add(LOOPBACK_DELAY);
                return Ok((route, Fate { arrival, second_arrival: None, ecn }));
            };
            let (now, ecn) = self.leave(interface, now, bytes.len(), ecn)?;
            Ok((route, self.cross(link, now, bytes.len(), ecn)?))
        });
        match fate {
            Ok((route, fate)) => self.schedule(route, fate, Bytes::copy_from_slice(bytes)),
            Err(cause) => self.hosts[sender].counters.count_drop(cause),
        }
    }

    /// Sends a datagram to `port` of every other host with an interface in the sender's Ethernet segment.
    ///
    /// It takes the sending interface's rate once, and each receiver's path on its own.
    pub(crate) fn send_multicast(
        &mut self,
        now: Duration,
        from: SocketAddr,
        port: u16,
        bytes: &[u8],
    ) {
        let now = nanos(now);
        let Some((interface, from)) = self.own_address(from) else {
            self.unknown_source += 1;
            return;
        };
        let sender = self.count_sent(interface, bytes.len());
        let (now, ecn) = match self.leave(interface, now, bytes.len(), None) {
            Ok(left) => left,
            Err(cause) => return self.hosts[sender].counters.count_drop(cause),
        };
        let shared = Bytes::copy_from_slice(bytes);
        let segment = self.interfaces[interface as usize].segment;
        let mut receivers = 0;
        for to in 0..self.interfaces.len() as u32 {
            let Interface { host, address, segment: its, .. } = self.interfaces[to as usize];
            if its != segment || host == sender {
                continue;
            }
            receivers += 1;
            let to_address = SocketAddrV4::new(address, port);
            let cut = self.is_cut(now, sender, host);
            let link = self.link(interface, to);
            let fate = if cut { Err(Cause::Cut) } else { self.cross(link, now, bytes.len(), ecn) };
            let route = Route { sender, interface: to, link: Some(link), from, to: to_address };
            match fate {
                Ok(fate) => self.schedule(&route, fate, shared.clone()),
                Err(cause) => self.hosts[sender].counters.count_drop(cause),
            }
        }
        let counters = &mut self.hosts[sender].counters;
        match receivers {
            0 => counters.count_drop(Cause::Unreachable),
            _ => counters.copies += receivers - 1,
        }
    }

    fn count_sent(&mut self, interface: u32, bytes: usize) -> usize {
        let sender = self.interfaces[interface as usize].host;
        let counters = &mut self.hosts[sender].counters;
        counters.sent += 1;
        counters.sent_bytes += bytes as u64;
        sender
    }

    /// Takes a packet through the sending interface; returns when it has left.
    fn leave(
        &mut self,
        interface: u32,
        now: u64,
        bytes: usize,
        ecn: Option<EcnCodepoint>,
    ) -> Result<(u64, Option<EcnCodepoint>), Cause> {
        let Interface { up, egress, .. } = &mut self.interfaces[interface as usize];
        match egress {
            _ if !*up => Err(Cause::InterfaceDown),
            None => Ok((now, ecn)),
            Some((rate, backlog)) => {
                let left = backlog.admit(rate, now, bytes + HEADERS).ok_or(Cause::Queue)?;
                Ok((left.at, if left.mark { mark(ecn) } else { ecn }))
            }
        }
    }

    fn cross(
        &mut self,
        link: u32,
        now: u64,
        bytes: usize,
        ecn: Option<EcnCodepoint>,
    ) -> Result<Fate, Cause> {
        self.links[link as usize].cross(&self.default_path, now, bytes + HEADERS, ecn)
    }

    fn schedule(&mut self, route: &Route, fate: Fate, bytes: Bytes) {
        let Route { sender, interface, link, from, to } = *route;
        // A duplicate is received or dropped on its own.
        self.hosts[sender].counters.copies += u64::from(fate.second_arrival.is_some());
        let stage = if link.is_some() { Stage::Path } else { Stage::Interface };
        let packet = |bytes| Packet { sender, interface, stage, from, to, ecn: fate.ecn, bytes };
        if let Some(at) = fate.second_arrival {
            // At one time, the order of two equal packets does not matter.
            self.insert(at, packet(bytes.clone()));
        }
        self.insert(fate.arrival, packet(bytes));
    }

    fn insert(&mut self, at: u64, packet: Packet) {
        let bytes = self.bytes_in_flight + packet.bytes.len();
        if self.packets_in_flight >= self.max_packets || bytes > self.max_bytes {
            return self.hosts[packet.sender].counters.count_drop(Cause::InFlightLimit);
        }
        self.packets_in_flight += 1;
        self.bytes_in_flight = bytes;
        self.sequence += 1;
        let slot = self.free.pop().unwrap_or_else(|| {
            self.packets.push(None);
            self.packets.len() as u32 - 1
        });
        self.packets[slot as usize] = Some(packet);
        self.arrivals.push(Reverse((at, self.sequence, slot)));
    }

    /// Returns when the next packet arrives. [`poll_delivery`](Self::poll_delivery) may then still drop it.
    pub(crate) fn poll_timeout(&self) -> Option<Duration> {
        self.arrivals.peek().map(|Reverse((at, ..))| Duration::from_nanos(*at))
    }

    /// Returns the next datagram that has arrived by `now`, in the order of arrival.
    pub(crate) fn poll_delivery(&mut self, now: Duration) -> Option<Delivery> {
        let now = nanos(now);
        loop {
            let Reverse((at, _, slot)) = *self.arrivals.peek()?;
            if at > now {
                return None;
            }
            self.arrivals.pop();
            self.free.push(slot);
            let packet = self.packets[slot as usize].take().expect("an arrival has a packet");
            self.packets_in_flight -= 1;
            self.bytes_in_flight -= packet.bytes.len();
            let sender = packet.sender;
            match self.arrive(at, packet) {
                Ok(None) => {}
                Ok(Some(delivery)) => {
                    let counters = &mut self.hosts[delivery.host].counters;
                    counters.received += 1;
                    counters.received_bytes += delivery.bytes.len() as u64;
                    return Some(delivery);
                }
                Err(cause) => self.hosts[sender].counters.count_drop(cause),
            }
        }
    }

    /// Delivers a packet or drops it. Returns `None` if the packet waits: for the interface's rate, or in the
    /// receive buffer.
    fn arrive(&mut self, at: u64, mut packet: Packet) -> Result<Option<Delivery>, Cause> {
        let index = packet.interface as usize;
        let host = self.interfaces[index].host;
        if packet.stage == Stage::Path {
            let Interface { up, ingress, .. } = &mut self.interfaces[index];
            if !*up {
                return Err(Cause::InterfaceDown);
            }
            if let Some((rate, backlog)) = ingress {
                let bytes = packet.bytes.len() + HEADERS;
                let passed = backlog.admit(rate, at, bytes).ok_or(Cause::Queue)?;
                packet.ecn = if passed.mark { mark(packet.ecn) } else { packet.ecn };
                packet.stage = Stage::Interface;
                self.insert(passed.at, packet);
                return Ok(None);
            }
        }
        if packet.stage != Stage::Buffer {
            if packet.sender != host && self.is_cut(at, packet.sender, host) {
                return Err(Cause::Cut);
            }
            let (interface, own) = self.resolve(at, packet.to, packet.from)?;
            if interface != packet.interface {
                return Err(Cause::Unreachable);
            }
            if !self.interfaces[index].up {
                return Err(Cause::InterfaceDown);
            }
            packet.to = own;
            packet.stage = Stage::Buffer;
        }
        let Host { listening, paused, buffered, buffered_bytes, .. } = &mut self.hosts[host];
        if !*listening {
            return Err(Cause::NoSocket);
        }
        if *paused {
            let bytes = *buffered_bytes + packet.bytes.len() + HEADERS;
            if bytes > RECEIVE_BUFFER {
                return Err(Cause::ReceiveBuffer);
            }
            *buffered_bytes = bytes;
            self.packets_in_flight += 1;
            self.bytes_in_flight += packet.bytes.len();
            buffered.push_back(packet);
            return Ok(None);
        }
        let Packet { from, to, ecn, bytes, .. } = packet;
        Ok(Some(Delivery { host, at: to.into(), from: from.into(), ecn, bytes }))
    }

    /// Returns how many packets are on their way or in the receive buffers of paused hosts.
    pub(crate) fn in_flight(&self) -> usize {
        self.packets_in_flight
    }

    /// Limits the packets in flight and their bytes. Further packets are dropped with [`Cause::InFlightLimit`].
    pub(crate) fn set_in_flight_limit(&mut self, packets: usize, bytes: usize) {
        (self.max_packets, self.max_bytes) = (packets, bytes);
    }

    /// Returns the counters of a host.
    pub(crate) fn counters(&self, host: usize) -> &Counters {
        &self.hosts[host].counters
    }

    /// Returns how many datagrams were sent from an address that no host has.
    pub(crate) fn unknown_source(&self) -> u64 {
        self.unknown_source
    }
}

fn nanos(time: Duration) -> u64 {
    u64::try_from(time.as_nanos()).unwrap_or(u64::MAX)
}
