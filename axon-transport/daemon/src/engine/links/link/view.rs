//! A view of a link for the rest of the engine.

use std::rc::Rc;

use axon_transport::{
    access::{AccessRules, Permissions},
    status::LinkStatus,
};
use quinn_proto::StreamId;

use super::{EstablishedPeer, LinkPeer};
use crate::{
    engine::{
        account::Account, link::failure::peer_text, quic::connection::Connection, rank::FlowId,
    },
    owner::ChannelBinding,
};

/// A view of a link whose connection exists: the connection, and its peer once that proved its name.
pub(in crate::engine) struct LinkView<'a> {
    connection: &'a Connection,
    peer: Option<&'a LinkPeer>,
}

impl<'a> LinkView<'a> {
    pub(in crate::engine::links) fn new(
        connection: &'a Connection,
        peer: Option<&'a LinkPeer>,
    ) -> Self {
        Self { connection, peer }
    }

    /// Returns the data from the link's beginning.
    pub(in crate::engine) fn summary(&self) -> Option<&'a EstablishedPeer> {
        Some(&self.peer?.summary)
    }

    /// Returns the account of the peer.
    pub(in crate::engine) fn account(&self) -> Option<Rc<Account>> {
        Some(Rc::clone(&self.peer?.account))
    }

    /// Returns the identity that the peer proved, beyond its daemon id.
    pub(in crate::engine) fn identity(&self) -> Option<String> {
        Some(self.summary()?.who.host_identity(self.connection.quic.remote_address()))
    }

    /// Returns the peer's permissions by the access rules. For a peer that proved nothing, the address is the one at
    /// which the handshake took place: any later one may be spoofed.
    pub(in crate::engine) fn permissions(&self, rules: &AccessRules) -> Option<Permissions> {
        Some(rules.permissions(self.summary()?.who.party(self.connection.began_at)))
    }

    /// Returns the status of the link.
    pub(in crate::engine) fn status(&self) -> Option<LinkStatus> {
        let peer = self.peer?;
        let mut status = peer.summary.status(peer.since);
        status.party = peer.summary.who.party(self.connection.began_at).to_string();
        self.connection.fill(&mut status);
        Some(status)
    }

    /// Returns the peer's name for log and status.
    pub(in crate::engine) fn peer_text(&self) -> String {
        let sae = self.summary().and_then(|summary| summary.hello.sae.as_deref());
        peer_text(sae, self.connection.quic.remote_address())
    }

    /// Returns the bytes that both ends of the connection share and no other connection has.
    pub(in crate::engine) fn binding(&self) -> Option<ChannelBinding> {
        self.connection.binding()
    }

    /// Returns the flow of a stream.
    pub(in crate::engine) fn flow_of(&self, stream: StreamId) -> Option<FlowId> {
        self.connection.flows.get(&stream).copied()
    }
}
