//! A peer to be dialled, and the limits of a dial.

use std::{net::SocketAddr, time::Duration};

use axon_shm::ids::DaemonId;

use crate::{discovery::AddressConfidence, link::LinkHello};

/// Timeout of the handshake with one address.
pub(crate) const HANDSHAKE_TIMEOUT: Duration = Duration::from_secs(5);

/// Timeout of a dial with all its redials. In qkd the time of two KME calls is added. Discovery backs off and dials
/// again.
const DIAL_TIMEOUT: Duration = Duration::from_secs(20);

/// Alert of a server that does not have the key (yet). [`DECRYPT_ERROR`] is that of a server that has another key.
pub(crate) const UNKNOWN_PSK_IDENTITY: u8 = 115;

pub(crate) const DECRYPT_ERROR: u8 = 51;

/// The target of a dial.
#[derive(Clone, Debug)]
pub(crate) struct DialTarget {
    /// The daemon expected there; `None` for any daemon.
    pub(crate) daemon: Option<DaemonId>,
    /// The daemon's SAE ID, in qkd.
    pub(crate) sae: Option<String>,
    /// Addresses where it may be, best first.
    pub(crate) addresses: Vec<SocketAddr>,
    /// True if this host lists it as a static peer.
    pub(crate) listed: bool,
    /// The confidence in the address, if discovery stated one.
    pub(crate) standing: Option<AddressConfidence>,
    /// The link that the new connection succeeds.
    pub(crate) replaces: Option<[u8; 16]>,
    /// The link in use beside which the new connection stands by.
    pub(crate) beside: Option<[u8; 16]>,
}

impl DialTarget {
    /// Returns the SAE ID and the addresses for log and status.
    pub(crate) fn text(&self) -> String {
        let addresses: Vec<_> = self.addresses.iter().map(ToString::to_string).collect();
        match &self.sae {
            Some(sae) => format!("{sae} at {}", addresses.join(", ")),
            None => addresses.join(", "),
        }
    }

    /// Returns this side's HELLO to it.
    pub(crate) fn hello(&self, ours: &LinkHello) -> LinkHello {
        LinkHello {
            expects: self.daemon,
            static_peer: self.listed,
            replaces: self.replaces,
            beside: self.beside,
            ..ours.clone()
        }
    }
}

/// Returns the timeout of a whole dial; in qkd a KME call may take up to `kme_answer`.
pub(crate) fn dial_limit(kme_answer: Option<Duration>) -> Duration {
    DIAL_TIMEOUT + kme_answer.map(|answer| 2 * answer).unwrap_or_default()
}
