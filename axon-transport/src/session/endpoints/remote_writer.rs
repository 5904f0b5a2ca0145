//! Local stand-in for a remote writer: a publisher, client or server that represents one in another process, on this
//! host or another. The gateway and relays write incoming messages to it.

use std::sync::Arc;

use axon_shm::{Meta, PublishError, Sample, internal::MemoryBudget};

use super::{client::Client, publisher::Publisher, server::Server};
use crate::{
    graph::{Endpoint, EndpointKind},
    ids::Gid,
    qos::Qos,
    session::{core::Outgoing, error::SessionError, handle::Session},
    wire::session::{EndpointRole, SessionMessage, WriterLeaving},
};

/// What stands for it here. Of a service it reads, too: a client's is given the responses that go to
/// where the client is, and a server's the requests.
pub enum RemoteWriter {
    /// Of a publisher.
    Publisher(Publisher),
    /// Of a service's client.
    Client(Client),
    /// Of a service's server.
    Server(Server),
}

/// What became of a message that was to be written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Written {
    /// Its readers have it.
    Yes,
    /// The client that it answers is gone.
    Nobody,
}

impl RemoteWriter {
    /// A stand-in for `remote`, under its GID, which takes the memory for what it holds of `budget`. For gateways
    /// alone; a daemon refuses it from anybody else.
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

    /// As [`stand_in`](Self::stand_in). A client says which of the responses that it takes are
    /// [where they are to go](Self::finish_through): until then its servers keep them.
    ///
    /// # Errors
    /// When there is no memory.
    pub(crate) fn carrying(session: &Session, remote: Endpoint) -> Result<Self, SessionError> {
        Self::new(session, remote, EndpointRole::StandIn, true, None)
    }

    /// An endpoint of `session` as another process of the session describes it, under its GID there. A client
    /// [says](Self::finish_through) which responses that process has, and a server which
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
        // What it takes is another's, whose depth counts there.
        let all = Qos::keep_all();
        Ok(match of.kind {
            EndpointKind::Client => {
                Self::Client(session.add_client(of, role, all, carries, budget)?)
            }
            EndpointKind::Server => {
                // Requests to a stand-in are kept by the relay until they have a response (`relayed::unanswered`).
                let carries = carries && role == EndpointRole::Application;
                Self::Server(session.add_server(of, role, all, carries, budget))
            }
            _ => Self::Publisher(session.add_asserted(of, role, budget)?),
        })
    }

    /// What it stands for.
    pub fn endpoint(&self) -> &Endpoint {
        match self {
            Self::Publisher(publisher) => publisher.endpoint(),
            Self::Client(client) => client.endpoint(),
            Self::Server(server) => server.endpoint(),
        }
    }

    /// Those here whom it reaches and who, where it is of a service, reach it; whether or not they
    /// have ended but for what they left.
    pub fn partners(&self) -> Vec<Gid> {
        match self {
            Self::Publisher(publisher) => publisher.matched(),
            Self::Client(client) => client.attached(),
            Self::Server(server) => server.attached(),
        }
    }

    /// Says that it has ended but for what is to be written, or that it has not: nobody counts it
    /// until then, and those who read it get the rest.
    pub fn leave(&self, leaving: bool) {
        let session = match self {
            Self::Publisher(publisher) => &publisher.session,
            Self::Client(client) => &client.session,
            Self::Server(server) => &server.session,
        };
        let leaving = WriterLeaving { gid: self.endpoint().gid, leaving };
        session.core().tell(Outgoing::message(SessionMessage::Leaving(leaving)));
    }

    /// Writes a sample, a request, or a response to `client`, without waiting for room.
    ///
    /// # Errors
    /// [`PublishError::Blocked`] when there is none; the others say what does not fit.
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

    /// As [`try_write`](Self::try_write), but readers of a sample that sleep may sleep on until
    /// [`announce`](Self::announce): for several that are written together.
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

    /// Wakes the readers that sleep, for samples that were written [quietly](Self::try_write_quietly).
    pub fn announce(&self) {
        if let Self::Publisher(publisher) = self {
            publisher.announce();
        }
    }

    /// The number up to which what it has written is where it is to go, as far as that takes longer than
    /// writing it.
    pub fn delivered_up_to(&self) -> Option<u64> {
        match self {
            Self::Publisher(publisher) => Some(publisher.delivered_up_to()),
            Self::Client(_) | Self::Server(_) => None,
        }
    }

    /// How many responses to `client` are written and not where they are to go.
    pub fn undelivered(&self, client: &Gid) -> u64 {
        match self {
            Self::Server(server) => server.undelivered(client),
            Self::Publisher(_) | Self::Client(_) => 0,
        }
    }

    /// Of a client that carries: the response of this number, and all that it took of `server` before, are where they
    /// are to go.
    pub fn finish_through(&self, server: &Gid, number: u64) {
        if let Self::Client(client) = self {
            client.finish_through(server, number);
        }
    }

    /// Of a server that carries: the requests of `client` up to this number are where they are to go. Until then the
    /// client keeps them.
    pub fn finish_requests(&self, client: &Gid, number: u64) {
        if let Self::Server(server) = self {
            server.finish_requests(client, number);
        }
    }

    /// Of a client that carries: responses that are not [where they are to go](Self::finish_through) are to be taken
    /// once more.
    pub(crate) fn take_back(&self) {
        if let Self::Client(client) = self {
            client.take_back();
        }
    }

    /// The number of written samples that do not reach their reader, if the publisher waits for readers. All
    /// samples below a number that was [handed over](Self::delivered_up_to) before are counted.
    pub fn given_up(&self) -> Option<u64> {
        match self {
            Self::Publisher(publisher) => Some(publisher.given_up()),
            Self::Client(_) | Self::Server(_) => None,
        }
    }

    /// The next request or response of `writer`, in place.
    pub fn take_from(&self, writer: &Gid) -> Option<Sample> {
        match self {
            Self::Publisher(_) => None,
            Self::Client(client) => client.take_response_from(writer),
            Self::Server(server) => server.take_request_from(writer),
        }
    }

    /// Whether there is a request or response of `writer` to be taken.
    pub fn has_from(&self, writer: &Gid) -> bool {
        match self {
            Self::Publisher(_) => false,
            Self::Client(client) => client.has_response_from(writer),
            Self::Server(server) => server.has_request_from(writer),
        }
    }

    /// Of a server: how many requests of `client` it has not taken. Of a client, which `client` names: how many responses.
    pub fn unread_of(&self, client: &Gid) -> u64 {
        match self {
            Self::Server(server) => server.unread_of(client),
            Self::Client(own) if *client == own.gid() => own.unread(),
            Self::Publisher(_) | Self::Client(_) => 0,
        }
    }

    /// Of a server: how many requests of `client` found no room, if one that it has not taken is why the next one may not.
    /// Of a client, which `client` names: the same of responses.
    pub fn refused_of(&self, client: &Gid) -> Option<u64> {
        match self {
            Self::Server(server) => server.refused_of(client),
            Self::Client(own) if *client == own.gid() => own.refused(),
            Self::Publisher(_) | Self::Client(_) => None,
        }
    }

    /// Asserts its liveliness: the process that speaks for the writer says that it is alive.
    pub fn assert_alive(&self) {
        if let Self::Publisher(publisher) = self {
            // Only a forked child is refused.
            let _ = publisher.assert_liveliness();
        }
    }
}
