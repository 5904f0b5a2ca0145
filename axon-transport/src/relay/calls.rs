//! Services: what of them goes to the other end of a relay. In the daemon clients and servers are the
//! session's own, in the session's process they stand for the world's; otherwise both ends do the same.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use super::flow::{Channel, Departing};
use crate::{ids::Gid, session::Face, shm::Sample};

/// The channels to the other end that a relay's clients and servers call for, and how far they have got.
#[derive(Default)]
pub(super) struct Calls {
    /// The servers here of each client that is on this side.
    servers: BTreeMap<Gid, BTreeSet<Gid>>,
    /// The number of each client's newest request that has been sent.
    sent: HashMap<Gid, u64>,
}

impl Calls {
    /// From now on these are the pairs of client and server by way of whose servers requests are taken.
    pub(super) fn set(&mut self, pairs: impl Iterator<Item = (Gid, Gid)>) {
        self.servers.clear();
        for (client, server) in pairs {
            self.servers.entry(client).or_default().insert(server);
        }
        self.sent.retain(|client, _| self.servers.contains_key(client));
    }

    /// The next request of `client` that has not been sent. It came to each of the servers.
    pub(super) fn request<'a>(
        &mut self,
        client: &Gid,
        find: impl Fn(&Gid) -> Option<&'a Face>,
    ) -> Option<Departing<Sample>> {
        for server in self.servers.get(client)?.iter().filter_map(find) {
            while let Some(request) = server.take_from(client) {
                let sequence = request.meta().sequence;
                if self.sent.get(client).is_none_or(|sent| sequence > *sent) {
                    self.sent.insert(*client, sequence);
                    return Some(departing(request));
                }
            }
        }
        None
    }
}

/// The next response on `channel`; `client` finds the one that it is for.
pub(super) fn response<'a>(
    channel: &Channel,
    find: impl Fn(&Gid) -> Option<&'a Face>,
) -> Option<Departing<Sample>> {
    let client = find(&channel.client?)?;
    client.take_from(&channel.writer).map(departing)
}

fn departing(content: Sample) -> Departing<Sample> {
    Departing { meta: content.meta(), lost: 0, content }
}
