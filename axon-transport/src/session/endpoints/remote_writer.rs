//! Local stand-in for a remote writer: a publisher, client or server that represents one in another process, on this
//! host or another. The gateway and relays write incoming messages to it.

use std::sync::Arc;

use axon_shm::{Meta, PublishError, Sample, internal::MemoryBudget};

use super::{client::Client, factory::EndpointFactory, publisher::Publisher, server::Server};
use crate::{
    graph::{Endpoint, EndpointKind},
    ids::Gid,
    qos::Qos,
    session::{core::Outgoing, error::SessionError, handle::Session},
    wire::session::{EndpointRole, SessionMessage, WriterLeaving},
};

/// Stand-in for a remote writer, by kind. The stand-ins of a service read, too: a client's stand-in takes the responses
/// for the client, and a server's stand-in takes the requests.
pub enum RemoteWriter {
    /// The stand-in of a publisher.
    Publisher(Publisher),
    /// The stand-in of a service's client.
    Client(Client),
    /// The stand-in of a service's server.
    Server(Server),
}

/// The result of writing a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Written {
    /// The readers have the message.
    Yes,
    /// The client that it answers is gone.
    Nobody,
}

impl RemoteWriter {
    /// Creates a stand-in for `remote`, under its GID, which takes the memory for its messages from `budget`. Only
    /// gateways may call this; a daemon refuses it from any other session.
    ///
    /// # Errors
    /// When there is no memory.
    pub fn stand_in(
        session: &Session,
        remote: Endpoint,
        budget: &Arc<MemoryBudget>,
    ) -> Result<Self, SessionError> {
        Self::new(session, remote, EndpointRole::StandIn, false, Some(budget))
    }

    /// Like [`stand_in`](Self::stand_in). A client confirms which of the responses that it takes [are
    /// delivered](Self::finish_through): until then its servers keep them.
    ///
    /// # Errors
    /// When there is no memory.
    pub(crate) fn carrying(session: &Session, remote: Endpoint) -> Result<Self, SessionError> {
        Self::new(session, remote, EndpointRole::StandIn, true, None)
    }

    /// Creates an endpoint of `session` as another process of the session describes it, under its GID there. A client
    /// [confirms](Self::finish_through) the responses that the other process has, and a server the
    /// [requests](Self::finish_requests).
    ///
    /// # Errors
    /// When there is no memory.
    pub fn adopt(session: &Session, own: Endpoint) -> Result<Self, SessionError> {
        Self::new(session, own, EndpointRole::Application, true, None)
    }

    fn new(
        session: &Session,
        of: Endpoint,
        role: EndpointRole,
        carries: bool,
        budget: Option<&Arc<MemoryBudget>>,
    ) -> Result<Self, SessionError> {
        // It takes the messages for another endpoint, whose depth applies there.
        let all = Qos::keep_all();
        Ok(match of.kind {
            EndpointKind::Client => {
                Self::Client(EndpointFactory(session).add_client(of, role, all, carries, budget)?)
            }
            EndpointKind::Server => {
                // Requests to a stand-in are kept by the relay until they have a response (`relayed::unanswered`).
                let carries = carries && role == EndpointRole::Application;
                Self::Server(EndpointFactory(session).add_server(of, role, all, carries, budget))
            }
            _ => Self::Publisher(EndpointFactory(session).add_asserted(of, role, budget)?),
        })
    }

    /// Returns the endpoint that it stands for.
    pub fn endpoint(&self) -> &Endpoint {
        match self {
            Self::Publisher(publisher) => publisher.endpoint(),
            Self::Client(client) => client.endpoint(),
            Self::Server(server) => server.endpoint(),
        }
    }

    /// Returns the local endpoints that it reaches and, for a service, that also reach it. Endpoints that have ended
    /// and still have messages are included.
    pub fn partners(&self) -> Vec<Gid> {
        match self {
            Self::Publisher(publisher) => publisher.matched(),
            Self::Client(client) => client.attached(),
            Self::Server(server) => server.attached(),
        }
    }

    /// Announces that the remote writer has ended except for messages still to be written, or that it has not ended. No
    /// endpoint counts it meanwhile, and its readers get the rest.
    pub fn leave(&self, leaving: bool) {
        let session = match self {
            Self::Publisher(publisher) => &publisher.session,
            Self::Client(client) => &client.session,
            Self::Server(server) => &server.session,
        };
        let leaving = WriterLeaving { gid: self.endpoint().gid, leaving };
        session.core().tell(Outgoing::message(SessionMessage::Leaving(leaving)));
    }

    /// Writes a sample, a request, or a response to `client`, without waiting for space.
    ///
    /// # Errors
    /// [`PublishError::Blocked`] if there is no space. The other variants tell why the message was not written.
    pub fn try_write(
        &self,
        client: &Gid,
        meta: Meta,
        payload: &[u8],
    ) -> Result<Written, PublishError> {
        let there = match self {
            Self::Publisher(publisher) => {
                publisher.try_publish_with(meta, payload)?;
                true
            }
            Self::Client(client) => {
                client.try_forward(meta, payload)?;
                true
            }
            Self::Server(server) => server.try_respond(client, meta, payload)?,
        };
        Ok(if there { Written::Yes } else { Written::Nobody })
    }

    /// Like [`try_write`](Self::try_write), but sleeping readers of a sample may sleep on until
    /// [`announce`](Self::announce): for several messages that are written together.
    ///
    /// # Errors
    /// As for [`try_write`](Self::try_write).
    pub fn try_write_quietly(
        &self,
        client: &Gid,
        meta: Meta,
        payload: &[u8],
    ) -> Result<Written, PublishError> {
        match self {
            Self::Publisher(publisher) => {
                publisher.try_publish_quietly(meta, payload).map(|()| Written::Yes)
            }
            Self::Client(_) | Self::Server(_) => self.try_write(client, meta, payload),
        }
    }

    /// Wakes sleeping readers, for samples that were written [quietly](Self::try_write_quietly).
    pub fn announce(&self) {
        if let Self::Publisher(publisher) = self {
            publisher.announce();
        }
    }

    /// Returns the number up to which its written samples are delivered, for a writer whose delivery takes longer than
    /// the write.
    pub fn delivered_up_to(&self) -> Option<u64> {
        match self {
            Self::Publisher(publisher) => Some(publisher.delivered_up_to()),
            Self::Client(_) | Self::Server(_) => None,
        }
    }

    /// Returns the number of responses to `client` that are written and not delivered.
    pub fn undelivered(&self, client: &Gid) -> u64 {
        match self {
            Self::Server(server) => server.undelivered(client),
            Self::Publisher(_) | Self::Client(_) => 0,
        }
    }

    /// Confirms, for a client that carries, the delivery of the response of this number, and of all responses that it
    /// took from `server` before.
    pub fn finish_through(&self, server: &Gid, number: u64) {
        if let Self::Client(client) = self {
            client.finish_through(server, number);
        }
    }

    /// Confirms, for a server that carries, the delivery of the requests of `client` up to this number. Until then the
    /// client keeps them.
    pub fn finish_requests(&self, client: &Gid, number: u64) {
        if let Self::Server(server) = self {
            server.finish_requests(client, number);
        }
    }

    /// Makes responses available again, for a client that carries, whose delivery is [not
    /// confirmed](Self::finish_through).
    pub(crate) fn take_back(&self) {
        if let Self::Client(client) = self {
            client.take_back();
        }
    }

    /// Returns the number of written samples that do not reach their reader, if the publisher waits for readers. All
    /// samples below a number that was [handed over](Self::delivered_up_to) before are counted.
    pub fn given_up(&self) -> Option<u64> {
        match self {
            Self::Publisher(publisher) => Some(publisher.given_up()),
            Self::Client(_) | Self::Server(_) => None,
        }
    }

    /// Takes the next request or response of `writer`, in place.
    pub fn take_from(&self, writer: &Gid) -> Option<Sample> {
        match self {
            Self::Publisher(_) => None,
            Self::Client(client) => client.take_response_from(writer),
            Self::Server(server) => server.take_request_from(writer),
        }
    }

    /// Returns whether there is a request or response of `writer` to take.
    pub fn has_from(&self, writer: &Gid) -> bool {
        match self {
            Self::Publisher(_) => false,
            Self::Client(client) => client.has_response_from(writer),
            Self::Server(server) => server.has_request_from(writer),
        }
    }

    /// Returns, for a server, the number of unconfirmed requests of `client`, including untaken ones. For a client,
    /// which `client` names, returns the number of unconfirmed responses.
    pub fn unread_of(&self, client: &Gid) -> u64 {
        match self {
            Self::Server(server) => server.unread_of(client),
            Self::Client(own) if *client == own.gid() => own.unread(),
            Self::Publisher(_) | Self::Client(_) => 0,
        }
    }

    /// Returns, for a server, how many requests of `client` found no space, if an unconfirmed request may be the
    /// reason. For a client, which `client` names, returns the same of responses.
    pub fn refused_of(&self, client: &Gid) -> Option<u64> {
        match self {
            Self::Server(server) => server.refused_of(client),
            Self::Client(own) if *client == own.gid() => own.refused(),
            Self::Publisher(_) | Self::Client(_) => None,
        }
    }

    /// Asserts its liveliness, because the process that represents the writer reports that it is alive.
    pub fn assert_alive(&self) {
        if let Self::Publisher(publisher) = self {
            // Fails only in a forked child.
            let _ = publisher.assert_liveliness();
        }
    }
}
