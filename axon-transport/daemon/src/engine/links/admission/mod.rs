//! Admits handshakes and links by the address of the peer.

mod shares;

use std::{collections::BTreeSet, net::IpAddr, rc::Rc, time::Duration};

pub(super) use self::shares::HandshakeSlot;
pub(crate) use self::shares::place;
use self::shares::{HandshakeShares, LoggedRefusals, gives_way};

/// Handshakes under way at once, but for those of listed peers; further dials are refused and come again.
const MAX_HANDSHAKES: usize = 64;

/// What the addresses of peers have, and what they may have.
pub(super) struct AddressAdmission {
    handshakes: Rc<HandshakeShares>,
    /// Addresses of listed peers.
    listed: BTreeSet<IpAddr>,
    said: LoggedRefusals,
}

impl AddressAdmission {
    /// Nobody has anything yet.
    pub(super) fn new() -> Self {
        Self {
            handshakes: HandshakeShares::new(MAX_HANDSHAKES),
            listed: BTreeSet::new(),
            said: LoggedRefusals::default(),
        }
    }

    /// The addresses of listed peers.
    pub(super) fn set_listed(&mut self, addresses: BTreeSet<IpAddr>) {
        self.listed = addresses;
    }

    /// Whether this is the address of a listed peer.
    pub(super) fn is_listed(&self, address: IpAddr) -> bool {
        self.listed.contains(&address.to_canonical())
    }

    /// A place for a handshake from this address.
    pub(super) fn enter(&self, address: IpAddr) -> Option<HandshakeSlot> {
        self.handshakes.enter(address, self.listed.contains(&address.to_canonical()))
    }

    /// Whether a refusal at this address is to be said, which it then was.
    pub(super) fn is_new(&mut self, address: IpAddr, now: Duration) -> bool {
        self.said.is_new(address, now)
    }

    /// The link that gives way to one of a newcomer. `links` are those there are.
    pub(super) fn gives_way(&self, newcomer: IpAddr, links: &[(IpAddr, u64)]) -> Option<u64> {
        gives_way(newcomer, links, |address| self.listed.contains(&address.to_canonical()))
    }
}
