//! The beginnings of links: a connection is dialled or accepted, its handshake ends, HELLO follows.

use std::{net::SocketAddr, sync::Arc, time::Duration};

use axon_tls::quic::from_handshake_data;
use quinn_proto::{Dir, Incoming};

use super::{
    LinkReport, Links,
    dials::LinkDial,
    handshake_failure::explained,
    link::{Link, LinkPhase},
};
use crate::{
    bridge::RefusalKind,
    engine::{
        link::{
            dialling::DialAction,
            failure::peer_text,
            opening::{Handshake, Opening, RefusedConnection},
            target::DialTarget,
        },
        refusal::{Refusal, RefusedBy},
    },
    keys::{self, Exporters},
    link::{CloseCode, LinkHello, Side},
};

/// Time that a dialler with its Retry has for the rest of the handshake.
const HANDSHAKE_TIMEOUT: Duration = Duration::from_secs(10);

impl Links {
    /// Begins to dial a peer.
    pub(in crate::engine) fn dial(&mut self, target: DialTarget, now: Duration) {
        if self.closing {
            return;
        }
        self.dials.begin(target, self.keyring.as_ref(), now);
    }

    /// Accepts a connection, refuses it, or makes its dialler prove its address.
    pub(super) fn accept(&mut self, endpoint: usize, incoming: Incoming, now: Duration) {
        if self.closing {
            return self.connections.endpoints().refuse(endpoint, incoming);
        }
        if !incoming.remote_address_validated() {
            return self.connections.endpoints().retry(endpoint, incoming);
        }
        let source = incoming.remote_address();
        let Some(place) = self.admission.enter(source.ip()) else {
            self.connections.endpoints().refuse(endpoint, incoming);
            if self.admission.is_new(source.ip(), now) {
                let text = "hosts at this address have as many handshakes under way as they may";
                let refusal = Refusal::here(CloseCode::NotAllowed, text);
                let kind = self.unauthenticated(source.ip());
                self.outbox.report(LinkReport::Refused(kind, peer_text(None, source), refusal));
            }
            return;
        };
        let resolver = self.keyring.as_ref().map(|keys| keys.resolver(now, source.ip()));
        let mut server = match self.credentials.server(resolver.clone(), source.ip()) {
            Ok(server) => server,
            Err(error) => {
                self.connections.endpoints().refuse(endpoint, incoming);
                let refusal = Refusal::here(CloseCode::Internal, error);
                let kind = self.unauthenticated(source.ip());
                let report = LinkReport::Refused(kind, peer_text(None, source), refusal);
                return self.outbox.report(report);
            }
        };
        if let Some(logged) = self.logged(Side::Server, source, now) {
            server.transport_config(logged);
        }
        let instant = self.instant(now);
        match self.connections.accept(endpoint, incoming, Arc::new(server), instant) {
            Ok(number) => {
                let mut link = Link::new(Side::Server, now + HANDSHAKE_TIMEOUT, None);
                (link.place, link.resolver) = (Some(place), resolver);
                self.table.insert(number, link);
            }
            Err(error) => {
                if let Some(refusal) = explained(&error, resolver.as_deref(), source) {
                    let kind = self.unauthenticated(source.ip());
                    self.refused_incoming(kind, source, resolver.as_deref(), refusal);
                }
            }
        }
    }

    /// Reports an incoming handshake that failed.
    pub(super) fn refused_incoming(
        &mut self,
        kind: RefusalKind,
        source: SocketAddr,
        resolver: Option<&keys::Resolver>,
        refusal: Refusal,
    ) {
        let claimed = resolver.and_then(keys::Resolver::identity);
        let peer = peer_text(claimed.as_ref().map(|i| i.client_sae()), source);
        self.outbox.report(LinkReport::Refused(kind, peer, refusal));
    }

    /// Handles that the TLS handshake of a connection is complete.
    pub(super) fn handle_connected(&mut self, now: Duration, number: u64) {
        let Some(link) = self.table.get_mut(number) else { return };
        let LinkPhase::Handshake(_, dial) = link.phase else { return };
        match dial {
            Some(dial) => self.dials.handle_connected(dial),
            None => {
                let ours = self.hello.clone();
                self.begin_opening(number, ours, None, now);
            }
        }
    }

    /// Begins HELLO on a connection whose handshake is complete.
    fn begin_opening(
        &mut self,
        number: u64,
        mut ours: LinkHello,
        dialled: Option<String>,
        now: Duration,
    ) {
        let (Some(connection), Some(link)) =
            (self.connections.get_mut(number), self.table.get_mut(number))
        else {
            return;
        };
        let key = self.daemon_key.as_ref();
        ours.proof = key.and_then(|key| key.prove(&connection.binding()?));
        let session = connection.quic.crypto_session();
        let exporters = Exporters::derive(|out, label| {
            session.export_keying_material(out, label, b"").map_err(|_| ())
        });
        let handshake = Handshake {
            connection: number,
            side: link.side,
            remote: connection.quic.remote_address(),
            negotiated: session.handshake_data().and_then(from_handshake_data),
            exporters: exporters.ok(),
            chain: connection.peer_chain(),
            dialled,
        };
        if link.side == Side::Client
            && let Some(stream) = connection.quic.streams().open(Dir::Bi)
        {
            connection.control.open(stream, &mut connection.quic);
        }
        let closed = self.credentials.closed();
        let opening =
            Opening::new(now, handshake, ours, &self.config, closed, self.keyring.as_mut());
        link.phase = LinkPhase::Opening(Box::new(opening));
        self.go_on_opening(number, now);
        self.connections.touch(number);
    }

    /// Passes on the messages of an opening, and handles its outcome.
    pub(super) fn go_on_opening(&mut self, number: u64, now: Duration) {
        let (Some(connection), Some(link)) =
            (self.connections.get_mut(number), self.table.get_mut(number))
        else {
            return;
        };
        let LinkPhase::Opening(opening) = &mut link.phase else { return };
        let outcome = opening.poll_outcome(now, self.keyring.as_mut());
        while let Some(message) = opening.poll_message() {
            // HELLO and proofs always fit.
            let _ = connection.control.send(&message);
        }
        connection.control.set_limits(opening.limits());
        self.connections.touch(number);
        match outcome {
            Some(Ok(opened)) => self.established(number, opened, now),
            Some(Err(refused)) => self.opening_refused(number, refused, now),
            None => {}
        }
    }

    fn opening_refused(&mut self, number: u64, refused: RefusedConnection, now: Duration) {
        let Some(link) = self.table.remove(number) else { return };
        let RefusedConnection { refusal, close } = refused;
        let address = self.connections.address(number);
        if let Some((code, told)) = close {
            self.close_connection(number, code, &told, now);
        }
        let Some(address) = address else { return };
        let kind = self.authenticated(address.ip());
        match link.side {
            Side::Server => self.refused_incoming(kind, address, link.resolver.as_deref(), refusal),
            Side::Client => {
                // TLS authenticated the peer. It closes so if HELLO expected another daemon, or if it ends.
                let is_gone =
                    refusal.by == RefusedBy::Peer && refusal.name == CloseCode::Goodbye.name();
                self.outbox.report(LinkReport::Refused(kind, peer_text(None, address), refusal));
                self.opening_failed(number, is_gone.then_some(address));
            }
        }
    }

    /// Continues the dials that have work.
    pub(super) fn go_on_dialling(&mut self, now: Duration) {
        for dial in self.dials.take_stirred() {
            while let Some(action) = self.dials.poll_action(dial, now, self.keyring.as_mut()) {
                self.act(dial, action, now);
            }
        }
    }

    fn act(&mut self, dial: u64, action: DialAction, now: Duration) {
        let instant = self.instant(now);
        let logged = match action {
            DialAction::Connect { address, .. } => self.logged(Side::Client, address, now),
            _ => None,
        };
        let Some(LinkDial { dialling, connection }) = self.dials.get_mut(dial) else { return };
        match action {
            DialAction::Connect { address, attempt } => {
                let mut client = match self.credentials.client(attempt.as_deref(), address.ip()) {
                    Ok(client) => client,
                    Err(error) => return dialling.handle_unusable(error),
                };
                if let Some(logged) = logged {
                    client.transport_config(logged);
                }
                match self.connections.connect(address, client, instant) {
                    Ok(number) => {
                        *connection = Some(number);
                        let mut link = Link::new(Side::Client, Duration::MAX, Some(dial));
                        let DialTarget { daemon, replaces, beside, .. } = *dialling.target();
                        (link.expected, link.replaces, link.beside) = (daemon, replaces, beside);
                        self.table.insert(number, link);
                    }
                    Err(error) => dialling.handle_unreachable(error.as_ref()),
                }
            }
            DialAction::Close { code, reason } => {
                if let Some(number) = connection.take() {
                    self.table.remove(number);
                    self.close_connection(number, code, reason, now);
                }
            }
            DialAction::Open => {
                let Some(LinkDial { dialling, connection: Some(number) }) = self.dials.remove(dial)
                else {
                    return;
                };
                let target = dialling.target();
                if let (Some(daemon), Some(standing), Some(_)) =
                    (target.daemon, target.standing, target.replaces)
                    && self.cut_link(daemon) != target.replaces
                {
                    let why = "the link that it was to succeed works again, or has a successor";
                    self.table.remove(number);
                    self.close_connection(number, CloseCode::Duplicate, why, now);
                    return self.outbox.report(LinkReport::DialFailed {
                        daemon,
                        standing,
                        absent_at: None,
                    });
                }
                let current = target.daemon.and_then(|daemon| self.table.current_peer(daemon));
                let in_use = current.and_then(|peer| Some(peer.elected?.link));
                if target.beside.is_some() && target.beside != in_use {
                    let why = "the link beside which it was to stand by is not in use any more";
                    self.table.remove(number);
                    return self.close_connection(number, CloseCode::Duplicate, why, now);
                }
                let hello = target.hello(&self.hello);
                let sae = target.sae.clone();
                self.dials.note_opening(number, target.daemon.zip(target.standing));
                self.begin_opening(number, hello, sae, now);
                if !self.table.contains(number) {
                    self.opening_failed(number, None);
                }
            }
            DialAction::Failed(refusal) => {
                let Some(LinkDial { dialling, .. }) = self.dials.remove(dial) else { return };
                let target = dialling.target();
                // A successor is dialled at the address of a linked peer, unless discovery suggested the address.
                let kind = match target.replaces {
                    _ if target.listed => RefusalKind::Listed,
                    Some(_) if target.standing.is_none() && self.credentials.authenticates() => {
                        RefusalKind::Peer
                    }
                    _ => RefusalKind::Unproven,
                };
                self.outbox.report(LinkReport::Refused(kind, target.text(), refusal));
                if let (Some(daemon), Some(standing)) = (target.daemon, target.standing) {
                    self.outbox.report(LinkReport::DialFailed {
                        daemon,
                        standing,
                        absent_at: None,
                    });
                }
            }
        }
    }
}
