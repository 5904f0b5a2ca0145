//! The UDP port that all daemons of a domain on this host share.
//!
//! Multicast and broadcast reach every socket that is bound to the port. A unicast datagram would reach only one of
//! them, so no daemon sends one there. Each local address has a separate socket that is bound to it and sends from
//! it, because the source address of a beacon is the address at which its sender is dialled.

use std::{
    io,
    net::{IpAddr, Ipv4Addr, SocketAddr, SocketAddrV4},
};

use socket2::{Domain, InterfaceIndexOrAddress, Protocol, Socket, Type};
use tokio::net::UdpSocket;
use tracing::{debug, warn};

use super::{Interface, shared_group};
use crate::wire::beacon::LONGEST;

/// Most local addresses that beacons are sent from.
const MOST_SENDERS: usize = 16;

/// The shared port: one socket that receives, and one that sends for each local IPv4 address.
#[derive(Debug)]
pub(crate) struct SharedSocket {
    receiver: UdpSocket,
    group: SocketAddrV4,
    bind: Vec<IpAddr>,
    /// Interfaces whose group the receiver is a member of, by the kernel's number.
    joined: Vec<u32>,
    senders: Vec<DatagramSender>,
}

#[derive(Debug)]
struct DatagramSender {
    interface: Interface,
    from: Ipv4Addr,
    /// This is not tokio's socket, which sends nothing before it has waited for readiness once. It never blocks.
    socket: std::net::UdpSocket,
    /// Multicast failed here before; broadcast is tried after it.
    failing: bool,
}

impl SharedSocket {
    /// Binds the port of `domain`, to send from `bind` only (empty: from every address). No group is
    /// joined before [`follow`](Self::follow). Needs a tokio runtime.
    pub(crate) fn open(domain: u32, bind: &[IpAddr]) -> io::Result<Self> {
        let group = shared_group(domain);
        let socket = udp()?;
        // SO_REUSEPORT would not do: it requires that all daemons have the same user.
        socket.set_reuse_address(true)?;
        // Members of the group on this socket's own account only, not on other sockets'.
        socket.set_multicast_all_v4(false)?;
        socket.bind(&SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, group.port()).into())?;
        Ok(Self {
            receiver: UdpSocket::from_std(socket.into())?,
            group,
            bind: bind.to_vec(),
            joined: Vec::new(),
            senders: Vec::new(),
        })
    }

    /// Joins the group and sends on these interfaces, as far as the bound addresses permit, and no longer on others.
    /// Failures are logged and do not affect the other interfaces.
    pub(crate) fn follow(&mut self, interfaces: &[Interface]) {
        let wanted = permitted(&self.bind, interfaces);
        let kept = |interface: &Interface, from| {
            wanted.iter().any(|(i, address)| i == interface && *address == from)
        };
        self.senders.retain(|sender| kept(&sender.interface, sender.from));
        // The kernel ends a membership with its interface. An interface that came back has a new number, or a new join
        // returns "in use".
        self.joined.retain(|index| wanted.iter().any(|(interface, _)| interface.index == *index));
        for (interface, from) in wanted.into_iter().take(MOST_SENDERS) {
            if !self.joined.contains(&interface.index) {
                match self.join(interface.index) {
                    Ok(()) => self.joined.push(interface.index),
                    Err(error) => {
                        let (name, group) = (&interface.name, self.group);
                        warn!(interface = name, %group, %error, "cannot join; listed peers work");
                    }
                }
            }
            if self.senders.iter().any(|s| s.interface == interface && s.from == from) {
                continue;
            }
            match DatagramSender::open(interface, from) {
                Ok(sender) => self.senders.push(sender),
                Err(error) => warn!(%from, %error, "cannot send beacons from this address"),
            }
        }
    }

    /// Waits for the next datagram. Returns its sender and its content, cut at one byte more than the maximum length.
    pub(crate) async fn receive(&self) -> io::Result<(SocketAddr, Vec<u8>)> {
        let mut buffer = [0; LONGEST + 1];
        let (length, from) = self.receiver.recv_from(&mut buffer).await?;
        Ok((from, buffer[..length].to_vec()))
    }

    /// Returns a waiting datagram, if there is one; does not wait like [`receive`](Self::receive).
    pub(crate) fn try_receive(&self) -> Option<(SocketAddr, Vec<u8>)> {
        let mut buffer = [0; LONGEST + 1];
        // The next call that waits returns an error of the socket.
        let (length, from) = self.receiver.try_recv_from(&mut buffer).ok()?;
        Some((from, buffer[..length].to_vec()))
    }

    /// Sends to the group on every followed interface, by broadcast where multicast fails. Never waits: a datagram that
    /// the kernel does not take at once is lost.
    pub(crate) fn send(&mut self, bytes: &[u8]) {
        for sender in &mut self.senders {
            sender.send(self.group, bytes);
        }
    }

    fn join(&self, index: u32) -> io::Result<()> {
        let socket = socket2::SockRef::from(&self.receiver);
        let interface = InterfaceIndexOrAddress::Index(index);
        match socket.join_multicast_v4_n(self.group.ip(), &interface) {
            Err(error) if error.kind() == io::ErrorKind::AddrInUse => Ok(()),
            other => other,
        }
    }
}

impl DatagramSender {
    fn open(interface: Interface, from: Ipv4Addr) -> io::Result<Self> {
        let socket = udp()?;
        socket.set_multicast_ttl_v4(1)?;
        socket.set_multicast_loop_v4(true)?;
        socket.set_broadcast(true)?;
        socket.bind(&SocketAddrV4::new(from, 0).into())?;
        socket.set_multicast_if_v4(&from)?;
        Ok(Self { interface, from, socket: socket.into(), failing: false })
    }

    fn send(&mut self, group: SocketAddrV4, bytes: &[u8]) {
        // A socket returns the failure of an earlier datagram once, before it sends the next.
        let try_twice = |to: SocketAddrV4| {
            let send = || self.socket.send_to(bytes, to);
            send().or_else(|_| send())
        };
        let Err(error) = try_twice(group) else {
            self.failing = false;
            return;
        };
        let broadcast = self.interface.broadcast.filter(|_| !self.interface.loopback);
        let instead = broadcast.map(|to| try_twice(SocketAddrV4::new(to, group.port())));
        if !std::mem::replace(&mut self.failing, true) {
            let by_broadcast = matches!(instead, Some(Ok(_)));
            let (interface, from) = (&self.interface.name, self.from);
            warn!(interface, %from, %error, by_broadcast, "multicast fails");
        } else if let Some(Err(error)) = instead {
            debug!(from = %self.from, %error, "broadcast fails too");
        }
    }
}

/// Returns the interfaces to use, each with the address to send from: the interfaces of the bound addresses, or all but
/// loopback. A bound loopback address need not be an interface's own: the loopback interface has all of 127.0.0.0/8.
fn permitted(bind: &[IpAddr], interfaces: &[Interface]) -> Vec<(Interface, Ipv4Addr)> {
    let v4 = |interface: &Interface| match interface.address {
        IpAddr::V4(v4) => Some(v4),
        IpAddr::V6(_) => None,
    };
    if bind.is_empty() {
        let others = interfaces.iter().filter(|interface| !interface.loopback);
        return others.filter_map(|i| Some((i.clone(), v4(i)?))).collect();
    }
    let bound = bind.iter().filter_map(|address| match address {
        IpAddr::V4(v4) => Some(*v4),
        IpAddr::V6(_) => None,
    });
    bound
        .filter_map(|from| {
            let on = interfaces.iter().find(|interface| match v4(interface) {
                Some(own) => own == from || (interface.loopback && from.is_loopback()),
                None => false,
            });
            on.map(|interface| (interface.clone(), from))
        })
        .collect()
}

fn udp() -> io::Result<Socket> {
    let socket = Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::UDP))?;
    socket.set_nonblocking(true)?;
    Ok(socket)
}
