//! Two paths to a peer: a second link stands by at another address of the peer, and takes over when the path of the
//! link in use does not answer.

mod budget;
mod choice;
mod copies;
mod failover;
mod peers;
mod places;
mod search;
mod take_over_budget;
mod take_overs;

use std::{
    net::{IpAddr, SocketAddr},
    time::Duration,
};

use axon_shm::ids::DaemonId;
use axon_transport::status::StandbyStatus;
use rand::RngExt;

pub(super) use self::peers::PeerPaths;
use self::{
    choice::{PathChoice, PathQuality},
    failover::{Failover, FailoverStep},
    peers::Paths,
    search::{PathSearch, is_other},
};
use super::{
    Links,
    identity::OTHERS,
    link::{
        LinkPhase,
        age::{Age, AgeStep},
    },
    silence::Nonce,
};
use crate::{
    engine::{
        congestion::let_probe_through,
        link::{opening::Sealing, target::DialTarget},
        links::LinkEvent,
        quic::{
            answers::{AnswerWatch, Exchange},
            connection::Connection,
        },
    },
    link::{CloseCode, Elected, LinkHello, LinkMessage, Side},
    wire::beacon::Datagram,
};

/// Time since its last packet after which another link may replace one that stands by.
const STANDBY_SILENT: Duration = Duration::from_secs(15);

impl Links {
    /// Returns whether this host and the peer support a second link at a time.
    fn has_two_paths(&self, hello: &LinkHello) -> bool {
        self.config.link.paths > 1 && hello.paths.is_some_and(|paths| paths > 1)
    }

    /// Returns whether a connection may stand by: `beside` names the link in use, as the dialler's HELLO states.
    fn is_beside(&self, hello: &LinkHello, beside: Option<[u8; 16]>) -> bool {
        let current = self.table.current_peer(hello.daemon);
        beside.is_some()
            && self.has_two_paths(hello)
            && current.is_some_and(|current| current.elected.map(|e| e.link) == beside)
    }

    /// Returns whether this side elects a connection to stand by. A second link of another host may end for it.
    pub(super) fn may_stand_by(
        &mut self,
        number: u64,
        hello: &LinkHello,
        beside: Option<[u8; 16]>,
        now: Duration,
    ) -> bool {
        let daemon = hello.daemon;
        let is_needed = self.standby_silent_at(daemon) <= now;
        is_needed
            && self.is_beside(hello, beside)
            && !self.has_path_in_use(number, daemon)
            && self.make_standby_place(number, daemon, now)
    }

    /// Returns the time from which on there is no second path to a peer: its second link was silent for a while, or
    /// there is none.
    fn standby_silent_at(&self, daemon: DaemonId) -> Duration {
        let standby = self.table.standby(daemon).and_then(|number| self.table.peer(number));
        standby.map_or(Duration::ZERO, |peer| peer.silence.heard_at() + STANDBY_SILENT)
    }

    /// Returns whether a link has the path of the peer's link in use: the same address there, and the same here.
    fn has_path_in_use(&self, number: u64, daemon: DaemonId) -> bool {
        let connection = |number| self.connections.get(number);
        let Some(in_use) = self.table.current(daemon).and_then(connection) else { return false };
        let Some(other) = connection(number) else { return false };
        let [one, two] = [in_use, other].map(|connection| connection.quic.remote_address());
        !is_other(one, two) && !is_apart(in_use.local(), other.local())
    }

    /// Elects a connection to stand by.
    pub(super) fn elect_standby(&mut self, number: u64, now: Duration) {
        let elected = self.next_elected(None, Some(true));
        self.send(number, &LinkMessage::Elected(elected), now);
        self.stand_by(number, elected, now);
    }

    /// Handles that a connection was elected to stand by.
    fn stand_by(&mut self, number: u64, elected: Elected, now: Duration) {
        let (Some(address), Some(link)) =
            (self.connections.address(number), self.table.get(number))
        else {
            return;
        };
        let Some(peer) = &link.peer else { return };
        let (daemon, beside, side) = (peer.summary.hello.daemon, link.beside, link.side);
        let (who, proven) = (peer.summary.who.clone(), peer.proven);
        if beside.is_none() {
            let why = "ELECTED makes a link stand by that was not dialled for that";
            return self.violation(number, CloseCode::OutOfOrder, why, now);
        }
        // Another host may have linked under the daemon's id since this connection's HELLO.
        if let Err(why) = self.claim(daemon, &who, proven, now) {
            return self.violation_told(number, CloseCode::NotAllowed, &why, OTHERS, now);
        }
        let is_beside =
            self.table.peer(number).is_some_and(|p| self.is_beside(&p.summary.hello, beside));
        let earlier = self.table.standby(daemon);
        let elected_before = earlier.and_then(|earlier| self.table.peer(earlier)?.elected);
        let is_older = elected_before.is_some_and(|before| before.election > elected.election);
        if !is_beside || is_older || self.has_path_in_use(number, daemon) {
            // The link in use changed meanwhile, or messages on two connections overtook each other.
            self.end_standby(number, "the link beside it changed", now);
            return self.opening_failed(number, None);
        }
        if !self.make_standby_place(number, daemon, now) {
            self.end_standby(number, "this daemon has as many second links as it may", now);
            return self.opening_failed(number, None);
        }
        let sealing = self.table.peer(number).and_then(|peer| peer.sealing.as_ref());
        if let (Some(keyring), Some(Sealing { exporters, .. })) = (&mut self.keyring, sealing)
            && let Err(error) = keyring.attach_standby(now, number, exporters)
        {
            tracing::error!(peer = %daemon, %error, "no message keys for the second link");
        }
        let max_age = self.keyring.as_ref().map(|keyring| keyring.config.session_max_age);
        let Some(link) = self.table.get_mut(number) else { return };
        link.phase = LinkPhase::Standby;
        if let Some(peer) = &mut link.peer {
            peer.order.stands_by();
            peer.elected = Some(elected);
            if let Some(max_age) = max_age {
                peer.age = Age::new(max_age, side == Side::Client, now);
            }
        }
        self.dials.opened(number);
        if let Some(earlier) = self.table.set_standby(daemon, number) {
            self.end_standby(earlier, "another link stands by", now);
        }
        if let Some(paths) = self.paths.all.get_mut(&daemon) {
            paths.search.handle_found(now, address);
            paths.failover.handle_standby();
            paths.choice.handle_links();
        }
        let exchange = self.exchange(number);
        if let Some(connection) = self.connections.get_mut(number) {
            connection.watch.get_or_insert_default().restart(exchange);
        }
        tracing::info!(peer = %daemon, %address, "a second link stands by");
        self.connections.touch(number);
    }

    /// Handles that a link was put in use: looks for a second path if both hosts support one.
    pub(super) fn handle_in_use(&mut self, daemon: DaemonId, number: u64, now: Duration) {
        let Some(peer) = self.table.peer(number) else { return };
        if !self.has_two_paths(&peer.summary.hello) {
            return self.forget_paths(daemon, now);
        }
        let elects = self.hello.daemon < daemon;
        let exchange = self.exchange(number);
        let paths = self.paths.all.entry(daemon).or_insert_with(|| Paths {
            search: PathSearch::new(elects, now),
            failover: Failover::default(),
            choice: PathChoice::default(),
        });
        paths.failover = Failover::new(exchange);
        paths.choice.handle_links();
        paths.search.forget_answers();
        if let Some(connection) = self.connections.get_mut(number) {
            connection.watch.get_or_insert_default().restart(exchange);
        }
        // The new link may have the path of the one that stands by.
        if let Some(standby) = self.table.standby(daemon)
            && self.has_path_in_use(standby, daemon)
        {
            self.handle_standby_ended(standby, daemon, now);
            self.end_standby(standby, "the link in use has its path", now);
        }
    }

    /// Handles the end of the link in use: the link that stands by ends with it.
    pub(super) fn forget_paths(&mut self, daemon: DaemonId, now: Duration) {
        self.paths.all.remove(&daemon);
        if let Some(standby) = self.table.take_standby(daemon) {
            self.end_standby(standby, "the link beside it ended", now);
        }
    }

    /// Handles the end of a link if it stood by: another path is looked for.
    pub(super) fn handle_standby_ended(&mut self, number: u64, daemon: DaemonId, now: Duration) {
        if self.table.standby(daemon) != Some(number) {
            return;
        }
        self.table.take_standby(daemon);
        tracing::info!(peer = %daemon, "no second link stands by any more");
        if let Some(paths) = self.paths.all.get_mut(&daemon) {
            paths.search.handle_lost(now);
        }
    }

    fn end_standby(&mut self, number: u64, why: &str, now: Duration) {
        self.close_connection(number, CloseCode::Replaced, why, now);
        if let Some(peer) = self.table.remove(number).and_then(|link| link.peer) {
            self.outbox.event(LinkEvent::Gone(number, peer.summary.hello.daemon));
        }
    }

    /// Handles the timer of a link that stands by: its keys are near their maximum age, so it ends, and another one is
    /// dialled.
    pub(super) fn standby_timeout(&mut self, number: u64, now: Duration) {
        let Some(peer) = self.table.peer_mut(number) else { return };
        let daemon = peer.summary.hello.daemon;
        let Some(AgeStep::End | AgeStep::Renew) = peer.age.handle_timeout(now) else { return };
        self.handle_standby_ended(number, daemon, now);
        self.end_standby(number, "AXON_QKD_SESSION_MAX_AGE is near", now);
    }

    fn exchange(&self, number: u64) -> Exchange {
        let connection = self.connections.get(number);
        connection.map(|c| Exchange::from(&c.quic.stats())).unwrap_or_default()
    }

    /// Records the answers of the peer of a link, whose connection had work.
    pub(super) fn note_answers(&mut self, number: u64, daemon: DaemonId, exchange: Exchange) {
        let Some(paths) = self.paths.all.get_mut(&daemon) else { return };
        let in_use = self.table.current(daemon) == Some(number);
        if !in_use && self.table.standby(daemon) != Some(number) {
            return;
        }
        if in_use {
            paths.failover.handle_exchange(exchange);
        }
        if let Some(connection) = self.connections.get_mut(number)
            && let Some(watch) = &mut connection.watch
            && watch.handle_exchange(exchange)
        {
            connection.copies.handle_answer();
        }
    }

    /// Returns when [`look_at_paths`](Self::look_at_paths) is due.
    pub(super) fn paths_timeout(&self) -> Option<Duration> {
        let all = self.paths.all.iter().filter(|_| !self.closing);
        let due = all.flat_map(|(daemon, paths)| {
            let waits = self.dials.is_dialling(*daemon);
            let search = paths.search.poll_timeout().filter(|_| !waits);
            let search = search.map(|due| due.max(self.standby_silent_at(*daemon)));
            let copies = self.table.standby(*daemon).and_then(|number| self.copies_timeout(number));
            [search, self.failover_timeout(*daemon, paths), copies].into_iter().flatten()
        });
        due.min()
    }

    fn failover_timeout(&self, daemon: DaemonId, paths: &Paths) -> Option<Duration> {
        self.table.standby(daemon)?;
        let connection = self.connections.get(self.table.current(daemon)?)?;
        let since = connection.watch.as_ref().and_then(AnswerWatch::since);
        paths.failover.poll_timeout(since, connection.quic.rtt())
    }

    /// Does the work of the paths that is due.
    pub(super) fn look_at_paths(&mut self, now: Duration) {
        if self.paths_timeout().is_none_or(|due| now < due) {
            return;
        }
        for daemon in self.paths.all.keys().copied().collect::<Vec<_>>() {
            let Some(number) = self.table.current(daemon) else { continue };
            if let Some(standby) = self.table.standby(daemon) {
                self.compare_paths(daemon, number, standby, now);
                self.look_at_copies(standby, now);
            }
            if self.standby_silent_at(daemon) <= now {
                self.probe_paths(daemon, number, now);
            }
        }
    }

    fn compare_paths(&mut self, daemon: DaemonId, number: u64, standby: u64, now: Duration) {
        let of_standby = self.exchange(standby);
        let (Some(connection), Some(paths)) =
            (self.connections.get_mut(number), self.paths.all.get_mut(&daemon))
        else {
            return;
        };
        let in_use = Exchange::from(&connection.quic.stats());
        let round_trip = connection.quic.rtt();
        let Some(watch) = &mut connection.watch else { return };
        let step =
            paths.failover.handle_timeout(now, watch.since(), in_use, of_standby, round_trip);
        match step {
            None => {}
            Some(FailoverStep::Answered) => watch.restart(in_use),
            Some(FailoverStep::Ask) => {
                if let Some(standby) = self.connections.get_mut(standby) {
                    standby.quic.ping();
                    let_probe_through(&standby.quic);
                }
                self.connections.touch(standby);
            }
            Some(FailoverStep::Switch) => {
                tracing::info!(peer = %daemon,
                    "the path does not answer and the second one does: the second link takes over");
                self.switch_over(daemon, standby, now);
            }
        }
    }

    /// Compares the two paths to each peer, once a second.
    pub(super) fn choose_paths(&mut self, now: Duration) {
        for daemon in self.paths.all.keys().copied().collect::<Vec<_>>() {
            let (Some(number), Some(standby)) =
                (self.table.current(daemon), self.table.standby(daemon))
            else {
                continue;
            };
            let quality = |number| self.connections.get(number).map(path_quality);
            let (Some(in_use), Some(second)) = (quality(number), quality(standby)) else {
                continue;
            };
            let Some(paths) = self.paths.all.get_mut(&daemon) else { continue };
            if paths.choice.handle_second(now, in_use, second) {
                let (before, after) = (in_use.round_trip, second.round_trip);
                tracing::info!(peer = %daemon, ?before, ?after,
                    "the second path is better: the second link takes over");
                self.switch_over(daemon, standby, now);
            }
        }
    }

    fn probe_paths(&mut self, daemon: DaemonId, number: u64, now: Duration) {
        let Some(in_use) = self.connections.address(number) else { return };
        // A dial of discovery, or of a successor, is more important.
        if self.dials.is_dialling(daemon) {
            return;
        }
        let Some(paths) = self.paths.all.get_mut(&daemon) else { return };
        let round = paths.search.handle_timeout(now, in_use, || self.random.random());
        for (to, nonce) in round.probes {
            let probe = Datagram::Probe { daemon: self.hello.daemon, nonce };
            self.connections.endpoints().send(to, probe.encode());
        }
        if let Some(address) = round.dial {
            self.dial_standby(daemon, address, now);
        }
    }

    /// Returns whether answers to probes of other paths are expected.
    pub(super) fn probes_paths(&self) -> bool {
        !self.paths.all.is_empty()
    }

    /// Handles an answer to a probe, which came to the address `local` of this host. Returns whether it was one of
    /// another path.
    pub(super) fn handle_path_echo(
        &mut self,
        now: Duration,
        (from, local): (SocketAddr, Option<IpAddr>),
        daemon: DaemonId,
        nonce: Nonce,
    ) -> bool {
        let awaits = |paths: &Paths| paths.search.awaits(nonce);
        if !self.paths.all.get(&daemon).is_some_and(awaits) {
            return false;
        }
        let has_standby = self.standby_silent_at(daemon) > now;
        let later = self.dials.is_dialling(daemon);
        let in_use = self.table.current(daemon).and_then(|number| self.connections.get(number));
        let is_apart = is_apart(in_use.and_then(Connection::local), local);
        if let Some(paths) = self.paths.all.get_mut(&daemon)
            && !has_standby
            && let Some(address) = paths.search.handle_echo(now, from, nonce, is_apart, later)
        {
            self.dial_standby(daemon, address, now);
        }
        true
    }

    /// Dials a link that is to stand by.
    fn dial_standby(&mut self, daemon: DaemonId, address: SocketAddr, now: Duration) {
        let Some(peer) = self.table.current_peer(daemon) else { return };
        let target = DialTarget {
            daemon: Some(daemon),
            sae: peer.summary.hello.sae.clone(),
            addresses: vec![address],
            listed: false,
            standing: None,
            replaces: None,
            beside: peer.elected.map(|elected| elected.link),
        };
        tracing::debug!(peer = %daemon, %address, "dialling a link over a second path");
        self.dial(target, now);
    }

    /// Sets the addresses at which discovery knows a linked peer, best first.
    pub(in crate::engine) fn set_addresses(
        &mut self,
        now: Duration,
        daemon: DaemonId,
        addresses: &[SocketAddr],
    ) {
        if let Some(paths) = self.paths.all.get_mut(&daemon) {
            paths.search.set_addresses(now, addresses);
        }
    }

    /// Returns the status of the link that stands by for a peer, unless it is silent.
    pub(in crate::engine) fn standby_status(
        &self,
        daemon: DaemonId,
        now: Duration,
    ) -> Option<StandbyStatus> {
        let standby =
            self.table.standby(daemon).filter(|_| self.standby_silent_at(daemon) > now)?;
        let connection = self.connections.get(standby)?;
        let mut status = StandbyStatus::default();
        status.address = connection.quic.remote_address().to_string();
        status.rtt = connection.quic.rtt();
        status.copies_out = connection.copies.sent();
        Some(status)
    }
}

/// Returns what QUIC measured of the path of a connection.
fn path_quality(connection: &Connection) -> PathQuality {
    let path = connection.quic.stats().path;
    let round_trip = connection.quic.min_rtt();
    PathQuality { round_trip, sent: path.sent_packets, lost: path.lost_packets }
}

/// Returns whether two local addresses are probably of different interfaces. An interface often has an address of either
/// family.
fn is_apart(one: Option<IpAddr>, other: Option<IpAddr>) -> bool {
    let canonical = |address: Option<IpAddr>| address.map(|address| address.to_canonical());
    match (canonical(one), canonical(other)) {
        (Some(one), Some(other)) => one != other && one.is_ipv4() == other.is_ipv4(),
        _ => false,
    }
}
