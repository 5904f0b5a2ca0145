//! Carries requests and responses over a relay. In the daemon the clients and servers are the session's
//! own; in the session's process they are stand-ins for remote ones. The rest is the same at both ends.

use std::collections::BTreeMap;

use axon_shm::Sample;

use super::{
    flow::{FlowChannel, OutboundSample, SampleContent, SamplePayload},
    unanswered::Unanswered,
};
use crate::{
    ids::Gid,
    session::{
        endpoints::RemoteWriter,
        merge::{Merge, MergedSample},
    },
};

/// The progress of the requests that a relay's clients send to the other end.
#[derive(Default)]
pub struct CallChannels {
    /// The requests of each client on this side, read through the stand-ins of the servers.
    requests: BTreeMap<Gid, Merge<Sample>>,
    /// The number up to which the other end has confirmed the requests of a client.
    done: BTreeMap<Gid, u64>,
}

impl CallChannels {
    /// Sets the pairs of client and server through which requests are taken.
    pub fn set(&mut self, pairs: impl Iterator<Item = (Gid, Gid)>) {
        let mut servers: BTreeMap<Gid, Vec<Gid>> = BTreeMap::new();
        for (client, server) in pairs {
            servers.entry(client).or_default().push(server);
        }
        self.requests.retain(|client, _| servers.contains_key(client));
        self.done.retain(|client, _| servers.contains_key(client));
        for (client, servers) in servers {
            self.requests.entry(client).or_default().set(servers);
        }
    }

    /// Takes the next request of `client` that has not been sent. The request came to each of the servers.
    pub fn request<'a>(
        &mut self,
        client: &Gid,
        find: impl Fn(&Gid) -> Option<&'a RemoteWriter>,
    ) -> Option<OutboundSample<SamplePayload>> {
        let requests = self.requests.get_mut(client)?;
        // Each server reads all requests, from the same memory: none is ahead of the others.
        let next = requests.next(|server| find(server)?.take_from(client).map(taken), |_| false);
        next.map(OutboundSample::from)
    }

    /// Like [`request`](Self::request), for the session's end: a request that is due to be sent again comes first, and
    /// each request is kept until it has a response.
    pub(super) fn request_to_send<'a>(
        &mut self,
        client: &Gid,
        unanswered: &mut Unanswered,
        find: impl Fn(&Gid) -> Option<&'a RemoteWriter>,
    ) -> Option<OutboundSample<SamplePayload>> {
        if let Some(again) = unanswered.next_due(client) {
            return Some(again);
        }
        let request = self.request(client, find)?;
        let mut payload = vec![0; request.content.len()];
        if request.content.read_at(0, &mut payload) == payload.len() {
            let servers = self.requests.get(client).into_iter().flat_map(Merge::readers);
            unanswered.add(*client, request.meta, payload, servers.copied().collect());
        }
        Some(request)
    }

    /// Takes the requests that were sent by way of another server. Returns whether there are more.
    pub fn pass_over<'a>(&mut self, find: impl Fn(&Gid) -> Option<&'a RemoteWriter>) -> bool {
        let mut more = false;
        for (client, requests) in &mut self.requests {
            more |= requests.pass_over(|server| find(server)?.take_from(client).map(taken));
            // The other end has the requests that were passed over.
            if requests.readers().nth(1).is_some()
                && let Some(number) = self.done.get(client)
            {
                finish(requests, client, *number, &find);
            }
        }
        more
    }

    /// Records that the other end has the requests of `client` up to this number, so that the client need not keep
    /// them.
    pub fn finish<'a>(
        &mut self,
        client: &Gid,
        number: u64,
        find: impl Fn(&Gid) -> Option<&'a RemoteWriter>,
    ) {
        if let Some(requests) = self.requests.get(client) {
            self.done.insert(*client, number);
            finish(requests, client, number, find);
        }
    }

    /// Returns whether a request of `client` came by way of `server` and is still to be sent.
    pub fn holds(&self, client: &Gid, server: &Gid) -> bool {
        self.requests.get(client).is_some_and(|requests| requests.holds(server))
    }
}

fn finish<'a>(
    requests: &Merge<Sample>,
    client: &Gid,
    number: u64,
    find: impl Fn(&Gid) -> Option<&'a RemoteWriter>,
) {
    let servers = requests.readers().filter_map(find);
    servers.for_each(|server| server.finish_requests(client, number));
}

/// Takes the next response on `channel`. The stand-in of the channel's client reads it.
pub fn response<'a>(
    channel: &FlowChannel,
    find: impl Fn(&Gid) -> Option<&'a RemoteWriter>,
) -> Option<OutboundSample<SamplePayload>> {
    let client = find(&channel.client?)?;
    client.take_from(&channel.writer).map(taken).map(OutboundSample::from)
}

fn taken(content: Sample) -> MergedSample<Sample> {
    MergedSample { number: content.meta().sequence, lost: 0, content }
}
