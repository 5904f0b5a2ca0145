//! The addresses at which a peer may be reached, best first.

use std::net::{IpAddr, SocketAddr};

use crate::discovery::Interface;

/// Most addresses in one dial.
const MAX_DIAL_ADDRESSES: usize = 8;

/// The addresses of this host, which decide the addresses that it can reach.
#[derive(Debug, Default)]
pub(super) struct LocalAddresses {
    /// `AXON_BIND_ADDRS`; empty means every address.
    pub(super) bind: Vec<IpAddr>,
    pub(super) interfaces: Vec<Interface>,
}

impl LocalAddresses {
    /// Returns whether `address` leads to this host.
    pub(super) fn is_local(&self, address: IpAddr) -> bool {
        address.is_loopback() || self.interfaces.iter().any(|i| i.address == address)
    }

    /// Returns whether a socket that is bound as configured can send to `address`.
    pub(super) fn can_reach(&self, address: IpAddr) -> bool {
        self.bind.is_empty()
            || self.bind.iter().any(|bound| {
                bound.is_ipv4() == address.is_ipv4() && bound.is_loopback() == address.is_loopback()
            })
    }

    fn same_subnet(&self, one: IpAddr, other: IpAddr) -> bool {
        one == other || self.interfaces.iter().any(|i| i.contains(one) && i.contains(other))
    }

    fn on_a_subnet(&self, address: IpAddr) -> bool {
        self.interfaces.iter().any(|i| i.contains(address))
    }

    /// Returns the addresses to dial: first the sources of beacons, then the peer's advertised addresses on the same
    /// subnets, then the rest. For an unlisted peer, an address on another subnet than its beacon's source is ignored,
    /// because any host can write such an address into a beacon.
    pub(super) fn candidates(
        &self,
        sources: &[SocketAddr],
        advertised: &[SocketAddr],
        listed: bool,
    ) -> Vec<SocketAddr> {
        let near = |address: &&SocketAddr| {
            sources.iter().any(|source| self.same_subnet(source.ip(), address.ip()))
        };
        let rest = |on_ours: bool| {
            advertised.iter().filter(move |address| {
                listed && !near(address) && self.on_a_subnet(address.ip()) == on_ours
            })
        };
        let local = sources.iter().any(|source| self.is_local(source.ip()));
        let mut candidates = Vec::new();
        let ordered = sources.iter().chain(advertised.iter().filter(near));
        for address in ordered.chain(rest(true)).chain(rest(false)) {
            let good = is_unicast(address.ip())
                && self.can_reach(address.ip())
                && (local || !address.ip().is_loopback());
            if good && !candidates.contains(address) && candidates.len() < MAX_DIAL_ADDRESSES {
                candidates.push(*address);
            }
        }
        candidates
    }

    /// Returns the addresses for this daemon's beacons: at most four that other hosts can use.
    pub(super) fn advertised(&self) -> Vec<IpAddr> {
        let usable = |i: &&Interface| {
            let link_local = matches!(i.address, IpAddr::V6(v6) if v6.is_unicast_link_local());
            let bound = self.bind.is_empty() || self.bind.contains(&i.address);
            bound && !link_local && !i.loopback
        };
        let all: Vec<&Interface> = self.interfaces.iter().filter(usable).collect();
        let real: Vec<&Interface> = all.iter().copied().filter(|i| !i.is_virtual()).collect();
        // A container has only a virtual interface.
        let chosen = if real.is_empty() { all } else { real };
        let mut addresses: Vec<IpAddr> = chosen.iter().map(|i| i.address).collect();
        if addresses.is_empty() {
            addresses.clone_from(&self.bind);
        }
        addresses.sort_by_key(IpAddr::is_ipv6);
        addresses.truncate(crate::wire::beacon::MOST_ADDRESSES);
        addresses
    }
}

fn is_unicast(address: IpAddr) -> bool {
    match address {
        IpAddr::V4(v4) => !v4.is_unspecified() && !v4.is_multicast() && !v4.is_broadcast(),
        IpAddr::V6(v6) => !v6.is_unspecified() && !v6.is_multicast(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn here(bind: &[&str]) -> LocalAddresses {
        let interface = |name: &str, address: &str, prefix| Interface {
            name: name.to_owned(),
            index: 1,
            address: address.parse().unwrap(),
            prefix,
            broadcast: None,
            loopback: name == "lo",
        };
        LocalAddresses {
            bind: bind.iter().map(|a| a.parse().unwrap()).collect(),
            interfaces: vec![
                interface("lo", "127.0.0.1", 8),
                interface("docker0", "172.17.0.1", 16),
                interface("wlan0", "10.0.0.5", 24),
                interface("eth1", "192.168.7.5", 24),
            ],
        }
    }

    fn addresses(texts: &[&str]) -> Vec<SocketAddr> {
        texts.iter().map(|text| text.parse().unwrap()).collect()
    }

    #[test]
    fn forged_addresses_of_an_unlisted_peer_do_not_count() {
        let source = addresses(&["10.0.0.9:61300"]);
        let advertised = addresses(&[
            "198.51.100.1:61300",
            "0.0.0.0:61300",
            "127.0.0.1:61300",
            "224.0.0.1:61300",
            "192.168.7.9:61300",
            "10.0.0.10:61300",
        ]);
        assert_eq!(
            here(&[]).candidates(&source, &advertised, false),
            addresses(&["10.0.0.9:61300", "10.0.0.10:61300"])
        );
        assert_eq!(
            here(&[]).candidates(&source, &advertised, true),
            addresses(&[
                "10.0.0.9:61300",
                "10.0.0.10:61300",
                "192.168.7.9:61300",
                "198.51.100.1:61300",
            ])
        );
    }

    #[test]
    fn bind_addresses_restrict_dialled_and_advertised_addresses() {
        let source = addresses(&["127.0.0.2:61300", "10.0.0.9:61300", "[2001:db8::1]:61300"]);
        for (bind, dialled) in [
            (&[][..], &["127.0.0.2:61300", "10.0.0.9:61300", "[2001:db8::1]:61300"][..]),
            (&["127.0.0.1"], &["127.0.0.2:61300"]),
            (&["10.0.0.5"], &["10.0.0.9:61300"]),
            (&["::1"], &[]),
        ] {
            assert_eq!(here(bind).candidates(&source, &[], false), addresses(dialled), "{bind:?}");
        }
        let advertised = |bind: &[&str]| -> Vec<String> {
            here(bind).advertised().iter().map(IpAddr::to_string).collect()
        };
        assert_eq!(advertised(&[]), ["10.0.0.5", "192.168.7.5"]);
        assert_eq!(advertised(&["192.168.7.5"]), ["192.168.7.5"]);
        assert_eq!(advertised(&["127.0.0.2"]), ["127.0.0.2"]);
        assert_eq!(advertised(&["172.17.0.1"]), ["172.17.0.1"], "better than nothing");
    }
}
