//! Links that do not answer: their path is probed, and a successor is dialled once it works.

mod prober;
mod schedule;
mod watch;

use std::{
    net::{IpAddr, SocketAddr},
    time::Duration,
};

use bytes::BytesMut;
use rand::RngExt;

use self::watch::ProbeAction;
pub(super) use self::{
    prober::{Traffic, frames_came},
    schedule::CheckSchedule,
    watch::{LinkSilence, Nonce},
};
use crate::{
    engine::links::{LinkEvent, LinkReport, Links},
    wire::beacon::Datagram,
};

/// Maximum length of a discovery message.
const MAX_DISCOVERY: usize = 512;

impl Links {
    /// Handles a discovery datagram, or the echo of a probe.
    pub(super) fn handle_discovery(
        &mut self,
        now: Duration,
        from: SocketAddr,
        local: Option<IpAddr>,
        bytes: BytesMut,
    ) {
        if bytes.len() > MAX_DISCOVERY {
            return;
        }
        let echo = match !self.nonces.is_empty() || self.probes_paths() {
            true => Datagram::decode(&bytes).ok(),
            false => None,
        };
        if let Some(Datagram::Echo { nonce, daemon }) = echo
            && self.handle_path_echo(now, (from, local), daemon, nonce)
        {
            return;
        }
        if let Some(Datagram::Echo { nonce, daemon }) = echo
            && let Some(number) = self.nonces.get(&nonce).copied()
        {
            // An answer of another daemon at the address does not show the path to this one.
            if let Some(peer) = self.table.peer_mut(number)
                && peer.summary.hello.daemon == daemon
            {
                self.nonces.remove(&nonce);
                if peer.silence.handle_echo(now) {
                    self.outbox.report(LinkReport::Path { daemon, works: true });
                }
            }
            return;
        }
        let Self { admission, connections, inbox, .. } = self;
        let known = || admission.is_listed(from.ip()) || connections.has(from.ip());
        inbox.add(from, &bytes, known, now);
    }

    /// Records the traffic of a link when a datagram came.
    pub(super) fn note_heard(&mut self, number: u64, now: Duration) {
        let (Some(connection), Some(peer)) =
            (self.connections.get(number), self.table.peer_mut(number))
        else {
            return;
        };
        let traffic = Traffic::from(&connection.quic.stats());
        let daemon = peer.summary.hello.daemon;
        if peer.silence.handle_heard(now, traffic) {
            self.outbox.event(LinkEvent::Back(daemon));
        }
        self.note_answers(number, daemon, traffic.exchange());
    }

    /// Probes the path of links over which something was sent and nothing arrived in the last second. Peers from which
    /// nothing came for long count as gone from now on.
    pub(super) fn look_for_silence(&mut self, now: Duration) {
        for number in self.table.open() {
            let (Some(connection), Some(peer)) =
                (self.connections.get(number), self.table.peer_mut(number))
            else {
                continue;
            };
            let (traffic, daemon) =
                (Traffic::from(&connection.quic.stats()), peer.summary.hello.daemon);
            let look = peer.silence.handle_second(now, traffic, || self.random.random());
            if look.gone {
                self.outbox.event(LinkEvent::Silent(daemon));
            }
            if look.probed {
                tracing::debug!(peer = %daemon, "the link does not answer: probing its path");
                self.probe(number, now);
            }
        }
        self.look_for_silent_leaving();
    }

    fn send_probe(&mut self, number: u64, to: SocketAddr, nonce: Nonce) {
        self.nonces.insert(nonce, number);
        let probe = Datagram::Probe { daemon: self.hello.daemon, nonce };
        self.connections.endpoints().send(to, probe.encode());
    }

    /// Continues the probes of a silent link.
    pub(super) fn probe(&mut self, number: u64, now: Duration) {
        let (Some(connection), Some(peer)) =
            (self.connections.get(number), self.table.peer_mut(number))
        else {
            return;
        };
        let (address, daemon) = (connection.quic.remote_address(), peer.summary.hello.daemon);
        let (traffic, round_trip) =
            (Traffic::from(&connection.quic.stats()), connection.quic.rtt());
        match peer.silence.handle_timeout(now, traffic, round_trip) {
            Some(ProbeAction::Answered(nonce, was_cut)) => {
                self.nonces.remove(&nonce);
                if was_cut {
                    self.outbox.report(LinkReport::Path { daemon, works: true });
                }
            }
            Some(ProbeAction::Probe(nonce)) => self.send_probe(number, address, nonce),
            Some(ProbeAction::ProbeCut(nonce)) => {
                self.send_probe(number, address, nonce);
                self.outbox.report(LinkReport::Path { daemon, works: false });
            }
            Some(ProbeAction::Replace) => {
                tracing::info!(peer = %daemon, %address,
                    "the link is silent though its path works: dialling a successor");
                self.dial_successor(number, now);
            }
            None => {}
        }
    }
}
