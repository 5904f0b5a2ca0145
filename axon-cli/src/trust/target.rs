//! The target of a scan: the argument, and its addresses.

use std::{io, net::SocketAddr, str::FromStr};

/// The most addresses of one host that are scanned. They are the first to which its name resolves.
const MAX_ADDRESSES: usize = 4;

/// `HOST`, `HOST:PORT`, `[IPv6]` or `[IPv6]:PORT`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct HostTarget {
    pub(super) host: String,
    pub(super) port: Option<u16>,
}

impl HostTarget {
    /// Returns the addresses at each of `ports`, or at the port in the argument.
    pub(super) async fn addresses(
        &self,
        ports: impl Iterator<Item = u16> + Clone,
    ) -> io::Result<Vec<SocketAddr>> {
        let mut hosts = Vec::new();
        for address in tokio::net::lookup_host((self.host.as_str(), 0)).await? {
            if !hosts.contains(&address) && hosts.len() < MAX_ADDRESSES {
                hosts.push(address);
            }
        }
        let ports: Vec<_> = self.port.map_or_else(|| ports.collect(), |port| vec![port]);
        let with = |mut address: SocketAddr, port| {
            address.set_port(port);
            address
        };
        Ok(hosts.iter().flat_map(|a| ports.iter().map(move |p| with(*a, *p))).collect())
    }
}

impl FromStr for HostTarget {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let (host, port) = match text.strip_prefix('[') {
            Some(rest) => {
                let (host, after) = rest.split_once(']').ok_or("there is no ] to the [")?;
                match after.strip_prefix(':') {
                    Some(port) => (host, Some(port)),
                    None if after.is_empty() => (host, None),
                    None => return Err("after ] comes :PORT or nothing"),
                }
            }
            // More than one colon means an IPv6 address without a port.
            None if text.matches(':').count() == 1 => {
                let (host, port) = text.split_once(':').unwrap_or((text, ""));
                (host, Some(port))
            }
            None => (text, None),
        };
        if host.is_empty() {
            return Err("there is no host in it");
        }
        let port = match port.map(str::parse::<u16>) {
            None => None,
            Some(Ok(port @ 1..)) => Some(port),
            Some(_) => return Err("a port is a number from 1 to 65535"),
        };
        Ok(Self { host: host.to_owned(), port })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hosts_and_ports_are_told_apart() {
        for (text, host, port) in [
            ("robot.local", "robot.local", None),
            ("robot.local:61300", "robot.local", Some(61300)),
            ("10.0.0.2:1", "10.0.0.2", Some(1)),
            ("::1", "::1", None),
            ("fe80::1%eth0", "fe80::1%eth0", None),
            ("[::1]", "::1", None),
            ("[::1]:61300", "::1", Some(61300)),
        ] {
            assert_eq!(text.parse(), Ok(HostTarget { host: host.to_owned(), port }), "{text}");
        }
        for text in ["", ":1", "a:", "a:0", "a:65536", "a:x", "a:-1", "[::1", "[::1]1", "[]:1"] {
            assert!(text.parse::<HostTarget>().is_err(), "{text}");
        }
    }
}
