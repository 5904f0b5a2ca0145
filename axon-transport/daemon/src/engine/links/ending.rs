//! The ends of links: lost connections, protocol violations, and the shutdown of the daemon.

use std::{
    net::{IpAddr, SocketAddr},
    time::Duration,
};

use quinn_proto::ConnectionError;

use super::{LinkEvent, LinkReport, Links, handshake_failure::explained, link::LinkPhase};
use crate::{
    bridge::RefusalKind,
    engine::refusal::{Refusal, RefusedBy},
    link::CloseCode,
};

impl Links {
    /// Ends the links whose connection was lost. Returns whether there were any.
    pub(in crate::engine) fn end_lost(&mut self, now: Duration) -> bool {
        let mut any = false;
        while let Some((number, reason)) = self.unfinished.poll_lost() {
            any = true;
            self.handle_lost(now, number, &reason);
            self.connections.touch(number);
        }
        any
    }

    /// Handles the loss of a connection.
    pub(super) fn handle_lost(&mut self, now: Duration, number: u64, reason: &ConnectionError) {
        let Some(link) = self.table.get_mut(number) else { return };
        match &mut link.phase {
            LinkPhase::Handshake(_, Some(dial)) => {
                self.dials.handle_failed(*dial, reason);
                self.table.remove(number);
            }
            LinkPhase::Handshake(_, None) => {
                let link = self.table.remove(number);
                let resolver = link.and_then(|link| link.resolver);
                let address = self.connections.address(number);
                if let Some(address) = address
                    && let Some(refusal) = explained(reason, resolver.as_deref(), address)
                {
                    let kind = self.unauthenticated(address.ip());
                    self.refused_incoming(kind, address, resolver.as_deref(), refusal);
                }
            }
            LinkPhase::Opening(opening) => {
                opening.handle_lost(now, reason, self.keyring.as_mut());
                self.go_on_opening(number, now);
            }
            LinkPhase::Electing(_)
            | LinkPhase::Standby
            | LinkPhase::Open
            | LinkPhase::Leaving(_) => {
                let refusal = Refusal::of(reason);
                let text = refusal.to_string();
                // A stateless reset means that another daemon has the peer's port.
                let restarted = matches!(reason, ConnectionError::Reset);
                self.end_link_of(number, &text, Some(refusal), restarted, now);
            }
        }
    }

    /// Returns how far the peer of a link is known.
    pub(in crate::engine) fn kind(&self, number: u64) -> RefusalKind {
        let address = self.connections.address(number);
        address.map_or(RefusalKind::Unproven, |address| self.authenticated(address.ip()))
    }

    /// Returns how far a peer at this address is known after its handshake is complete.
    pub(super) fn authenticated(&self, address: IpAddr) -> RefusalKind {
        let proves = self.credentials.authenticates();
        if proves { RefusalKind::Peer } else { self.unauthenticated(address) }
    }

    /// Returns how far a host at this address is known before it proves anything.
    pub(super) fn unauthenticated(&self, address: IpAddr) -> RefusalKind {
        let listed = self.admission.is_listed(address);
        if listed { RefusalKind::Listed } else { RefusalKind::Unproven }
    }

    /// Ends a link because its host has another one.
    pub(in crate::engine) fn replace(&mut self, number: u64, why: &str, now: Duration) {
        self.close_connection(number, CloseCode::Replaced, why, now);
        self.end_link_of(number, why, None, true, now);
    }

    /// Ends a link whose peer violated the protocol.
    pub(in crate::engine) fn violation(
        &mut self,
        number: u64,
        code: CloseCode,
        why: &str,
        now: Duration,
    ) {
        self.violation_told(number, code, why, why, now);
    }

    /// Ends a link as [`violation`](Self::violation) does, with another text for the peer.
    pub(in crate::engine) fn violation_told(
        &mut self,
        number: u64,
        code: CloseCode,
        why: &str,
        told: &str,
        now: Duration,
    ) {
        if self.table.contains(number) {
            let peer = self.peer_text(number);
            let kind = self.kind(number);
            self.outbox.report(LinkReport::Refused(kind, peer, Refusal::here(code, why)));
            self.close_connection(number, code, told, now);
        }
        self.end_link(number, why, None, now);
    }

    /// Reports a dialled connection whose opening failed. `absent_at`: the peer at this address is another daemon than
    /// the dialled one.
    pub(super) fn opening_failed(&mut self, number: u64, absent_at: Option<SocketAddr>) {
        if let Some(report) = self.dials.opening_failed(number, absent_at) {
            self.outbox.report(report);
        }
    }

    /// Closes a connection. Its last packets leave in this pass.
    pub(super) fn close_connection(
        &mut self,
        number: u64,
        code: CloseCode,
        reason: &str,
        now: Duration,
    ) {
        let instant = self.instant(now);
        if let Some(keyring) = &mut self.keyring {
            keyring.forget_connection(now, number);
        }
        self.opening_failed(number, None);
        self.connections.close(number, code, reason, instant);
    }

    /// Ends a link.
    pub(super) fn end_link(
        &mut self,
        number: u64,
        reason: &str,
        refusal: Option<Refusal>,
        now: Duration,
    ) {
        self.end_link_of(number, reason, refusal, false, now);
    }

    /// Ends a link. `restarted`: another daemon of the peer's host replaces its daemon.
    fn end_link_of(
        &mut self,
        number: u64,
        reason: &str,
        refusal: Option<Refusal>,
        restarted: bool,
        now: Duration,
    ) {
        let Some(link) = self.table.get(number) else { return };
        let (peer, kind) = (self.peer_text(number), self.kind(number));
        let daemon = link.peer.as_ref().map(|peer| peer.summary.hello.daemon);
        self.table.remove(number);
        self.close_connection(number, CloseCode::Goodbye, "the control stream ended", now);
        self.nonces.retain(|_, link| *link != number);
        let Some(daemon) = daemon else { return };
        if !self.table.let_go(daemon, number) {
            self.handle_standby_ended(number, daemon, now);
            return self.outbox.event(LinkEvent::Gone(number, daemon));
        }
        self.abandon_leaving(daemon, now);
        self.forget_paths(daemon, now);
        tracing::info!(peer = %daemon, reason, "link down");
        if let Some(refusal) = refusal.filter(|refusal| refusal.by == RefusedBy::Peer)
            && !["GOODBYE", "DUPLICATE", "REPLACED"].contains(&refusal.name.as_str())
        {
            self.outbox.report(LinkReport::Refused(kind, peer.clone(), refusal));
        }
        let reason = reason.to_owned();
        self.outbox.event(LinkEvent::Down { number, daemon, peer, reason, restarted });
    }

    /// Returns whether all connections have ended.
    pub(in crate::engine) fn is_idle(&self) -> bool {
        self.connections.is_empty()
    }

    /// Closes all links, because this host's daemon shuts down.
    pub(in crate::engine) fn close_all(&mut self, now: Duration) {
        self.closing = true;
        self.dials.clear();
        for number in self.connections.numbers() {
            self.close_connection(number, CloseCode::Goodbye, "the daemon ends", now);
        }
    }
}
