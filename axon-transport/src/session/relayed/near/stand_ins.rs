//! Stand-ins in the session's process for the remote writers that the daemon matched with its endpoints.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::{Duration, Instant},
};

use super::{RelayConnection, relays::NearRelay};
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

/// How long a client's requests wait for servers that it counts and that the daemon does not say yet
/// that it is matched with.
const SETTLING: Duration = Duration::from_secs(1);

/// What stands for one of them.
pub(super) struct NearStandIn {
    remote_writer: RemoteWriter,
    since: Instant,
    /// Whom it stands for is gone, and has left something.
    leaving: bool,
    /// It comes from an earlier connection, and goes unless it is matched by then.
    kept_until: Option<Instant>,
}

impl NearStandIn {
    pub(super) fn remote_writer(&self) -> &RemoteWriter {
        &self.remote_writer
    }

    /// It outlives its connection. Nobody counts it meanwhile.
    pub(super) fn keep(&mut self, until: Instant) {
        self.kept_until.get_or_insert(until);
        if !std::mem::replace(&mut self.leaving, true) {
            self.remote_writer.leave(true);
        }
    }

    /// Until when it stays though nobody is matched with it.
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

/// What a connection leaves to the next one.
#[derive(Default)]
pub(super) struct LeftByConnection {
    pub(super) relays: BTreeMap<Gid, NearRelay>,
    pub(super) calls: KeptCalls,
}

/// The calls among that.
pub(super) struct KeptCalls {
    /// The daemon's process that carried them.
    pub(super) daemon: Option<DaemonId>,
    pub(super) stand_ins: BTreeMap<Gid, NearStandIn>,
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
    /// The daemon says with whom an endpoint of the session is matched. What it was matched with before
    /// is let go of at once: another message may have it come back, and its channels begin anew then.
    pub(super) fn rematch(&mut self, matched: RelayMatched) {
        let RelayMatched { gid, others } = matched;
        // A writer may have ended meanwhile.
        if !self.own.contains_key(&gid) && !self.parting.contains(&gid) {
            return;
        }
        let others: BTreeSet<Gid> = others.into_iter().collect();
        let before = self.matched.insert(gid, others.clone()).unwrap_or_default();
        // A new server has nothing to get: it awaits none of these requests.
        self.unanswered.resend(&gid, &others.difference(&before).copied().collect());
        if !before.is_subset(&others) {
            self.forget_unwanted();
        }
    }

    /// The daemon has heard that an endpoint is gone, and says nothing of it any more. Until then it was
    /// a reader for the daemon, and what is channelled to it may have gone on for the sake of another.
    pub(super) fn part(&mut self, gid: &Gid) {
        if self.parting.remove(gid) && self.matched.remove(gid).is_some() {
            self.forget_unwanted();
        }
    }

    /// Those who write for an endpoint of the session, and for which of them, as the daemon knows of
    /// them.
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
                // The graph may say later who it is.
                let Some((_, endpoint)) = self.world.get(&writer) else { continue };
                match RemoteWriter::carrying(&self.common.outside, endpoint.clone()) {
                    Ok(remote_writer) => {
                        self.stand_ins.insert(
                            writer,
                            NearStandIn {
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
            // All readers that are there, whether or not the daemon has named all of them: the first
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

    /// Has nobody count those who are gone from the graph, and stand for the sake of what they left.
    pub(super) fn note_leaving(&mut self) {
        for (gid, stand_in) in &mut self.stand_ins {
            let leaving = !self.world.contains_key(gid);
            if std::mem::replace(&mut stand_in.leaving, leaving) != leaving {
                stand_in.remote_writer.leave(leaving);
            }
        }
    }

    /// Whether a subscription or server receives from all stand-ins that there are for it: who outside
    /// counts it may rely on it.
    pub(super) fn is_served(&self, reader: &Endpoint) -> bool {
        // A client may be told of: its requests wait until it is served (`settling`).
        !matches!(reader.kind, EndpointKind::Subscription | EndpointKind::Server)
            || self.stand_ins.values().map(NearStandIn::remote_writer).all(|remote_writer| {
                pairing(remote_writer.endpoint(), reader) != Pairing::Match
                    || remote_writer.partners().contains(&reader.gid)
            })
    }

    /// By way of whom requests leave, and which wait; to whom responses may.
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
                    // It stands for the sake of another client, and this one counts it already.
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

    /// Tells the daemon of the clients that have a stand-in, whose servers' responses may then
    /// come.
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
        // Those that have fewer first: in between there are not too many, either.
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

    /// How long until requests go whether or not all is settled.
    pub(super) fn settled_in(&self) -> Option<Duration> {
        let until = self.settling.values().min()?;
        Some(until.saturating_duration_since(Instant::now()))
    }

    /// Whether all requests of a client of the session are with the daemon.
    pub(super) fn is_asked(&self, client: &Gid) -> bool {
        !self.unanswered.is_due(client)
            && self.pipe.outgoing.is_idle(&FlowChannel::of(*client))
            && self.stand_ins.iter().all(|(server, stand_in)| {
                !stand_in.remote_writer().has_from(client) && !self.calls.holds(client, server)
            })
    }

    /// Whether all responses of a server of the session are.
    pub(super) fn is_answered(&self, server: &Gid) -> bool {
        let clients = self.callers.get(server).into_iter().flatten();
        let mut there = clients.filter_map(|client| Some((client, self.stand_ins.get(client)?)));
        there.all(|(client, stand_in)| {
            !stand_in.remote_writer().has_from(server)
                && self.pipe.outgoing.is_idle(&FlowChannel::between(*server, *client))
        })
    }
}
