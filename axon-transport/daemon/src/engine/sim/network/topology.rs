//! The topology: hosts, interfaces, NATs, partitions, and the paths between interfaces.

use std::{
    collections::VecDeque,
    net::{Ipv4Addr, SocketAddrV4},
    time::Duration,
};

use super::{
    Cause, Counters, Filtering, Host, Interface, Nat, Network, Packet, Path, Rate, Stage, nanos,
    queue::Backlog,
};

/// Owner of an address.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Owner {
    Interface(u32),
    /// It is the outer address of a NAT.
    Nat(NatId),
}

/// Names a NAT of a network.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct NatId(pub(super) usize);

/// Names a partition of a network.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct CutId(u64);

/// Two sets of hosts; packets from the first to the second are dropped.
pub(super) struct Cut {
    /// For each host, whether it is in the sending set.
    from: Vec<bool>,
    to: Vec<bool>,
    /// Both directions.
    mutual: bool,
    until: u64,
}

impl Network {
    /// Adds a host with one interface for each of `addresses`, in segment 0. Returns its index.
    ///
    /// # Panics
    /// If an address is in use.
    pub(crate) fn add_host(&mut self, addresses: &[Ipv4Addr]) -> usize {
        let host = self.hosts.len();
        self.hosts.push(Host {
            listening: true,
            paused: false,
            buffered: VecDeque::new(),
            buffered_bytes: 0,
            counters: Counters::default(),
        });
        for address in addresses {
            self.add_interface(host, *address, 0);
        }
        host
    }

    /// Adds an interface to a host. Multicast reaches the interfaces of one `segment`.
    ///
    /// # Panics
    /// If the address is in use.
    pub(crate) fn add_interface(&mut self, host: usize, address: Ipv4Addr, segment: usize) {
        let index = self.interfaces.len() as u32;
        self.claim(address, Owner::Interface(index));
        let (egress, ingress) = (None, None);
        let nat = None;
        self.interfaces.push(Interface { host, address, nat, segment, up: true, egress, ingress });
        self.rows.push(Vec::new());
    }

    /// Adds a NAT. `lifetime` is how long a mapping lasts without outgoing packets; `None`: for ever.
    ///
    /// # Panics
    /// If the address is in use.
    pub(crate) fn add_nat(
        &mut self,
        outer: Ipv4Addr,
        filtering: Filtering,
        lifetime: Option<Duration>,
    ) -> NatId {
        let nat = NatId(self.nats.len());
        self.claim(outer, Owner::Nat(nat));
        self.nats.push(Nat::new(outer, filtering, lifetime));
        nat
    }

    /// Puts the interface with `address` behind a NAT. Interfaces behind one NAT reach each other directly.
    ///
    /// Put them into a segment of their own: multicast knows no NAT.
    pub(crate) fn put_behind(&mut self, address: Ipv4Addr, nat: NatId) {
        self.interface(address).nat = Some(nat);
    }

    /// Forwards an outer port of a NAT to a socket inside.
    pub(crate) fn forward_port(&mut self, nat: NatId, port: u16, inner: SocketAddrV4) {
        self.nats[nat.0].forward(port, inner);
    }

    /// Ends all mappings of a NAT, and gives it another outer address if `outer` is given. Forwarded ports
    /// stay.
    ///
    /// # Panics
    /// If the address is in use.
    pub(crate) fn rebind(&mut self, nat: NatId, outer: Option<Ipv4Addr>) {
        self.nats[nat.0].rebind();
        if let Some(outer) = outer {
            let old = std::mem::replace(&mut self.nats[nat.0].outer, outer);
            self.owners.remove(&old);
            self.claim(outer, Owner::Nat(nat));
        }
    }

    /// Gives the interface with the address `from` the address `to`. Packets in flight to the old address are dropped.
    ///
    /// # Panics
    /// If no interface has `from`, or `to` is in use.
    pub(crate) fn move_host(&mut self, from: Ipv4Addr, to: Ipv4Addr) {
        self.interface(from).address = to;
        let owner = self.owners.remove(&from).expect("an interface's address");
        self.claim(to, owner);
    }

    /// Sets an interface up or down.
    pub(crate) fn set_interface_up(&mut self, address: Ipv4Addr, up: bool) {
        self.interface(address).up = up;
    }

    /// Moves an interface to another Ethernet segment.
    pub(crate) fn set_segment(&mut self, address: Ipv4Addr, segment: usize) {
        self.interface(address).segment = segment;
    }

    /// Limits the rates of an interface, over all its paths together.
    pub(crate) fn set_interface_rates(
        &mut self,
        address: Ipv4Addr,
        egress: Option<Rate>,
        ingress: Option<Rate>,
    ) {
        let interface = self.interface(address);
        interface.egress = egress.map(|rate| (rate, Backlog::default()));
        interface.ingress = ingress.map(|rate| (rate, Backlog::default()));
    }

    /// Returns the addresses of a host, in the order in which its interfaces were added.
    pub(crate) fn addresses(&self, host: usize) -> impl Iterator<Item = Ipv4Addr> + '_ {
        self.interfaces.iter().filter(move |i| i.host == host).map(|i| i.address)
    }

    fn interface(&mut self, address: Ipv4Addr) -> &mut Interface {
        match self.owners.get(&address) {
            Some(Owner::Interface(interface)) => &mut self.interfaces[*interface as usize],
            other => panic!("{address} is no interface's address: {other:?}"),
        }
    }

    fn claim(&mut self, address: Ipv4Addr, owner: Owner) {
        let other = self.owners.insert(address, owner);
        assert!(other.is_none(), "{address} is in use by {other:?}");
    }

    /// Sets the path of all pairs without a path of their own.
    ///
    /// # Panics
    /// If a probability is outside 0..=1. The same holds for each function that sets a path.
    pub(crate) fn set_default_path(&mut self, path: Path) {
        path.validate();
        self.default_path = path;
    }

    /// Sets the path from each interface of one host to each of another; `None`: the default again.
    pub(crate) fn set_path(&mut self, from: usize, to: usize, path: Option<Path>) {
        let of = |network: &Self, host| network.addresses(host).collect::<Vec<_>>();
        for from in of(self, from) {
            for to in of(self, to) {
                self.set_path_between(from, to, path.clone());
            }
        }
    }

    /// Sets the path from one interface to another; `None`: the default again.
    pub(crate) fn set_path_between(&mut self, from: Ipv4Addr, to: Ipv4Addr, path: Option<Path>) {
        let index = |network: &Self, address| match network.owners.get(&address) {
            Some(Owner::Interface(interface)) => *interface,
            other => panic!("{address} is no interface's address: {other:?}"),
        };
        if let Some(path) = &path {
            path.validate();
        }
        let link = self.link(index(self, from), index(self, to));
        self.links[link as usize].path = path.map(Box::new);
    }

    /// Returns the path from one host's first interface to another's, to be changed and set again.
    pub(crate) fn path(&self, from: usize, to: usize) -> &Path {
        let first = |host| self.interfaces.iter().position(|i| i.host == host);
        let link = first(from).zip(first(to)).and_then(|(from, to)| self.rows[from].get(to));
        let own = link.and_then(|link| self.links.get(*link as usize)?.path.as_deref());
        own.unwrap_or(&self.default_path)
    }

    /// Drops packets from each host of `from` to each host of `to`, until `until` or [`heal`](Self::heal).
    pub(crate) fn cut(&mut self, from: &[usize], to: &[usize], until: Option<Duration>) -> CutId {
        self.add_cut(from, to, false, until)
    }

    /// Drops packets between the hosts of `side` and all others, in both directions.
    pub(crate) fn partition(&mut self, side: &[usize], until: Option<Duration>) -> CutId {
        let others: Vec<usize> = (0..self.hosts.len()).filter(|h| !side.contains(h)).collect();
        self.add_cut(side, &others, true, until)
    }

    fn add_cut(
        &mut self,
        from: &[usize],
        to: &[usize],
        mutual: bool,
        until: Option<Duration>,
    ) -> CutId {
        let set = |hosts: &[usize]| {
            let mut set = vec![false; self.hosts.len()];
            hosts.iter().for_each(|host| set[*host] = true);
            set
        };
        let until = until.map_or(u64::MAX, nanos);
        let cut = Cut { from: set(from), to: set(to), mutual, until };
        self.next_cut += 1;
        let id = CutId(self.next_cut);
        self.cuts.push((id, cut));
        id
    }

    /// Ends a cut or a partition. Does nothing if it has ended.
    pub(crate) fn heal(&mut self, cut: CutId) {
        self.cuts.retain(|(id, _)| *id != cut);
    }

    /// Ends all cuts and partitions.
    pub(crate) fn heal_all(&mut self) {
        self.cuts.clear();
    }

    pub(super) fn is_cut(&mut self, now: u64, from: usize, to: usize) -> bool {
        if self.cuts.is_empty() {
            return false;
        }
        self.cuts.retain(|(_, cut)| cut.until > now);
        // A host that was added later is in no set.
        let has = |set: &[bool], host: usize| set.get(host).copied().unwrap_or(false);
        self.cuts.iter().any(|(_, cut)| {
            (has(&cut.from, from) && has(&cut.to, to))
                || (cut.mutual && has(&cut.from, to) && has(&cut.to, from))
        })
    }

    /// Opens or closes the sockets of a host: whether its daemon runs. Closing drops its receive buffer.
    pub(crate) fn set_listening(&mut self, host: usize, listening: bool) {
        self.hosts[host].listening = listening;
        if !listening {
            for packet in self.take_buffer(host) {
                self.hosts[packet.sender].counters.count_drop(Cause::NoSocket);
            }
        }
    }

    /// Pauses a host: packets that arrive wait in its receive buffer of [`RECEIVE_BUFFER`](super::RECEIVE_BUFFER).
    pub(crate) fn pause(&mut self, host: usize) {
        self.hosts[host].paused = true;
    }

    /// Ends a pause: the receive buffer is delivered from `now` on.
    pub(crate) fn resume(&mut self, now: Duration, host: usize) {
        self.hosts[host].paused = false;
        for packet in self.take_buffer(host) {
            debug_assert_eq!(packet.stage, Stage::Buffer);
            self.insert(nanos(now), packet);
        }
    }

    fn take_buffer(&mut self, host: usize) -> VecDeque<Packet> {
        let buffered = std::mem::take(&mut self.hosts[host].buffered);
        self.hosts[host].buffered_bytes = 0;
        self.packets_in_flight -= buffered.len();
        self.bytes_in_flight -= buffered.iter().map(|packet| packet.bytes.len()).sum::<usize>();
        buffered
    }
}
