//! Stand-ins in the session's process for the remote writers that the daemon matched with its endpoints.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::{Duration, Instant},
};

use super::{RelayConnection, relays::SessionRelay};
use crate::{
    graph::{Endpoint, EndpointKind, Pairing, pairing, reads},
    ids::{DaemonId, Gid},
    session::{
        endpoints::RemoteWriter,
        relayed::{
            MAX_CALLERS, calls::CallChannels, flow::FlowChannel, pipe::End,
            response_log::ResponseLog, unanswered::Unanswered,
        },
    },
    wire::session::{RelayMatched, SessionMessage},
};

/// Time for which a client's requests wait for a server that the client already counts, until the daemon reports the
/// match.
const SETTLING: Duration = Duration::from_secs(1);

/// The stand-in for one remote writer.
pub(super) struct SessionStandIn {
    remote_writer: RemoteWriter,
    since: Instant,
    /// True if the remote writer is gone and has left messages.
    leaving: bool,
    /// Set for a stand-in from an earlier connection: it ends at this time unless it is matched by then.
    kept_until: Option<Instant>,
}

impl SessionStandIn {
    pub(super) fn remote_writer(&self) -> &RemoteWriter {
        &self.remote_writer
    }

    /// Keeps the stand-in beyond its connection. No endpoint counts it meanwhile.
    pub(super) fn keep(&mut self, until: Instant) {
        self.kept_until.get_or_insert(until);
        if !std::mem::replace(&mut self.leaving, true) {
            self.remote_writer.leave(true);
        }
    }

    /// Returns the time until which the stand-in stays without a match.
    pub(super) fn kept_until(&self) -> Option<Instant> {
        self.kept_until
    }

    pub(super) fn is_kept(&self) -> bool {
        self.kept_until.is_some()
    }

    pub(super) fn is_overdue(&self, now: Instant) -> bool {
        self.kept_until.is_some_and(|until| until <= now)
    }
}

/// The state that a connection leaves to the next one.
#[derive(Default)]
pub(super) struct LeftByConnection {
    pub(super) relays: BTreeMap<Gid, SessionRelay>,
    pub(super) calls: KeptCalls,
}

/// The calls that a connection leaves to the next one.
pub(super) struct KeptCalls {
    /// The daemon's process that carried them.
    pub(super) daemon: Option<DaemonId>,
    pub(super) stand_ins: BTreeMap<Gid, SessionStandIn>,
    pub(super) calls: CallChannels,
    pub(super) unanswered: Unanswered,
    pub(super) response_log: ResponseLog,
}

impl Default for KeptCalls {
    fn default() -> Self {
        let (stand_ins, calls, unanswered) = Default::default();
        Self { daemon: None, stand_ins, calls, unanswered, response_log: ResponseLog::default() }
    }
}

impl RelayConnection<'_> {
    /// Handles the daemon's message that lists the matches of an endpoint of the session. Earlier matches
    /// that are missing are dropped at once: a later message may restore one, and its channels then start
    /// anew.
    pub(super) fn rematch(&mut self, matched: RelayMatched) {
        let RelayMatched { gid, others } = matched;
        // The endpoint may have ended meanwhile.
        if !self.own.contains_key(&gid) && !self.parting.contains(&gid) {
            return;
        }
        let others: BTreeSet<Gid> = others.into_iter().collect();
        let before = self.matched.insert(gid, others.clone()).unwrap_or_default();
        // A server that was not matched before does not expect any of these requests.
        self.unanswered.resend(&gid, &others.difference(&before).copied().collect());
        if !before.is_subset(&others) {
            self.forget_unwanted();
        }
    }

    /// Handles the daemon's confirmation that an endpoint has ended. The daemon reports nothing about the
    /// endpoint afterwards. Until then the endpoint still counted as a reader, so channels that only served
    /// it may still be open.
    pub(super) fn part(&mut self, gid: &Gid) {
        if self.parting.remove(gid) && self.matched.remove(gid).is_some() {
            self.forget_unwanted();
        }
    }

    /// Returns the remote writers that the daemon matched with the session's reading endpoints, each with
    /// those endpoints.
    fn wanted(&self) -> BTreeMap<Gid, Vec<Gid>> {
        let mut wanted: BTreeMap<Gid, Vec<Gid>> = BTreeMap::new();
        let own = self.own.values().filter(|e| reads(e.kind)).map(|e| &e.gid);
        for reader in own.chain(&self.parting) {
            for writer in self.matched.get(reader).into_iter().flatten() {
                wanted.entry(*writer).or_default().push(*reader);
            }
        }
        wanted
    }

    fn forget_unwanted(&mut self) -> BTreeMap<Gid, Vec<Gid>> {
        let wanted = self.wanted();
        self.stand_ins.retain(|gid, stand_in| {
            let is_wanted = wanted.contains_key(gid);
            if is_wanted {
                stand_in.kept_until = None;
            }
            let stays = is_wanted || stand_in.is_kept();
            if !stays {
                self.unanswered.forget_server(gid);
            }
            stays
        });
        self.pipe.retain(|FlowChannel { writer, client }| {
            wanted.get(writer).is_some_and(|readers| client.is_none_or(|c| readers.contains(&c)))
        });
        wanted
    }

    pub(super) fn update_stand_ins(&mut self) -> Result<(), End> {
        for (writer, readers) in self.forget_unwanted() {
            if readers.iter().all(|reader| self.parting.contains(reader)) {
                continue;
            }
            if !self.stand_ins.contains_key(&writer) {
                // The graph may describe the writer later.
                let Some((_, endpoint)) = self.world.get(&writer) else { continue };
                match RemoteWriter::carrying(&self.common.outside, endpoint.clone()) {
                    Ok(remote_writer) => {
                        self.stand_ins.insert(
                            writer,
                            SessionStandIn {
                                remote_writer,
                                since: Instant::now(),
                                leaving: false,
                                kept_until: None,
                            },
                        );
                    }
                    Err(error) => {
                        let topic = &endpoint.topic;
                        tracing::error!(topic, %writer, %error, "nothing is received from it");
                        continue;
                    }
                }
            }
            let remote_writer = self.stand_ins[&writer].remote_writer();
            let partners = remote_writer.partners();
            if let RemoteWriter::Server(_) = remote_writer {
                for client in readers.iter().filter(|client| partners.contains(client)) {
                    self.pipe.open_in(FlowChannel::between(writer, *client))?;
                }
                continue;
            }
            // All present readers must be attached, even if the daemon has not named all of them: the first
            // samples are for them, too. A reader that is ending reads no more.
            let own = self.own.values().filter(|e| !self.ending.contains_key(&e.gid));
            let mut readers =
                own.filter(|e| pairing(remote_writer.endpoint(), e) == Pairing::Match);
            if readers.all(|reader| partners.contains(&reader.gid)) {
                self.pipe.open_in(FlowChannel::of(writer))?;
            }
        }
        Ok(())
    }

    /// Marks the stand-ins whose writer is gone from the graph, so that no endpoint counts them. They stay for the
    /// remaining messages of the writer.
    pub(super) fn note_leaving(&mut self) {
        for (gid, stand_in) in &mut self.stand_ins {
            let leaving = !self.world.contains_key(gid);
            if std::mem::replace(&mut stand_in.leaving, leaving) != leaving {
                stand_in.remote_writer.leave(leaving);
            }
        }
    }

    /// Returns whether a subscription or server is attached to all matching stand-ins. Remote endpoints that
    /// count it may rely on that.
    pub(super) fn is_served(&self, reader: &Endpoint) -> bool {
        // A client may be announced earlier: its requests wait until it is served (`settling`).
        !matches!(reader.kind, EndpointKind::Subscription | EndpointKind::Server)
            || self.stand_ins.values().map(SessionStandIn::remote_writer).all(|remote_writer| {
                pairing(remote_writer.endpoint(), reader) != Pairing::Match
                    || remote_writer.partners().contains(&reader.gid)
            })
    }

    /// Updates the servers that requests go to, the clients whose requests must wait, and the clients that
    /// may be answered.
    pub(super) fn update_calls(&mut self) -> Result<(), End> {
        self.settling.clear();
        let mut pairs = Vec::new();
        for client in self.own.values().filter(|e| e.kind == EndpointKind::Client) {
            let matched = self.matched.get(&client.gid);
            for (server, stand_in) in &self.stand_ins {
                let remote_writer = stand_in.remote_writer();
                if pairing(client, remote_writer.endpoint()) != Pairing::Match {
                    continue;
                }
                pairs.push((client.gid, *server));
                if !matched.is_some_and(|all| all.contains(server))
                    && remote_writer.partners().contains(&client.gid)
                {
                    // The stand-in exists for another client, and this client counts it already.
                    let told = self.asking.get(&client.gid).copied().unwrap_or(stand_in.since);
                    let until = told.max(stand_in.since) + SETTLING;
                    let latest = self.settling.entry(client.gid).or_insert(until);
                    *latest = until.max(*latest);
                }
            }
        }
        self.calls.set(pairs.into_iter());
        let now = Instant::now();
        self.settling.retain(|_, until| *until > now);
        self.tell_callers()
    }

    /// Reports to the daemon the clients that have a stand-in. Responses of the session's servers to these
    /// clients may then be sent.
    fn tell_callers(&mut self) -> Result<(), End> {
        let mut room = MAX_CALLERS;
        let mut changes = Vec::new();
        for server in self.own.values().filter(|e| e.kind == EndpointKind::Server) {
            let all = self.matched.get(&server.gid).into_iter().flatten();
            let there: Vec<Gid> =
                all.filter(|client| self.stand_ins.contains_key(client)).copied().collect();
            let now: BTreeSet<Gid> = there.iter().take(room).copied().collect();
            room -= now.len();
            let before = self.callers.get(&server.gid);
            if before == Some(&now) {
                continue;
            }
            if now.len() < there.len() {
                let topic = &server.topic;
                tracing::error!(
                    topic,
                    "a service has more clients than a relayed session may answer: the others get no response"
                );
            }
            let more = now.len().cast_signed() - before.map_or(0, BTreeSet::len).cast_signed();
            changes.push((more, server.gid, now));
        }
        // Servers with fewer clients go first, so that the limit is never exceeded in between.
        changes.sort_by_key(|(more, ..)| *more);
        for (_, server, now) in changes {
            let others = now.iter().copied().collect();
            self.pipe.say(&SessionMessage::Matched(RelayMatched { gid: server, others }))?;
            self.pipe.outgoing.retain(|FlowChannel { writer, client }| {
                *writer != server || client.is_some_and(|client| now.contains(&client))
            });
            for client in &now {
                self.pipe.open_out(FlowChannel::between(server, *client));
            }
            self.callers.insert(server, now);
        }
        Ok(())
    }

    /// Returns the time until the next client's requests are sent even if not all its servers are matched.
    pub(super) fn settled_in(&self) -> Option<Duration> {
        let until = self.settling.values().min()?;
        Some(until.saturating_duration_since(Instant::now()))
    }

    /// Returns whether the daemon has all requests of a client of the session.
    pub(super) fn is_asked(&self, client: &Gid) -> bool {
        !self.unanswered.is_due(client)
            && self.pipe.outgoing.is_idle(&FlowChannel::of(*client))
            && self.stand_ins.iter().all(|(server, stand_in)| {
                !stand_in.remote_writer().has_from(client) && !self.calls.holds(client, server)
            })
    }

    /// Returns whether the daemon has all responses of a server of the session.
    pub(super) fn is_answered(&self, server: &Gid) -> bool {
        let clients = self.callers.get(server).into_iter().flatten();
        let mut there = clients.filter_map(|client| Some((client, self.stand_ins.get(client)?)));
        there.all(|(client, stand_in)| {
            !stand_in.remote_writer().has_from(server)
                && self.pipe.outgoing.is_idle(&FlowChannel::between(*server, *client))
        })
    }
}
