//! Decides which endpoints may match by the discovery ranges of their sessions. The daemons of both hosts use this
//! one rule, and either of them can refuse a pair.

use std::sync::Arc;

use minicbor::{Decode, Encode};

use super::Endpoint;
use crate::{config::DiscoveryRange, ids::DaemonId};

/// Maximum number of static peers, as in rcl.
const MOST_PEERS: usize = 32;
/// Longest name of a host, in bytes.
const MOST_NAME: usize = 253;

/// The discovery range and the static peers of a session.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Scope {
    /// The range.
    pub range: DiscoveryRange,
    /// Addresses or host names; empty in OFF.
    pub static_peers: Vec<String>,
    /// True if the session stated its range. A session that did not is LOCALHOST.
    pub stated: bool,
}

impl Scope {
    /// Creates the scope that a session states: the range's [number](DiscoveryRange::number), and the static peers. A
    /// session without a number stays on its host, because its library does not know ranges.
    pub fn of(range: Option<u8>, mut static_peers: Vec<String>) -> Self {
        let stated = range.is_some();
        let range = match range {
            Some(0) => DiscoveryRange::Subnet,
            None | Some(1) => DiscoveryRange::Localhost,
            // OFF, and numbers of later versions.
            Some(_) => DiscoveryRange::Off,
        };
        let lists = stated && range != DiscoveryRange::Off;
        let good = |peer: &String| {
            !peer.is_empty() && peer.len() <= MOST_NAME && !peer.contains(char::is_control)
        };
        static_peers.retain(|peer| lists && good(peer));
        static_peers.truncate(MOST_PEERS);
        Self { range, static_peers, stated }
    }
}

/// The discovery range of an endpoint's session, and the linked peers that the session lists.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[cbor(map)]
pub struct EndpointRange {
    /// The range.
    #[n(0)]
    pub range: DiscoveryRange,
    /// Daemons of hosts that the session lists as static peers.
    #[n(1)]
    pub lists: Vec<DaemonId>,
}

impl EndpointRange {
    /// Returns the range towards one peer.
    pub fn toward(&self, peer: DaemonId) -> RangeToHost {
        RangeToHost { range: self.range, lists: self.lists.contains(&peer) }
    }
}

/// The discovery range of a session, and whether the session lists the host on the other side.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RangeToHost {
    /// The range.
    pub range: DiscoveryRange,
    /// True if the session's static peers include the host of the other endpoint.
    pub lists: bool,
}

/// An endpoint of another host, as that host's daemon describes it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RemoteEndpoint {
    /// The endpoint.
    pub endpoint: Arc<Endpoint>,
    /// The range of the endpoint's session towards this host.
    pub toward: RangeToHost,
}

impl From<Endpoint> for RemoteEndpoint {
    /// Creates an endpoint whose daemon states no range. Its session is SUBNET and lists no host.
    fn from(endpoint: Endpoint) -> Self {
        let toward = RangeToHost { range: DiscoveryRange::Subnet, lists: false };
        Self { endpoint: Arc::new(endpoint), toward }
    }
}

/// The reason why endpoints of two sessions may not match: discovery ranges or access rules.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum OutOfRange {
    /// One of the sessions is OFF.
    #[error("the discovery range of one session is OFF: it matches nothing outside itself")]
    Off,
    /// One of the sessions is LOCALHOST and neither lists the other's host.
    #[error(
        "the discovery range of one session is LOCALHOST and neither session lists the other's \
         host: name that host's address in ROS_STATIC_PEERS of one of them"
    )]
    Localhost,
    /// An access rule denies one of the endpoints to its user.
    #[error(
        "an access rule denies one of the endpoints to its user; the refusals in `axon status` name it"
    )]
    Denied,
    /// The other host has not described the endpoint.
    #[error("the other host has not described the endpoint")]
    Unknown,
}

/// Returns the reason why endpoints of two sessions on different hosts may not match, or `None` if they may.
pub fn out_of_range(one: RangeToHost, other: RangeToHost) -> Option<OutOfRange> {
    let has = |range| one.range == range || other.range == range;
    if has(DiscoveryRange::Off) {
        Some(OutOfRange::Off)
    } else if has(DiscoveryRange::Localhost) && !one.lists && !other.lists {
        Some(OutOfRange::Localhost)
    } else {
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn missing_or_unknown_discovery_range_does_not_leave_the_host() {
        use DiscoveryRange::{Localhost, Off, Subnet};
        let peers = || vec!["10.0.0.1".to_owned(), String::new(), "a\nb".into(), "x".repeat(254)];
        for (said, range, listed, stated) in [
            (Some(0), Subnet, 1, true),
            (Some(1), Localhost, 1, true),
            (Some(2), Off, 0, true),
            (Some(3), Off, 0, true),
            (None, Localhost, 0, false),
        ] {
            let scope = Scope::of(said, peers());
            assert_eq!(
                (scope.range, scope.static_peers.len(), scope.stated),
                (range, listed, stated)
            );
        }
        assert_eq!(Scope::of(Some(0), vec!["a".into(); 100]).static_peers.len(), MOST_PEERS);
        for range in [Subnet, Localhost, Off] {
            assert_eq!(Scope::of(Some(range.number()), Vec::new()).range, range);
        }
    }

    #[test]
    fn hosts_are_matched_as_the_table_of_ros_says() {
        use DiscoveryRange::{Localhost, Off, Subnet};
        let toward = |range, lists| RangeToHost { range, lists };
        for (one, other, expected) in [
            (toward(Subnet, false), toward(Subnet, false), None),
            (toward(Subnet, true), toward(Subnet, false), None),
            (toward(Subnet, false), toward(Localhost, false), Some(OutOfRange::Localhost)),
            (toward(Subnet, true), toward(Localhost, false), None),
            (toward(Subnet, false), toward(Localhost, true), None),
            (toward(Localhost, false), toward(Localhost, false), Some(OutOfRange::Localhost)),
            (toward(Localhost, true), toward(Localhost, false), None),
            (toward(Off, false), toward(Subnet, true), Some(OutOfRange::Off)),
            (toward(Off, true), toward(Localhost, true), Some(OutOfRange::Off)),
            (toward(Off, true), toward(Off, true), Some(OutOfRange::Off)),
        ] {
            assert_eq!(out_of_range(one, other), expected, "{one:?} {other:?}");
            assert_eq!(out_of_range(other, one), expected, "{other:?} {one:?}");
        }
    }
}
