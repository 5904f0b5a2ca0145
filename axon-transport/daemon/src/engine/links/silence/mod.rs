//! Links that do not answer: their path is probed, and a successor is dialled once it works.

mod prober;

use std::{net::SocketAddr, time::Duration};

use bytes::BytesMut;

use self::prober::Step;
pub(super) use self::prober::{Prober, Traffic, frames_came};
use crate::{
    engine::links::{LinkEvent, Links, link::Probing},
    wire::beacon::Datagram,
};

/// A link over which nothing came for so long is probed, even if nothing was asked: two of QUIC's keep-alives are lost.
const UNHEARD: Duration = Duration::from_secs(10);
/// A peer that is silent for so long is taken for gone. Its link stands until QUIC gives it up.
const GONE: Duration = Duration::from_secs(20);
/// No message of discovery is longer.
const MAX_DISCOVERY: usize = 512;

impl Links {
    /// A datagram of discovery, or the echo of a probe.
    pub(super) fn handle_discovery(&mut self, from: SocketAddr, bytes: BytesMut, now: Duration) {
        if bytes.len() > MAX_DISCOVERY {
            return;
        }
        if !self.nonces.is_empty()
            && let Ok(Datagram::Echo { nonce, .. }) = Datagram::decode(&bytes)
            && let Some(number) = self.nonces.remove(&nonce)
        {
            let peer = self.table.peer_mut(number);
            if let Some(probing) = peer.and_then(|peer| peer.silence.probing.as_mut())
                && probing.prober.awaits_echo()
            {
                probing.prober.handle_echo(now.saturating_sub(probing.begun));
            }
            return;
        }
        let Self { admission, connections, inbox, .. } = self;
        let known = || admission.is_listed(from.ip()) || connections.has(from.ip());
        inbox.add(from, &bytes, known, now);
    }

    /// Notes what had gone over a link when a datagram came. What is sent later has no answer yet. QUIC does not always
    /// send it again: its probes may ask for an acknowledgement alone.
    pub(super) fn note_heard(&mut self, number: u64, now: Duration) {
        let (Some(connection), Some(peer)) =
            (self.connections.get(number), self.table.peer_mut(number))
        else {
            return;
        };
        let traffic = Traffic::from(&connection.quic.stats());
        if !traffic.has_come_since(peer.silence.heard) {
            return;
        }
        (peer.silence.heard, peer.silence.heard_at) = (traffic, now);
        // What comes over a path that works one way alone brings no peer back.
        if peer.silence.gone.take_if(|gone| traffic.answered_since(*gone)).is_some() {
            self.outbox.event(LinkEvent::Back(peer.summary.hello.daemon));
        }
    }

    /// Probes the path of links over which something went out, and nothing came in the last second. Takes peers for gone
    /// of which nothing came for long.
    pub(super) fn look_for_silence(&mut self, now: Duration) {
        for number in self.table.open() {
            let Some(connection) = self.connections.get(number) else { continue };
            let traffic = Traffic::from(&connection.quic.stats());
            let Some(link) = self.table.get_mut(number) else { continue };
            let side = link.side;
            let Some(peer) = &mut link.peer else { continue };
            let before = std::mem::replace(&mut peer.silence.traffic, traffic);
            // It is no longer silent: what is under way arrives.
            peer.silence.silent &= !traffic.answered_since(before);
            let unheard = now.saturating_sub(peer.silence.heard_at);
            if unheard >= GONE && peer.silence.gone.is_none() {
                peer.silence.gone = Some(traffic);
                self.outbox.event(LinkEvent::Silent(peer.summary.hello.daemon));
            }
            let silent = traffic.is_silent(before, peer.silence.heard) || unheard >= UNHEARD;
            if peer.silence.probing.is_some() || !silent {
                continue;
            }
            tracing::debug!(peer = %peer.summary.hello.daemon,
                "the link does not answer: probing its path");
            peer.silence.probing = Some(Probing {
                prober: Prober::new(side),
                nonce: rand::random(),
                begun: now,
                traffic,
            });
            self.probe(number, now);
        }
    }

    /// Goes on with the probes of a silent link.
    pub(super) fn probe(&mut self, number: u64, now: Duration) {
        let (Some(connection), Some(peer)) =
            (self.connections.get(number), self.table.peer_mut(number))
        else {
            return;
        };
        let (address, daemon) = (connection.quic.remote_address(), peer.summary.hello.daemon);
        let traffic = Traffic::from(&connection.quic.stats());
        let Some(probing) = &mut peer.silence.probing else { return };
        if traffic.answered_since(probing.traffic) {
            self.nonces.remove(&probing.nonce);
            peer.silence.probing = None;
            return;
        }
        match probing.prober.handle_timeout(now.saturating_sub(probing.begun)) {
            Some(Step::Probe) => {
                self.nonces.insert(probing.nonce, number);
                let probe = Datagram::Probe { daemon: self.hello.daemon, nonce: probing.nonce };
                self.connections.endpoints().send(address, probe.encode());
            }
            Some(Step::Replace) => {
                peer.silence.silent = true;
                tracing::info!(peer = %daemon, %address,
                    "the link is silent though its path works: dialling a successor");
                self.dial_successor(number, now);
            }
            None => {}
        }
    }
}
