//! The addresses of this host.

use std::{
    io,
    net::{IpAddr, Ipv4Addr},
};

use nix::{
    ifaddrs::getifaddrs,
    net::if_::{InterfaceFlags, if_nametoindex},
    sys::socket::SockaddrStorage,
};

/// Maximum number of addresses; further ones of a host are ignored.
const MAX_ADDRESSES: usize = 64;

/// One address of one network interface that is up.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Interface {
    /// The name, as `ip link` shows it.
    pub name: String,
    /// The kernel's number of the interface.
    pub index: u32,
    /// One of the interface's addresses.
    pub address: IpAddr,
    /// The length of the subnet prefix, in bits.
    pub prefix: u8,
    /// The subnet's broadcast address, if it has one.
    pub broadcast: Option<Ipv4Addr>,
    /// Whether the interface is a loopback interface, which does not leave this host.
    pub loopback: bool,
}

impl Interface {
    /// Returns whether `address` is in this interface's subnet.
    pub(crate) fn contains(&self, address: IpAddr) -> bool {
        let same = |ours: u128, theirs: u128, bits: u32| {
            let prefix = u32::from(self.prefix).min(bits);
            prefix == 0 || (ours ^ theirs) >> (bits - prefix) == 0
        };
        match (self.address, address) {
            (IpAddr::V4(ours), IpAddr::V4(theirs)) => {
                same(u32::from(ours).into(), u32::from(theirs).into(), 32)
            }
            (IpAddr::V6(ours), IpAddr::V6(theirs)) => same(ours.into(), theirs.into(), 128),
            _ => false,
        }
    }

    /// Returns whether the interface connects containers or virtual machines of this host. Its addresses have no
    /// meaning on another host.
    pub(crate) fn is_virtual(&self) -> bool {
        ["docker", "br-", "veth", "virbr", "cni", "lxc"]
            .iter()
            .any(|prefix| self.name.starts_with(prefix))
    }
}

/// Returns the addresses of all interfaces that are up, in a stable order.
pub(crate) fn interfaces() -> io::Result<Vec<Interface>> {
    let mut found: Vec<Interface> = getifaddrs()?
        .filter(|entry| entry.flags.contains(InterfaceFlags::IFF_UP))
        .filter_map(|entry| {
            let address = ip(entry.address.as_ref()?)?;
            let index = if_nametoindex(&*entry.interface_name).ok()?;
            let prefix = entry.netmask.as_ref().and_then(ip).map_or(32, ones);
            let broadcast = match entry.broadcast.as_ref().and_then(ip) {
                Some(IpAddr::V4(v4)) if entry.flags.contains(InterfaceFlags::IFF_BROADCAST) => {
                    Some(v4)
                }
                _ => None,
            };
            Some(Interface {
                name: entry.interface_name,
                index,
                address,
                prefix,
                broadcast,
                loopback: entry.flags.contains(InterfaceFlags::IFF_LOOPBACK),
            })
        })
        .take(MAX_ADDRESSES)
        .collect();
    found.sort();
    Ok(found)
}

fn ip(address: &SockaddrStorage) -> Option<IpAddr> {
    let v4 = address.as_sockaddr_in().map(|v4| IpAddr::from(v4.ip()));
    v4.or_else(|| address.as_sockaddr_in6().map(|v6| IpAddr::from(v6.ip())))
}

fn ones(mask: IpAddr) -> u8 {
    let ones = match mask {
        IpAddr::V4(v4) => u32::from(v4).leading_ones(),
        IpAddr::V6(v6) => u128::from(v6).leading_ones(),
    };
    ones as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn subnets_are_told_apart_by_their_prefix() {
        let interface = |address: &str, prefix| Interface {
            name: "eth0".to_owned(),
            index: 2,
            address: address.parse().unwrap(),
            prefix,
            broadcast: None,
            loopback: false,
        };
        for (address, prefix, other, inside) in [
            ("10.1.2.3", 24, "10.1.2.200", true),
            ("10.1.2.3", 24, "10.1.3.3", false),
            ("10.1.2.3", 32, "10.1.2.3", true),
            ("10.1.2.3", 0, "192.0.2.1", true),
            ("10.1.2.3", 24, "::ffff:10.1.2.3", false),
            ("2001:db8::1", 64, "2001:db8::ffff", true),
            ("2001:db8::1", 64, "2001:db8:0:1::1", false),
            ("2001:db8::1", 200, "2001:db8::1", true),
        ] {
            let interface = interface(address, prefix);
            assert_eq!(interface.contains(other.parse().unwrap()), inside, "{address} {other}");
        }
    }

    #[test]
    fn this_host_has_a_loopback_interface() {
        let found = interfaces().unwrap();
        let loopback = found.iter().find(|i| i.address == IpAddr::from(Ipv4Addr::LOCALHOST));
        let loopback = loopback.expect("127.0.0.1");
        assert!(loopback.loopback && loopback.index > 0 && loopback.prefix == 8);
    }
}
