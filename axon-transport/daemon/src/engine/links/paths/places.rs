//! The places of the links that stand by: all peers together have a fixed number of them.

use std::time::Duration;

use axon_shm::ids::DaemonId;

use crate::engine::links::Links;

/// Maximum number of links that stand by, of all peers.
const MAX_STANDBY: usize = 64;

impl Links {
    /// Makes a place for a link of a daemon that is to stand by. If there is none, the second link of an address that
    /// has at least two more of them than this link's ends. Returns whether there is a place.
    pub(super) fn make_standby_place(
        &mut self,
        number: u64,
        daemon: DaemonId,
        now: Duration,
    ) -> bool {
        if self.table.standby(daemon).is_some() || self.table.standby_count() < MAX_STANDBY {
            return true;
        }
        let Some(newcomer) = self.connections.address(number) else { return false };
        let all = self.table.all_standby().filter_map(|(daemon, number)| {
            Some((self.connections.address(number)?.ip(), number, daemon))
        });
        let all: Vec<_> = all.collect();
        let links: Vec<_> = all.iter().map(|(address, number, _)| (*address, *number)).collect();
        let gives_way = self.admission.gives_way(newcomer.ip(), &links);
        let Some((_, number, daemon)) =
            all.into_iter().find(|(_, number, _)| Some(*number) == gives_way)
        else {
            return false;
        };
        self.handle_standby_ended(number, daemon, now);
        self.end_standby(
            number,
            "a host at an address with fewer second links takes its place",
            now,
        );
        true
    }
}
