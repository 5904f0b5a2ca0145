//! A peer to be dialled, and the limits of a dial.

use std::{net::SocketAddr, time::Duration};

use axon_shm::ids::DaemonId;

use crate::{discovery::AddressConfidence, link::LinkHello};

/// One address is given this long to complete the handshake.
pub(crate) const HANDSHAKE_TIMEOUT: Duration = Duration::from_secs(5);

/// A dial, with all its redials, is given up after this, in qkd with two KME calls; discovery backs
/// off and dials again.
const DIAL_TIMEOUT: Duration = Duration::from_secs(20);

/// Alerts of a server that does not have the key (yet), or has another.
pub(crate) const UNKNOWN_PSK_IDENTITY: u8 = 115;

pub(crate) const DECRYPT_ERROR: u8 = 51;

/// Whom to dial.
#[derive(Clone, Debug)]
pub(crate) struct DialTarget {
    /// The daemon expected there, `None` when any will do.
    pub(crate) daemon: Option<DaemonId>,
    /// Its SAE ID, in qkd.
    pub(crate) sae: Option<String>,
    /// Where it may be, best first.
    pub(crate) addresses: Vec<SocketAddr>,
    /// Whether this host lists it as a static peer.
    pub(crate) listed: bool,
    /// Why it may be there, where discovery says so.
    pub(crate) standing: Option<AddressConfidence>,
    /// The link that the new connection succeeds.
    pub(crate) replaces: Option<[u8; 16]>,
}

impl DialTarget {
    /// For log and status.
    pub(crate) fn text(&self) -> String {
        let addresses: Vec<_> = self.addresses.iter().map(ToString::to_string).collect();
        match &self.sae {
            Some(sae) => format!("{sae} at {}", addresses.join(", ")),
            None => addresses.join(", "),
        }
    }

    /// This side's HELLO to it.
    pub(crate) fn hello(&self, ours: &LinkHello) -> LinkHello {
        LinkHello {
            expects: self.daemon,
            static_peer: self.listed,
            replaces: self.replaces,
            ..ours.clone()
        }
    }
}

/// How long a whole dial may take; in qkd a KME call may take as long as `kme_answer`.
pub(crate) fn dial_limit(kme_answer: Option<Duration>) -> Duration {
    DIAL_TIMEOUT + kme_answer.map(|answer| 2 * answer).unwrap_or_default()
}
