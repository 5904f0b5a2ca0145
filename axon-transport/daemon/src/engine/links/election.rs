//! Decides which of several connections with a peer becomes its link, and when a link is renewed.

use std::{net::IpAddr, time::Duration};

use axon_shm::ids::DaemonId;
use quinn_proto::{Dir, StreamEvent, VarInt};
use rand::RngExt;

use super::identity::{OTHERS, PeerIdentity};
use super::{
    LinkEvent, LinkReport, Links,
    link::{
        LinkPeer, LinkPhase,
        age::{Age, AgeStep},
        take_over::TakeOver,
    },
    silence::{LinkSilence, Traffic},
};
use crate::{
    daemon_key::DaemonProof,
    engine::{
        account::MESSAGES,
        link::{
            failure::peer_text,
            opening::{OpenedConnection, Sealing},
            target::DialTarget,
        },
        links::link::EstablishedPeer,
        quic::transport::{LINK_WINDOW, STREAMS_OPEN, window_credit},
        refusal::Refusal,
    },
    link::{Candidate, CloseCode, Elected, LinkHello, LinkMessage, ReceiveLimits, Side, new_wins},
};

/// The peer elects one of its connections within this time.
const ELECTION_TIMEOUT: Duration = Duration::from_secs(10);
/// Maximum number of links at a time.
const MAX_LINKS: usize = 128 + 32;
/// Maximum number of links of one proven identity.
const MAX_LINKS_OF_PEER: usize = 16;

impl Links {
    /// Handles that a connection's peer sent HELLO and proved its name.
    pub(super) fn established(&mut self, number: u64, opened: OpenedConnection, now: Duration) {
        let (Some(connection), Some(link)) = (self.connections.get(number), self.table.get(number))
        else {
            return;
        };
        let OpenedConnection { hello, negotiated, order, sealing } = opened;
        let (side, address) = (link.side, connection.quic.remote_address());
        let (replaces, beside) = match side {
            Side::Server => (hello.replaces, hello.beside),
            Side::Client => (link.replaces, link.beside),
        };
        let (daemon, ours) = (hello.daemon, self.hello.daemon);
        // The other end compares, too. A peer that does not report a difference must not count as found.
        if let Some(expected) = link.expected.filter(|expected| *expected != daemon) {
            let why = format!("daemon id is {daemon} there, and {expected} was dialled");
            self.opening_failed(number, Some(address));
            return self.turn_away(number, &hello, why, now);
        }
        let chain = connection.peer_chain();
        if let Some(why) = self.credentials.distrust(&negotiated, side, Some(&chain), (self.wall)())
        {
            return self.turn_away(number, &hello, why, now);
        }
        let auth = self.credentials.auth();
        // The pins may have changed since they were checked.
        let who = match PeerIdentity::of(
            self.keyring.is_some(),
            auth.as_ref(),
            &hello,
            negotiated.peer,
        ) {
            Ok(who) => who,
            Err(why) => return self.turn_away(number, &hello, why, now),
        };
        let binding = connection.binding();
        let proves = |proof: &DaemonProof| binding.is_some_and(|b| proof.proves(daemon, &b));
        if hello.proof.as_ref().is_some_and(|proof| !proves(proof)) {
            let why = format!("{who} says a proof of daemon id {daemon} that is none");
            return self.turn_away_told(number, &hello, why, OTHERS, now);
        }
        let proven = hello.proof.is_some();
        if let Err(why) = self.claim(daemon, &who, proven, now) {
            return self.turn_away_told(number, &hello, why, OTHERS, now);
        }
        let current = self.table.current_peer(daemon);
        let of_identity = self.table.of_identity(&who);
        let links = self.table.in_use_count();
        let is_new = current.is_none();
        let too_many = if of_identity >= MAX_LINKS_OF_PEER {
            Some("this peer has as many connections as it may")
        } else if is_new && links >= MAX_LINKS && !self.make_place(address.ip(), now) {
            Some("this daemon has as many links as it may, and no address has more than this one")
        } else {
            None
        };
        if let Some(text) = too_many {
            if self.admission.is_new(address.ip(), now) {
                return self.turn_away(number, &hello, text.into(), now);
            }
            self.table.remove(number);
            return self.close_connection(number, CloseCode::NotAllowed, text, now);
        }
        let current = self.table.current_peer(daemon);
        let replaced = replaces.is_some()
            && current.is_some_and(|current| current.elected.map(|e| e.link) == replaces);
        // The peer may have given up the link that is silent here.
        let successor = replaced || current.is_some_and(|peer| peer.silence.is_gone());
        let candidate = Candidate { side, successor };
        let we_elect = ours < daemon;
        let loses = |current: &LinkPeer| !new_wins(ours, daemon, current.candidate, candidate);
        let loses = current.is_some_and(loses);
        let stands_by = we_elect && self.may_stand_by(number, &hello, beside, now);
        // A connection that was to stand by beside an earlier link does not become the link in use.
        if we_elect && !stands_by && (beside.is_some() || loses) {
            self.table.remove(number);
            // The dial did not fail: the peer is linked.
            self.dials.opened(number);
            self.close_connection(number, CloseCode::Duplicate, "another connection stands", now);
            if side == Side::Client && beside.is_none() {
                self.outbox.report(LinkReport::Up { daemon, address, proven });
            }
            return;
        }
        let account = self.accounts.of(&who.host_identity(address), &who.budget(address));
        let Some(connection) = self.connections.get_mut(number) else { return };
        connection.control.charge_to(&account);
        let Some(link) = self.table.get_mut(number) else { return };
        (link.place, link.beside) = (None, beside);
        link.phase = LinkPhase::Electing(now + ELECTION_TIMEOUT);
        link.peer = Some(LinkPeer {
            summary: EstablishedPeer { hello, negotiated, who },
            proven,
            order,
            candidate,
            seals: sealing.is_some(),
            sealing,
            elected: None,
            age: Age::default(),
            since: (self.wall)(),
            unread: account.unread.nothing(),
            account,
            chain,
            silence: LinkSilence::new(side, now),
        });
        if stands_by {
            self.elect_standby(number, now);
        } else if we_elect && side == Side::Server {
            self.handle_take_over(number, TakeOver::Dialled, now);
        } else if we_elect {
            self.elect(number, now);
        }
        self.connections.touch(number);
    }

    /// Elects a connection that the peer dialled and that waited, unless another connection stands now.
    pub(super) fn elect_dialled(&mut self, number: u64, now: Duration) {
        let Some(peer) = self.table.peer(number) else { return };
        let daemon = peer.summary.hello.daemon;
        let stands = self.table.current_peer(daemon).is_some_and(|current| {
            !new_wins(self.hello.daemon, daemon, current.candidate, peer.candidate)
        });
        if stands {
            self.close_connection(number, CloseCode::Duplicate, "another connection stands", now);
            return self.end_link(number, "another connection stands", None, now);
        }
        self.elect(number, now);
    }

    /// Elects a connection: it becomes the link in use.
    fn elect(&mut self, number: u64, now: Duration) {
        let elected = self.next_elected(None, None);
        self.send(number, &LinkMessage::Elected(elected), now);
        if let Some(peer) = self.table.peer_mut(number) {
            peer.order.elected();
        }
        self.open(number, elected, now);
    }

    /// Returns the next election, of the `link` with this name or of one with a new name.
    pub(super) fn next_elected(
        &mut self,
        link: Option<[u8; 16]>,
        standby: Option<bool>,
    ) -> Elected {
        let link = link.unwrap_or_else(|| self.random.random());
        let election = self.next_election;
        self.next_election += 1;
        Elected { link, election, standby }
    }

    fn turn_away(&mut self, number: u64, hello: &LinkHello, why: String, now: Duration) {
        self.turn_away_told(number, hello, why.clone(), &why, now);
    }

    /// Like [`turn_away`](Self::turn_away), with another text for the peer.
    fn turn_away_told(
        &mut self,
        number: u64,
        hello: &LinkHello,
        why: String,
        told: &str,
        now: Duration,
    ) {
        let address = self.connections.address(number);
        self.table.remove(number);
        self.close_connection(number, CloseCode::NotAllowed, told, now);
        if let Some(address) = address {
            let peer = peer_text(hello.sae.as_deref(), address);
            let kind = self.authenticated(address.ip());
            let refusal = Refusal::here(CloseCode::NotAllowed, why);
            self.outbox.report(LinkReport::Refused(kind, peer, refusal));
        }
    }

    /// Ends a link of an address that has more of them than the newcomer's. Returns whether it did.
    fn make_place(&mut self, newcomer: IpAddr, now: Duration) -> bool {
        let links = self.table.beside_standby();
        let links: Vec<_> = links
            .filter_map(|(number, _)| Some((self.connections.address(number)?.ip(), number)))
            .collect();
        let Some(number) = self.admission.gives_way(newcomer, &links) else { return false };
        let text = "a host at an address that has fewer links takes its place";
        tracing::info!(%newcomer, "{text}");
        let address = links.iter().find(|(_, other)| *other == number).map(|(ip, _)| *ip);
        if let Some(address) = address
            && self.admission.is_new(address, now)
        {
            let peer = self.peer_text(number);
            let kind = self.authenticated(address);
            let refusal = Refusal::here(CloseCode::NotAllowed, text);
            self.outbox.report(LinkReport::Refused(kind, peer, refusal));
        }
        self.close_connection(number, CloseCode::NotAllowed, text, now);
        self.end_link(number, text, None, now);
        true
    }

    /// Opens an elected link, which carries samples from now on.
    pub(super) fn open(&mut self, number: u64, elected: Elected, now: Duration) {
        let Some(peer) = self.table.peer(number) else {
            return;
        };
        let daemon = peer.summary.hello.daemon;
        let (who, proven) = (peer.summary.who.clone(), peer.proven);
        if let Err(why) = self.claim(daemon, &who, proven, now) {
            return self.violation_told(number, CloseCode::NotAllowed, &why, OTHERS, now);
        }
        let current = self.current(daemon);
        let current_peer = self.table.current_peer(daemon);
        let newer = current_peer.and_then(|current| current.elected);
        let superseded = newer.is_some_and(|current| current.election > elected.election);
        let age = self.keyring.as_ref().map(|keyring| keyring.config.session_max_age);
        let Some(link) = self.table.get_mut(number) else { return };
        let side = link.side;
        let Some(peer) = &mut link.peer else { return };
        peer.elected = Some(elected);
        // The keys of a link that stood by have their age.
        if let Some(age) = age
            && peer.age.until().is_none()
        {
            peer.age = Age::new(age, side == Side::Client, now);
        }
        link.phase = LinkPhase::Open;
        if let Some(connection) = self.connections.get_mut(number) {
            let streams = VarInt::from_u32(STREAMS_OPEN);
            connection.quic.set_max_concurrent_streams(Dir::Uni, streams);
        }
        self.widen(number);
        if superseded {
            tracing::debug!(peer = %daemon, "a newer link was elected before this one's ELECTED arrived");
            if let Some(peer) = self.table.peer_mut(number) {
                // Nothing is sent over a superseded link, so it needs no keys.
                peer.sealing = None;
            }
            if let Some(keyring) = &mut self.keyring {
                keyring.release_standby(now, number);
            }
            self.hand_over(number, now);
            let opened = StreamEvent::Opened { dir: Dir::Uni };
            self.outbox.event(LinkEvent::Stream(number, daemon, opened));
            return;
        }
        let sealing =
            self.table.get_mut(number).and_then(|link| link.peer.as_mut()?.sealing.take());
        if let (Some(keyring), Some(Sealing { exporters, first })) = (&mut self.keyring, sealing)
            && let Err(error) = keyring.attach_sender(now, number, &exporters, first)
        {
            tracing::error!(peer = %daemon, %error, "no message keys for this link");
        }
        self.send_receive_limits(number, now);
        self.dials.opened(number);
        self.table.put_in_use(daemon, number);
        self.handle_in_use(daemon, number, now);
        let closed = current.and_then(|old| self.hand_over(old, now));
        self.outbox.event(LinkEvent::Up { number, daemon, old: current, closed });
        if let Some(connection) = self.connections.get(number) {
            let address = connection.quic.remote_address();
            tracing::info!(peer = %daemon, %address, new = current.is_none(), "link up");
            self.outbox.report(LinkReport::Up { daemon, address, proven });
        }
        self.connections.touch(number);
    }

    /// Checks that a peer may link under a daemon id. If this peer proved the id, a link under it whose peer did not
    /// prove it ends.
    ///
    /// # Errors
    /// The id belongs to another peer.
    pub(super) fn claim(
        &mut self,
        daemon: DaemonId,
        who: &PeerIdentity,
        proven: bool,
        now: Duration,
    ) -> Result<(), String> {
        let Some(current) = self.table.current_peer(daemon) else { return Ok(()) };
        if current.proven == proven && current.summary.who.is(who) {
            return Ok(());
        }
        let other = &current.summary.who;
        if !proven {
            let has = if current.proven { "which proved it" } else { "which came first" };
            return Err(format!(
                "{who} claims daemon id {daemon}, which is that of {other}, {has}"
            ));
        }
        let why =
            format!("{other} claims daemon id {daemon}, which is that of {who}, which proved it");
        if let Some(number) = self.current(daemon) {
            self.violation_told(number, CloseCode::NotAllowed, &why, OTHERS, now);
        }
        Ok(())
    }

    /// Lets the peer have more unread data in flight, as far as its identity's limit allows. Returns whether it may.
    fn widen(&mut self, number: u64) -> bool {
        let (Some(connection), Some(peer)) =
            (self.connections.get_mut(number), self.table.peer_mut(number))
        else {
            return false;
        };
        if !peer.account.unread.share(&mut peer.unread) {
            return false;
        }
        connection.quic.set_receive_window(VarInt::from_u32(window(peer)));
        self.connections.touch(number);
        true
    }

    /// Tells the peer how many bytes it may have in flight.
    fn send_receive_limits(&mut self, number: u64, now: Duration) {
        let Some(peer) = self.table.peer(number) else { return };
        let (unread, messages) = (window(peer).into(), MESSAGES.0 as u64);
        self.send(number, &LinkMessage::ReceiveLimits(ReceiveLimits { unread, messages }), now);
    }

    /// Returns the bytes of long samples that the peer may have in flight over a link.
    pub(in crate::engine) fn window_credit(&self, number: u64) -> Option<u64> {
        Some(window_credit(window(self.table.peer(number)?).into()))
    }

    pub(super) fn widen_all(&mut self, now: Duration) {
        for number in self.table.open() {
            if self.widen(number) {
                self.send_receive_limits(number, now);
            }
        }
    }

    /// Handles the timer of an open link: a successor is dialled, or the link ends.
    pub(super) fn open_timeout(&mut self, number: u64, now: Duration) {
        let Some(peer) = self.table.peer_mut(number) else { return };
        match peer.age.handle_timeout(now) {
            Some(AgeStep::End) => {
                let text = "AXON_QKD_SESSION_MAX_AGE is reached and no successor came";
                self.close_connection(number, CloseCode::KeySupply, text, now);
                return self.end_link(number, text, None, now);
            }
            Some(AgeStep::Renew) => self.dial_successor(number, now),
            None => {}
        }
        self.probe(number, now);
    }

    /// Dials a connection that replaces a link.
    pub(super) fn dial_successor(&mut self, number: u64, now: Duration) {
        let (Some(connection), Some(peer)) =
            (self.connections.get(number), self.table.peer(number))
        else {
            return;
        };
        let target = DialTarget {
            daemon: Some(peer.summary.hello.daemon),
            sae: peer.summary.hello.sae.clone(),
            addresses: vec![connection.quic.remote_address()],
            listed: false,
            standing: None,
            replaces: peer.elected.map(|elected| elected.link),
            beside: None,
        };
        self.dial(target, now);
    }

    /// Returns the link of a peer, if its path counts as cut: connections that discovery dials succeed it.
    pub(in crate::engine) fn cut_link(&self, daemon: DaemonId) -> Option<[u8; 16]> {
        let connection = self.connections.get(self.current(daemon)?)?;
        let peer = self.table.current_peer(daemon)?;
        let cut = peer.silence.is_cut(Traffic::from(&connection.quic.stats()));
        peer.elected.filter(|_| cut).map(|elected| elected.link)
    }

    /// Returns whether a link stands with a daemon that proved its id, and its path does not count as cut.
    pub(in crate::engine) fn stands(&self, daemon: DaemonId) -> bool {
        let proven = self.table.current_peer(daemon).is_some_and(|peer| peer.proven);
        proven && self.cut_link(daemon).is_none()
    }

    /// Closes the links of peers that are no longer trusted. With `certificates`, certificates are checked, too, which
    /// costs signature verifications.
    pub(in crate::engine) fn close_untrusted(&mut self, certificates: bool, now: Duration) {
        let mut untrusted = Vec::new();
        for (number, link) in self.table.iter() {
            let Some(peer) = &link.peer else { continue };
            let chain = certificates.then_some(&peer.chain[..]);
            let why = self.credentials.distrust(
                &peer.summary.negotiated,
                link.side,
                chain,
                (self.wall)(),
            );
            let why = why.or_else(|| peer.summary.who.renamed(self.credentials.auth().as_ref()));
            untrusted.extend(why.map(|why| (number, why)));
        }
        for (number, why) in untrusted {
            self.violation(number, CloseCode::NotAllowed, &why, now);
        }
    }
}

/// Returns the connection window of a peer's link.
fn window(peer: &LinkPeer) -> u32 {
    LINK_WINDOW.saturating_add(u32::try_from(peer.unread.amount()).unwrap_or(u32::MAX))
}
