//! A link as the rest of the engine asks about it.

use std::rc::Rc;

use axon_transport::{
    access::{AccessRules, Permissions},
    status::LinkStatus,
};
use quinn_proto::StreamId;

use super::{EstablishedPeer, LinkPeer};
use crate::{
    engine::{
        account::Account, link::failure::peer_text, outbound::FlowId, quic::connection::Connection,
    },
    owner::ChannelBinding,
};

/// A link whose connection stands: the connection, and its peer once that proved its name.
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

    /// The beginning of the link.
    pub(in crate::engine) fn summary(&self) -> Option<&'a EstablishedPeer> {
        Some(&self.peer?.summary)
    }

    /// The account of the peer.
    pub(in crate::engine) fn account(&self) -> Option<Rc<Account>> {
        Some(Rc::clone(&self.peer?.account))
    }

    /// Who the peer proved to be, beyond its daemon id.
    pub(in crate::engine) fn identity(&self) -> Option<String> {
        Some(self.summary()?.who.host_identity(self.connection.quic.remote_address()))
    }

    /// What access rules let the peer do. The address of one that proved nothing is that at which the handshake took
    /// place: any later one may be spoofed.
    pub(in crate::engine) fn permissions(&self, rules: &AccessRules) -> Option<Permissions> {
        Some(rules.permissions(self.summary()?.who.party(self.connection.began_at)))
    }

    /// The status of the link.
    pub(in crate::engine) fn status(&self) -> Option<LinkStatus> {
        let peer = self.peer?;
        let mut status = peer.summary.status(peer.since);
        status.party = peer.summary.who.party(self.connection.began_at).to_string();
        self.connection.fill(&mut status);
        Some(status)
    }

    /// The peer, as log and status name it.
    pub(in crate::engine) fn peer_text(&self) -> String {
        let sae = self.summary().and_then(|summary| summary.hello.sae.as_deref());
        peer_text(sae, self.connection.quic.remote_address())
    }

    /// Bytes that both ends of the connection share and no other connection has.
    pub(in crate::engine) fn binding(&self) -> Option<ChannelBinding> {
        self.connection.binding()
    }

    /// The flow of a stream.
    pub(in crate::engine) fn flow_of(&self, stream: StreamId) -> Option<FlowId> {
        self.connection.flows.get(&stream).copied()
    }
}
