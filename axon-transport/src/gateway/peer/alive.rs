//! Who is alive, where nobody publishes: what publishers with a lease say goes to the other host, and
//! what those there say comes here.

use std::collections::BTreeMap;

use super::Peer;
use crate::{
    gateway::outbound::Source,
    ids::Gid,
    link::{Asserted, Message},
};

/// Publishers in one ASSERTED.
const PART: usize = 1024;

impl Peer {
    /// Tells the peer which publishers that feed it were alive since it was told last.
    pub(in crate::gateway) fn tell_alive(&mut self) {
        let mut alive: BTreeMap<Gid, u64> = BTreeMap::new();
        for source in self.served.values().flat_map(|served| &served.sources) {
            if let Source::Relay(_, subscription) = source {
                alive.extend(subscription.assertions());
            }
        }
        let news = alive.iter().filter(|(gid, at)| self.told_alive.get(gid) != Some(at));
        let news: Vec<Gid> = news.map(|(gid, _)| *gid).collect();
        for part in news.chunks(PART) {
            self.say(Message::Asserted(Asserted { publishers: part.to_vec() }));
        }
        self.told_alive = alive;
    }

    /// The peer's publishers that were. Of others it has nothing to say: they are on no route of its.
    pub(in crate::gateway) fn hear_alive(&self, asserted: &Asserted) {
        let stand_ins = asserted.publishers.iter().filter_map(|gid| self.routes_in.stand_in(gid));
        stand_ins.for_each(|stand_in| stand_in.assert_alive());
    }
}
