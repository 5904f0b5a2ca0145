//! Links: from a connection that proved its peer to the one that is in use, its successor, its end.

use std::{
    net::IpAddr,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::{Duration, Instant},
};

use axon_shm::ids::DaemonId;
use tokio::sync::{mpsc, watch};

use super::{Event, Hub, Link, Summary, leaving::Leaving};
use crate::{
    gateway::{
        account::Account,
        bridge::ToControl,
        control::ControlReader,
        dial::{Target, dial},
        endpoint::{open_streams, open_window},
        establish::{Established, Sealing, close, peer_text},
        inbound::Inbound,
        outbound::{Carrier, Owner},
        peer::{Peer, Prover, binding, spawn_reader},
        protection::Protection,
        refusal::{Refusal, RefusedBy},
        shares::gives_way,
        silence::{Traffic, Watch},
        status::Who,
    },
    link::{Candidate, CloseCode, Elected, Message, Side, keep},
};

/// A link that the lower id has not elected by then is closed.
const ELECTION_TIMEOUT: Duration = Duration::from_secs(10);
/// Peers, and connections that await their election.
const MAX_LINKS: usize = 128 + 32;
/// Connections of one peer: its link, one from each side in its place, and what these supersede.
const MAX_LINKS_OF_PEER: usize = 16;
/// Elections of this process. A daemon outlives its gateway, and its peers know its elections by its id.
static ELECTIONS: AtomicU64 = AtomicU64::new(1);
/// Why somebody who claims a linked daemon's id gets no link.
const TAKEN: &str = "this daemon id is linked already, under another identity";

impl Link {
    /// Lets its peer have as much under way over it as there is for it by now.
    pub(super) fn widen(&mut self) {
        if self.account.unread.share(&mut self.unread) {
            open_window(&self.connection, self.unread.amount());
        }
    }

    /// What makes its successor.
    fn successor(&self) -> Target {
        Target {
            daemon: Some(self.established.hello.daemon),
            sae: self.established.hello.sae.clone(),
            addresses: vec![self.connection.remote_address()],
            listed: false,
            standing: None,
            replaces: self.elected.map(|e| e.link),
        }
    }
}

impl Hub {
    pub(super) fn dial(&self, target: Target) {
        let (context, endpoints) = (Arc::clone(&self.context), Arc::clone(&self.endpoints));
        let events = self.events.clone();
        tokio::spawn(async move {
            let result = dial(&context, &endpoints, &target).await;
            let _ = events.send(Event::Dialled(target, Box::new(result))).await;
        });
    }

    /// A connection completed HELLO and proof; the lower id elects. `replaces` names the link that
    /// it succeeds.
    pub(super) async fn established(
        &mut self,
        established: Established,
        replaces: Option<[u8; 16]>,
    ) {
        let daemon = established.hello.daemon;
        let number = established.number;
        let current = self.peers.get(&daemon).and_then(|p| self.links.get(&p.link));
        // The handshake may have gone by files that have changed since.
        let Established { connection, negotiated, side, .. } = &established;
        if let Some(why) = self.context.distrust(connection, negotiated, *side, true) {
            return self.turn_away(established, why).await;
        }
        // Daemon ids are public: beacons carry them. Who has a link keeps it against anyone who
        // proves to be somebody else.
        let (qkd, auth) = (self.context.keyring.is_some(), self.context.auth());
        let who = Who::of(qkd, auth.as_ref(), &established.hello, &established.negotiated);
        if current.is_some_and(|c| !c.established.who.is(&who)) {
            return self.turn_away(established, TAKEN.into()).await;
        }
        let theirs = self.links.values().map(|link| &link.established.who);
        let theirs = theirs.chain(self.leaving.values().filter_map(Leaving::who));
        let newcomer = established.connection.remote_address().ip();
        let full = current.is_none() && self.links.len() >= MAX_LINKS;
        let too_many = if theirs.filter(|other| other.is(&who)).count() >= MAX_LINKS_OF_PEER {
            Some("this peer has as many connections as it may")
        } else if full && !self.make_place(newcomer).await {
            Some("this daemon has as many links as it may, and no address has more than this one")
        } else {
            None
        };
        if let Some(text) = too_many {
            if self.crowded.is_news(newcomer, Instant::now()) {
                return self.turn_away(established, text.into()).await;
            }
            close(&established.connection, CloseCode::NotAllowed, text);
            return self.forget(&established);
        }
        let current = self.peers.get(&daemon).and_then(|p| self.links.get(&p.link));
        let successor =
            replaces.is_some() && current.is_some_and(|c| c.elected.map(|e| e.link) == replaces);
        let candidate = Candidate { side: established.side, successor };
        let we_elect = self.context.hello.daemon < daemon;
        let ours = self.context.hello.daemon;
        if we_elect && current.is_some_and(|c| !keep(ours, daemon, c.candidate, candidate)) {
            close(&established.connection, CloseCode::Duplicate, "another connection stands");
            self.forget(&established);
            if established.side == Side::Client {
                let address = established.connection.remote_address();
                self.tell(ToControl::LinkUp { daemon, address }).await;
            }
            return;
        }
        let connection = established.connection.clone();
        let (reader, account) = self.insert(established, candidate, who);
        spawn_reader(number, reader, account, connection, self.events.clone());
        if we_elect {
            self.elect(number).await;
        } else {
            let events = self.events.clone();
            tokio::spawn(async move {
                tokio::time::sleep(ELECTION_TIMEOUT).await;
                let _ = events.send(Event::Unelected(number)).await;
            });
        }
    }

    /// Has a link of the address that has the most give way to one from `newcomer`; whether one did.
    async fn make_place(&mut self, newcomer: IpAddr) -> bool {
        let links = self.links.iter();
        let links: Vec<_> =
            links.map(|(number, link)| (link.connection.remote_address().ip(), *number)).collect();
        let listed = |address| self.context.is_listed(address);
        let Some(number) = gives_way(newcomer, &links, listed) else { return false };
        let text = "a host at an address that has fewer links takes its place";
        tracing::info!(%newcomer, "{text}");
        if let Some(link) = self.links.get(&number) {
            close(&link.connection, CloseCode::NotAllowed, text);
            let address = link.connection.remote_address();
            if self.crowded.is_news(address.ip(), Instant::now()) {
                let refusal = Refusal::here(CloseCode::NotAllowed, text);
                self.refused(self.peer_of(link), refusal).await;
            }
        }
        self.link_ended(number, text).await;
        true
    }

    async fn turn_away(&self, established: Established, why: String) {
        close(&established.connection, CloseCode::NotAllowed, &why);
        self.forget(&established);
        let sae = established.hello.sae.as_deref();
        let peer = peer_text(sae, established.connection.remote_address());
        self.refused(peer, Refusal::here(CloseCode::NotAllowed, why)).await;
    }

    /// The connection does not become a link: its keys are let go.
    pub(super) fn forget(&self, established: &Established) {
        if let Some(keyring) = &self.context.keyring {
            keyring.forget_connection(established.number);
        }
    }

    pub(super) fn insert(
        &mut self,
        established: Established,
        candidate: Candidate,
        who: Who,
    ) -> (ControlReader, Arc<Account>) {
        let protection = match (&self.context.keyring, &established.sealing) {
            (Some(keyring), Some(sealing)) => Protection::Envelope {
                keyring: Arc::clone(keyring),
                keys: Arc::clone(&sealing.keys),
                connection: established.number,
            },
            _ => Protection::Link,
        };
        let connection = established.connection;
        let identity = who.host_identity(connection.remote_address());
        let account = self.shared.accounts.of(&identity);
        established.outbox.charge_to(Arc::clone(&account.unsent));
        let carrying = watch::Sender::new(());
        let in_use = carrying.subscribe();
        let link = Link {
            carrier: Carrier { connection: connection.clone(), protection, in_use },
            carrying,
            reading: watch::Sender::new(()),
            connection,
            established: Summary {
                hello: established.hello,
                negotiated: established.negotiated,
                who,
            },
            order: established.order,
            candidate,
            outbox: established.outbox,
            sealing: established.sealing,
            elected: None,
            until: None,
            since_unix_ms: axon_transport::status::unix_ms(),
            unread: account.unread.nothing(),
            account: Arc::clone(&account),
            traffic: Traffic::default(),
            watch: None,
            silent: false,
        };
        self.links.insert(established.number, link);
        (established.reader, account)
    }

    /// This side has the lower id: the connection stays.
    pub(super) async fn elect(&mut self, number: u64) {
        // Relaxed: a number, not a hand-over.
        let election = ELECTIONS.fetch_add(1, Ordering::Relaxed);
        let elected = Elected { link: rand::random(), election };
        if let Some(link) = self.links.get_mut(&number) {
            link.outbox.send(Message::Elected(elected));
            link.order.elected();
            self.open(number, elected).await;
        }
    }

    /// The connection was elected: it becomes the peer's link, if none was elected after it.
    pub(super) async fn open(&mut self, number: u64, elected: Elected) {
        let Some(link) = self.links.get(&number) else { return };
        let daemon = link.established.hello.daemon;
        // Another connection may have been elected while this one waited.
        let current = self.peers.get(&daemon).and_then(|p| self.links.get(&p.link));
        if current.is_some_and(|c| !c.established.who.is(&link.established.who)) {
            return self.violation(number, CloseCode::NotAllowed, TAKEN.into()).await;
        }
        if current.and_then(|c| c.elected).is_some_and(|c| c.election > elected.election) {
            tracing::debug!(peer = %daemon, "superseded before its election was heard of");
            // The peer may have sent samples over it before it elected the next.
            let Some(link) = self.links.get_mut(&number) else { return };
            open_streams(&link.connection);
            link.widen();
            let carrier = link.carrier.clone();
            self.spawn_inbound(number, daemon, carrier);
            self.hand_over(number);
            return;
        }
        let Some(link) = self.links.get_mut(&number) else { return };
        link.elected = Some(elected);
        let age = self.context.keyring.as_ref().map(|keyring| keyring.config.session_max_age);
        link.until = age.map(|age| Instant::now() + age);
        let (connection, outbox) = (link.connection.clone(), link.outbox.clone());
        let account = Arc::clone(&link.account);
        let (carrier, side) = (link.carrier.clone(), link.candidate.side);
        if let (Some(keyring), Some(sealing)) = (&self.context.keyring, link.sealing.take()) {
            let Sealing { keys, exporters, first } = sealing;
            if let Err(error) = keys.attach_sender(keyring, number, &exporters, first) {
                tracing::error!(peer = %daemon, %error, "no message keys for this link");
            }
        }
        open_streams(&connection);
        link.widen();
        let mut closed = None;
        let new = match self.peers.get_mut(&daemon) {
            Some(peer) => {
                let old = peer.link;
                peer.succeed(number, outbox, carrier.clone(), &self.local);
                closed = self.hand_over(old);
                false
            }
            None => {
                let identity = link.established.who.host_identity(connection.remote_address());
                let owner = Owner { daemon, identity, events: self.events.clone() };
                let (ours, proofs) = (self.context.hello.daemon, self.context.authenticates());
                let binding = binding(&connection);
                let prover = Prover::new(&self.shared.keys, ours, proofs, binding);
                let (carrier, shared) = (carrier.clone(), &self.shared);
                let peer = Peer::new(number, outbox, carrier, account, prover, shared, owner);
                self.peers.insert(daemon, peer);
                true
            }
        };
        self.spawn_inbound(number, daemon, carrier);
        self.plan_end(number, side);
        if let Some(peer) = self.peers.get_mut(&daemon) {
            closed.into_iter().for_each(|closed| peer.say(Message::LinkClosed(closed)));
            peer.send_graph(&self.local, true);
        }
        let address = connection.remote_address();
        tracing::info!(peer = %daemon, %address, new, "link up");
        self.tell(ToControl::LinkUp { daemon, address }).await;
        self.report().await;
    }

    pub(super) fn spawn_inbound(&self, number: u64, daemon: DaemonId, carrier: Carrier) {
        let (Some(peer), Some(link)) = (self.peers.get(&daemon), self.links.get(&number)) else {
            return;
        };
        let (who, wanted) = (self.peer_of(link), link.reading.subscribe());
        let (refused, mut violations) = mpsc::channel(1);
        let inbound: Inbound = peer.inbound(carrier, &self.shared, wanted, refused);
        tokio::spawn(inbound.run());
        let events = self.events.clone();
        tokio::spawn(async move {
            if let Some((code, reason)) = violations.recv().await {
                let _ = events.send(Event::Violation(number, who, code, reason)).await;
            }
        });
    }

    /// In qkd a link lives no longer than AXON_QKD_SESSION_MAX_AGE: its dialler makes a successor
    /// in time, and should none come, both sides close it.
    pub(super) fn plan_end(&self, number: u64, side: Side) {
        let Some(keyring) = &self.context.keyring else { return };
        let age = keyring.config.session_max_age;
        let events = self.events.clone();
        tokio::spawn(async move {
            let renewal = renewal_at(age);
            tokio::time::sleep(renewal).await;
            if side == Side::Client && events.send(Event::Renew(number)).await.is_err() {
                return;
            }
            tokio::time::sleep(age.saturating_sub(renewal)).await;
            let _ = events.send(Event::Expired(number)).await;
        });
    }

    pub(super) fn renew(&self, number: u64) {
        let Some(link) = self.links.get(&number) else { return };
        self.dial(link.successor());
        // Should the dial fail, the next try is due before the key's age is reached.
        let after = self.context.keyring.as_ref().map(|k| k.config.session_max_age.mul_f64(0.04));
        let events = self.events.clone();
        tokio::spawn(async move {
            tokio::time::sleep(after.unwrap_or_default().max(Duration::from_secs(1))).await;
            let _ = events.send(Event::Renew(number)).await;
        });
    }

    /// Has links watched over which something went out and nothing came in the last second.
    pub(super) fn watch_silent(&mut self) {
        let (daemon, endpoints) = (self.context.hello.daemon, &self.endpoints);
        for (number, link) in self.links.iter_mut().filter(|(_, link)| link.elected.is_some()) {
            let before = std::mem::replace(&mut link.traffic, Traffic::of(&link.connection));
            let watched = link.watch.as_ref().is_some_and(|watch| !watch.is_finished());
            // It is not any more: what it has under way arrives.
            link.silent &= !link.traffic.answered_since(before);
            if watched || !link.traffic.is_silent_since(before) {
                continue;
            }
            tracing::debug!(peer = %link.established.hello.daemon,
                "the link does not answer: probing its path");
            let watch = Watch {
                number: *number,
                connection: link.connection.clone(),
                traffic: link.traffic,
                side: link.candidate.side,
                daemon,
                endpoints: Arc::clone(endpoints),
                echoes: Arc::clone(&self.echoes),
                events: self.events.clone(),
            };
            link.watch = Some(tokio::spawn(watch.run()));
        }
    }

    /// The path of a silent link works: a successor is dialled over it.
    pub(super) fn replace_silent(&mut self, number: u64, since: Traffic) {
        let Some(link) = self.links.get_mut(&number) else { return };
        // An acknowledgement may have come before the hub heard of the silence.
        if Traffic::of(&link.connection).answered_since(since) {
            return;
        }
        link.silent = true;
        let (daemon, address) = (link.established.hello.daemon, link.connection.remote_address());
        tracing::info!(peer = %daemon, %address,
            "the link is silent though its path works: dialling a successor");
        let target = link.successor();
        self.dial(target);
    }

    /// A pin that was removed, or ran out, closes its live links within a second; so does a
    /// certificate that is no longer accepted, which is looked at if `certificates` says so.
    pub(super) async fn close_untrusted(&mut self, certificates: bool) {
        let distrust = |l: &Link| {
            let (negotiated, side) = (&l.established.negotiated, l.candidate.side);
            self.context.distrust(&l.connection, negotiated, side, certificates)
        };
        let links = self.links.iter();
        let untrusted: Vec<_> = links.filter_map(|(n, l)| Some((*n, distrust(l)?))).collect();
        for (number, why) in untrusted {
            self.violation(number, CloseCode::NotAllowed, why).await;
        }
        self.close_untrusted_leaving(certificates);
    }

    pub(super) async fn link_ended(&mut self, number: u64, reason: &str) {
        let Some(link) = self.links.remove(&number) else { return self.leaving_ended(number) };
        let refusal = link.connection.close_reason().map(|e| Refusal::of(&e));
        let reason = refusal.as_ref().map_or_else(|| reason.to_owned(), ToString::to_string);
        if let Some(keyring) = &self.context.keyring {
            keyring.forget_connection(number);
        }
        let daemon = link.established.hello.daemon;
        // Closing what is closed already changes nothing.
        close(&link.connection, CloseCode::Goodbye, "the control stream ended");
        if self.peers.get(&daemon).is_none_or(|p| p.link != number) {
            return;
        }
        // Its graph, and what of its streams was not read.
        if let Some(peer) = self.peers.remove(&daemon) {
            let (events, who, tally) = (self.events.clone(), self.peer_of(&link), peer.over());
            tokio::spawn(async move {
                tally.is_final().await;
                // An error: the hub is gone.
                let _ = events.send(Event::LinkLost(who, tally.take_lost())).await;
            });
            give_memory_back();
        }
        self.freed = true;
        self.abandon_leaving(daemon);
        self.tell_draining().await;
        tracing::info!(peer = %daemon, reason, "link down");
        if let Some(refusal) = refusal.filter(|r| r.by == RefusedBy::Peer) {
            let ordinary = ["GOODBYE", "DUPLICATE", "REPLACED"];
            if !ordinary.contains(&refusal.name.as_str()) {
                let peer = self.peer_of(&link);
                self.refused(peer, refusal).await;
            }
        }
        self.tell(ToControl::LinkDown { daemon, reason }).await;
    }
}

/// The allocator keeps what it freed: what a peer had is given back, once the control plane
/// has let go of it, too.
fn give_memory_back() {
    tokio::spawn(async {
        tokio::time::sleep(Duration::from_secs(1)).await;
        let _ = tokio::task::spawn_blocking(axon_shm::internal::return_free_memory).await;
    });
}

/// When the successor of a link is dialled: a tenth of its age before the end, but at least ten
/// seconds where that is no more than half of it, since the KMEs may be slow.
fn renewal_at(age: Duration) -> Duration {
    age - (age / 10).max(Duration::from_secs(10)).min(age / 2)
}
