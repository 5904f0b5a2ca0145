//! Admits handshakes and links by the address of the peer.

mod shares;

use std::{collections::BTreeSet, net::IpAddr, rc::Rc, time::Duration};

pub(super) use self::shares::HandshakeSlot;
pub(crate) use self::shares::place;
use self::shares::{HandshakeShares, LoggedRefusals, gives_way};

/// Maximum number of handshakes under way at once, without the handshakes of listed peers; the peer repeats a refused
/// dial.
const MAX_HANDSHAKES: usize = 64;

/// The handshakes and links of peers by address, and their limits.
pub(super) struct AddressAdmission {
    handshakes: Rc<HandshakeShares>,
    /// Addresses of listed peers.
    listed: BTreeSet<IpAddr>,
    said: LoggedRefusals,
}

impl AddressAdmission {
    /// Creates the state without handshakes and links.
    pub(super) fn new() -> Self {
        Self {
            handshakes: HandshakeShares::new(MAX_HANDSHAKES),
            listed: BTreeSet::new(),
            said: LoggedRefusals::default(),
        }
    }

    /// Sets the addresses of listed peers.
    pub(super) fn set_listed(&mut self, addresses: BTreeSet<IpAddr>) {
        self.listed = addresses;
    }

    /// Returns whether this is the address of a listed peer.
    pub(super) fn is_listed(&self, address: IpAddr) -> bool {
        self.listed.contains(&address.to_canonical())
    }

    /// Returns a place for a handshake from this address.
    pub(super) fn enter(&self, address: IpAddr) -> Option<HandshakeSlot> {
        self.handshakes.enter(address, self.listed.contains(&address.to_canonical()))
    }

    /// Returns whether a refusal at this address should be reported, and counts it as reported then.
    pub(super) fn is_new(&mut self, address: IpAddr, now: Duration) -> bool {
        self.said.is_new(address, now)
    }

    /// Returns the link that gives way to a link of a newcomer. `links` are the existing links.
    pub(super) fn gives_way(&self, newcomer: IpAddr, links: &[(IpAddr, u64)]) -> Option<u64> {
        gives_way(newcomer, links, |address| self.listed.contains(&address.to_canonical()))
    }
}
