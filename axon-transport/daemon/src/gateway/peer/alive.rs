//! Liveliness between hosts: tells the peer which publishers with a lease were asserted here, and takes
//! what the peer tells.

use std::time::{Duration, Instant};

use super::Peer;
use crate::{
    gateway::{account::MAX_STAND_INS, outbound::Source},
    link::{Asserted, Message},
};

impl Peer {
    /// How long it is until the peer is to be told who is alive; `None` when nobody has a lease.
    pub(in crate::gateway) fn alive_in(&self, now: Instant) -> Option<Duration> {
        self.alive.left(now)
    }

    /// If it is time: tells the peer which publishers that feed it were alive since it was told last.
    pub(in crate::gateway) fn tell_alive(&mut self, now: Instant) {
        let sources = self.served.values().flat_map(|served| &served.sources);
        let asserted = sources.flat_map(|source| match source {
            Source::Relay(_, subscription) => subscription.assertions(),
            Source::StandIn(_) => Vec::new(),
        });
        for publishers in self.alive.news(now, asserted) {
            self.say(Message::Asserted(Asserted { publishers }));
        }
    }

    /// The peer's publishers that were. Of others it has nothing to say: they are on no route of its.
    pub(in crate::gateway) fn hear_alive(&self, asserted: &Asserted) {
        let known = asserted.publishers.iter().filter(|gid| self.remote.get(gid).is_some());
        let stand_ins = known.take(MAX_STAND_INS).filter_map(|gid| self.routes_in.stand_in(gid));
        stand_ins.for_each(|stand_in| stand_in.assert_alive());
    }
}
