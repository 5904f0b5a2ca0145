//! Handles the messages of sessions.

use std::collections::BTreeSet;

use super::{
    LocalEndpoint, MAX_ALL_PAIRS, MAX_PAIRS, MAX_SESSIONS, MAX_TOMBSTONES, PairProgress, Registry,
    SessionEntry, Violation,
    output::{PAIRS_TOGETHER, session_entry},
    relayed::MAX_REASON,
};
use crate::{
    graph::{Endpoint, EndpointKind, LIMITS, Scope, writes},
    ids::{Gid, SessionId},
    text,
    wire::session::{
        Announce, Attach, EndpointRole, GivenUp, Granted, Leaving, Message, Pair, Refused,
        SessionRole, Unmatch,
    },
};

/// How many times as many endpoints as another session the gateway's may have.
const GATEWAYS: usize = 4;

impl<F: Clone> Registry<F> {
    /// A session whose HELLO was taken. It will be told the whole graph, or as much of it as its
    /// `scope` lets it see; without one ranges do not apply to it.
    ///
    /// # Errors
    /// When there are too many sessions.
    pub fn handle_connect(
        &mut self,
        id: SessionId,
        role: SessionRole,
        name: String,
        pid: u32,
        descriptors: Option<[F; 3]>,
        scope: Option<Scope>,
    ) -> Result<(), Violation> {
        self.handle_disconnect(&id);
        if self.sessions.len() >= MAX_SESSIONS {
            return Err(Violation::Sessions);
        }
        self.left.forget(&id);
        self.sessions.insert(id, session_entry(role, name, pid, descriptors, scope));
        self.rescoped |= role == SessionRole::Application;
        if role != SessionRole::Tool {
            self.mark_behind(&id);
        }
        Ok(())
    }

    /// A session that is gone, and its endpoints with it.
    pub fn handle_disconnect(&mut self, id: &SessionId) {
        while self.handle_disconnect_in_parts(id) {}
    }

    /// As [`handle_disconnect`](Self::handle_disconnect), a part of it; whether there is more to do. The rest of
    /// the session is told nothing any more.
    pub fn handle_disconnect_in_parts(&mut self, id: &SessionId) -> bool {
        self.mark_behind(id);
        let mut pairs = 0;
        while let Some(entry) = self.sessions.get_mut(id) {
            let before = self.pairs.len();
            let Some(gid) = entry.endpoints.pop_first() else {
                if let Some(entry) = self.sessions.remove(id) {
                    self.left.keep(*id, entry.segments);
                }
                self.ready.remove(id);
                self.rescoped = true;
                return false;
            };
            self.remove_endpoint(&gid, "its session ended");
            pairs += 1 + before - self.pairs.len();
            if pairs >= PAIRS_TOGETHER {
                return true;
            }
        }
        false
    }

    /// A message of a session.
    ///
    /// # Errors
    /// When no session sends such a message; the caller disconnects it.
    pub fn handle_message(
        &mut self,
        id: &SessionId,
        message: Message,
        descriptors: Vec<F>,
    ) -> Result<(), Violation> {
        let tool = self.sessions.get(id).is_none_or(|s| s.role == SessionRole::Tool);
        let carries = matches!(message, Message::Segment(_) | Message::Unknown(_));
        if !descriptors.is_empty() && !carries {
            return Err(Violation::Descriptors(descriptors.len()));
        }
        match message {
            Message::Unknown(_) => Ok(()),
            _ if tool => Err(Violation::Unexpected),
            Message::Endpoint(announce) => self.announce(id, announce),
            Message::Segment(opened) => self.open_segment(id, opened.segment, descriptors),
            Message::SegmentGone(gone) => {
                self.close_segment(id, gone.number);
                Ok(())
            }
            Message::Need(need) => {
                self.need_segment(id, &need.session, need.number);
                Ok(())
            }
            Message::EndpointGone(gone) => self.gone(id, gone.gid),
            Message::Leaving(leaving) => self.leave(id, leaving),
            Message::Attach(attach) => self.attach(id, attach),
            Message::Grant(grant) => self.grant(id, grant),
            Message::Detach(pair) => self.detach(id, pair),
            Message::GivenUp(given_up) => self.give_up(id, given_up),
            Message::Fence(fence) => self.fence(id, fence),
            Message::Unmatch(unmatch) => self.fail(id, unmatch),
            Message::Resync => {
                // Everything costs much more to tell than to ask for.
                if let Some(entry) = self.sessions.get_mut(id) {
                    entry.resync = true;
                    self.ready.insert(*id);
                }
                Ok(())
            }
            _ => Err(Violation::Unexpected),
        }
    }

    fn announce(&mut self, id: &SessionId, announce: Announce) -> Result<(), Violation> {
        let Announce { endpoint, role, stands_for, ring, only } = announce;
        let gid = endpoint.gid;
        // A server has a ring for each of its clients, of which GRANT speaks.
        if ring.is_some() != matches!(endpoint.kind, EndpointKind::Publisher | EndpointKind::Client)
        {
            return Err(Violation::Unexpected);
        }
        if only.is_some() && role != EndpointRole::Relay {
            return Err(Violation::Unexpected);
        }
        let Some(entry) = self.sessions.get(id) else { return Ok(()) };
        let may = match role {
            EndpointRole::Application => gid.is_of(id),
            EndpointRole::StandIn => {
                entry.role == SessionRole::Gateway && writes(endpoint.kind) && !gid.is_of(id)
            }
            EndpointRole::Relay => {
                entry.role == SessionRole::Gateway
                    && endpoint.kind == EndpointKind::Subscription
                    && gid.is_of(id)
            }
        };
        if !may {
            return Err(Violation::NotItsOwn(gid));
        }
        if let Some(known) = self.endpoints.get_mut(&gid) {
            if known.session != *id || known.role != role {
                return Err(Violation::NotItsOwn(gid));
            }
            if known.stands_for != stands_for {
                known.stands_for = stands_for;
                self.rematch(&gid);
            }
            return Ok(());
        }
        let refusal = if !endpoint.is_sane() {
            Some("a name, type hash or depth out of bounds")
        } else if entry.endpoints.len() >= most_endpoints(entry.role) {
            Some("too many endpoints in one session")
        } else {
            self.too_many_pairs(entry, &endpoint)
        };
        if let Some(why) = refusal {
            let refused = Refused::of(&endpoint, why);
            self.note_refused(id, &refused.text);
            self.push(id, &Message::Refused(refused), Vec::new());
            return Ok(());
        }
        if let Some(entry) = self.sessions.get_mut(id) {
            entry.endpoints.insert(gid);
        }
        if role == EndpointRole::Application {
            self.graph_add_local(&endpoint);
        }
        let local =
            LocalEndpoint { session: *id, endpoint, role, stands_for, only, ring, leaving: false };
        self.index(&local);
        self.endpoints.insert(gid, local);
        self.match_endpoint(&gid);
        Ok(())
    }

    /// Why the pairs of a new endpoint are more than there may be.
    fn too_many_pairs(&self, of: &SessionEntry<F>, endpoint: &Endpoint) -> Option<&'static str> {
        let new = self.prospects(endpoint);
        if of.role != SessionRole::Gateway && of.pairs + new > MAX_PAIRS {
            Some("its session would have too many pairs of publishers and subscriptions")
        } else if self.pairs.len() + new > MAX_ALL_PAIRS {
            Some("there would be too many pairs of publishers and subscriptions")
        } else {
            None
        }
    }

    /// Whether the daemon holds `most` descriptors of a session's memory.
    pub fn holds_as_many_as(&self, id: &SessionId, most: usize) -> bool {
        self.sessions.get(id).is_some_and(|entry| entry.segments.len() >= most)
    }

    /// Keeps the first refusal of a session for the status; it is told all of them.
    pub(super) fn note_refused(&mut self, id: &SessionId, text: &str) {
        if let Some(entry) = self.sessions.get_mut(id)
            && !std::mem::replace(&mut entry.refused, true)
        {
            self.refused.push((*id, text.to_owned()));
        }
    }

    /// The refused endpoints since the last call, the first of each session.
    pub fn take_refused(&mut self) -> Vec<(SessionId, String)> {
        std::mem::take(&mut self.refused)
    }

    fn gone(&mut self, id: &SessionId, gid: Gid) -> Result<(), Violation> {
        match self.endpoints.get(&gid) {
            Some(local) if local.session == *id => {
                if let Some(entry) = self.sessions.get_mut(id) {
                    entry.endpoints.remove(&gid);
                }
                self.remove_endpoint(&gid, "the endpoint is gone");
                Ok(())
            }
            // It ended while there was no daemon. Its peers may still be attached to it, and those
            // that have not come back yet have to hear of it too.
            None if gid.is_of(id) => {
                if self.tombstones.len() == MAX_TOMBSTONES {
                    self.tombstones.pop_front();
                }
                self.tombstones.push_back(gid);
                self.graph_end(gid);
                Ok(())
            }
            // A stand-in that was refused, or that another one took the place of.
            None if self.sessions.get(id).is_some_and(|s| s.role == SessionRole::Gateway) => Ok(()),
            _ => Err(Violation::NotItsOwn(gid)),
        }
    }

    /// An endpoint has ended, or has not after all, and there is more to come of it: its pairs stand,
    /// but nobody counts it, and nobody new is matched with it.
    fn leave(&mut self, id: &SessionId, leave: Leaving) -> Result<(), Violation> {
        let Leaving { gid, leaving } = leave;
        // It may have been refused.
        let Some(local) = self.endpoints.get_mut(&gid) else { return Ok(()) };
        if local.session != *id || !writes(local.endpoint.kind) {
            return Err(Violation::NotItsOwn(gid));
        }
        if std::mem::replace(&mut local.leaving, leaving) == leaving {
            return Ok(());
        }
        if local.role == EndpointRole::Application {
            let endpoint = local.endpoint.clone();
            if leaving {
                self.graph_remove(gid, true);
            } else {
                self.graph_add_local(&endpoint);
            }
        }
        for reader in self.readers_of(&gid) {
            self.push(&reader, &Message::Leaving(leave), Vec::new());
        }
        if !leaving {
            self.match_endpoint(&gid);
        }
        Ok(())
    }

    /// The sessions that read what an endpoint writes.
    fn readers_of(&self, writer: &Gid) -> BTreeSet<SessionId> {
        let Some(local) = self.endpoints.get(writer) else { return BTreeSet::new() };
        let pairs = self.prospective_pairs(&local.endpoint).into_iter();
        let pairs = pairs.filter(|p| p.writer == *writer && self.pairs.contains_key(p));
        pairs.filter_map(|pair| Some(self.endpoints.get(&pair.reader)?.session)).collect()
    }

    fn attach(&mut self, id: &SessionId, attach: Attach) -> Result<(), Violation> {
        if self.endpoints.get(&attach.reader).is_some_and(|r| r.session != *id) {
            return Err(Violation::NotItsOwn(attach.reader));
        }
        let pair = Pair { reader: attach.reader, writer: attach.writer };
        // The pair may have ended while the message was on its way.
        let Some(asked) = self.pairs.get_mut(&pair) else { return Ok(()) };
        let attach = Some(Attach { session: *id, segments: Vec::new(), ..attach });
        // A repetition is not passed on: each session that should know has been told, is about to be,
        // or is behind. Sessions that are told everything anew would otherwise set each other back
        // without end.
        let of = |attach: &Option<Attach>| attach.clone().map(|a| Attach { after: None, ..a });
        if of(&asked.attach) != of(&attach) {
            *asked = PairProgress { attach, stands_for: None, grant: None, by: asked.by };
            self.forward_attach(&pair);
        }
        Ok(())
    }

    /// Tells the writer's session what the reader asked.
    pub(super) fn forward_attach(&mut self, pair: &Pair) {
        let Some(attach) = self.pairs.get(pair).and_then(|p| p.attach.as_ref()) else { return };
        let Some(writer) = self.endpoints.get(&pair.writer) else { return };
        let (mut attach, to) = (attach.clone(), writer.session);
        attach.stands_for = self.stands_for(pair);
        if let Some(asked) = self.pairs.get_mut(pair) {
            asked.stands_for.clone_from(&attach.stands_for);
        }
        let (of, lane) = (attach.session, attach.lane.segment);
        let mut descriptors = self.introduce(&to, &of, pair);
        // The publisher looks at nothing but the lane.
        attach.segments = self.hand_over(&to, &of, [lane], &mut descriptors);
        self.push(&to, &Message::Attach(attach), descriptors);
    }

    fn grant(&mut self, id: &SessionId, grant: Granted) -> Result<(), Violation> {
        if self.endpoints.get(&grant.writer).is_some_and(|w| w.session != *id) {
            return Err(Violation::NotItsOwn(grant.writer));
        }
        let pair = Pair { reader: grant.reader, writer: grant.writer };
        let Some(asked) = self.pairs.get_mut(&pair).filter(|p| p.attach.is_some()) else {
            return Ok(());
        };
        let grant = Some(Granted { session: *id, segments: Vec::new(), ..grant });
        let of = |grant: &Option<Granted>| grant.clone().map(|g| Granted { after: None, ..g });
        if of(&asked.grant) != of(&grant) {
            asked.grant = grant;
            self.forward_grant(&pair);
        }
        Ok(())
    }

    /// Tells the reader's session what the writer granted. Whether there was something to tell.
    pub(super) fn forward_grant(&mut self, pair: &Pair) -> bool {
        let Some(mut grant) = self.pairs.get(pair).and_then(|p| p.grant.clone()) else {
            return false;
        };
        let (Some(reader), true) =
            (self.endpoints.get(&pair.reader), self.endpoints.contains_key(&pair.writer))
        else {
            return false;
        };
        let (to, of) = (reader.session, grant.session);
        let leaving = self.endpoints.get(&pair.writer).is_some_and(|writer| writer.leaving);
        let mut descriptors = self.introduce(&to, &of, pair);
        // The ring's own first: those that do not fit follow.
        let numbers = self.segments_for(&of, &pair.writer);
        let numbers = [grant.ring.segment].into_iter().chain(numbers);
        grant.segments = self.hand_over(&to, &of, numbers, &mut descriptors);
        self.push(&to, &Message::Grant(grant), descriptors);
        self.hand_over_rest(&to, &of, &pair.writer);
        if leaving {
            let leaving = Message::Leaving(Leaving { gid: pair.writer, leaving });
            self.push(&to, &leaving, Vec::new());
        }
        true
    }

    /// A session cannot map what one of its endpoints needs of another's session.
    fn fail(&mut self, id: &SessionId, unmatch: Unmatch) -> Result<(), Violation> {
        let Unmatch { reader, writer, reason } = unmatch;
        let owns = |gid: &Gid| self.endpoints.get(gid).is_some_and(|e| e.session == *id);
        let pair = Pair { reader, writer };
        if !self.pairs.contains_key(&pair) {
            return Ok(());
        }
        let reads = owns(&reader);
        if !reads && !owns(&writer) {
            return Err(Violation::NotItsOwn(reader));
        }
        let topic = self.endpoints.get(&writer).map_or("", |writer| &writer.endpoint.topic);
        let reason = text::plain(&reason, MAX_REASON);
        let text = format!(
            "topic {topic:?}: reader {reader} and publisher {writer} do not meet: {reason}. \
             AXON_SHM=off for the process of one of them has samples pass through the daemon"
        );
        self.note_refused(id, &text);
        // A writer may be asked again.
        if reads { self.detach(id, pair) } else { Ok(()) }
    }

    fn detach(&mut self, id: &SessionId, pair: Pair) -> Result<(), Violation> {
        if self.endpoints.get(&pair.reader).is_some_and(|r| r.session != *id) {
            return Err(Violation::NotItsOwn(pair.reader));
        }
        if !self.remove_pair(&pair) {
            return Ok(());
        }
        if let Some(to) = self.endpoints.get(&pair.writer).map(|w| w.session)
            && to != *id
        {
            self.forget(&to, id, &pair);
            self.push(&to, &Message::Detach(pair), Vec::new());
            self.forget(id, &to, &pair);
        }
        let Pair { reader, writer } = pair;
        let reason = "detached".to_owned();
        self.push(id, &Message::Unmatch(Unmatch { reader, writer, reason }), Vec::new());
        Ok(())
    }

    /// A relay gave up samples of a publisher, whose session is told.
    fn give_up(&mut self, id: &SessionId, given_up: GivenUp) -> Result<(), Violation> {
        let GivenUp { reader, writer, .. } = given_up;
        let relay = self.endpoints.get(&reader).filter(|e| e.role == EndpointRole::Relay);
        if relay.is_some_and(|relay| relay.session != *id) {
            return Err(Violation::NotItsOwn(reader));
        }
        let to = self.endpoints.get(&writer).map(|writer| writer.session);
        if let (Some(to), true) =
            (to, relay.is_some() && self.pairs.contains_key(&Pair { reader, writer }))
        {
            self.push(&to, &Message::GivenUp(given_up), Vec::new());
        }
        Ok(())
    }

    /// The descriptors of `of` when `to` holds none yet, and notes that it does for `pair`.
    fn introduce(&mut self, to: &SessionId, of: &SessionId, pair: &Pair) -> Vec<F> {
        if to == of {
            return Vec::new();
        }
        let Some(descriptors) = self.sessions.get(of).and_then(|s| s.descriptors.clone()) else {
            return Vec::new();
        };
        let Some(entry) = self.sessions.get_mut(to) else { return Vec::new() };
        let held = &mut entry.known.entry(*of).or_default().pairs;
        let first = held.is_empty();
        held.insert(*pair);
        if first { descriptors.into() } else { Vec::new() }
    }

    /// `at` is about to be told that `pair`, for which it held `of`'s descriptors, is over.
    pub(super) fn forget(&mut self, at: &SessionId, of: &SessionId, pair: &Pair) {
        if let Some(entry) = self.sessions.get_mut(at)
            && let Some(held) = entry.known.get_mut(of)
        {
            held.pairs.remove(pair);
            if held.pairs.is_empty() {
                entry.known.remove(of);
            }
        }
    }
}

/// Endpoints of one session. The gateway's are those that it has for its peers, for which it has bounds of its own.
fn most_endpoints(role: SessionRole) -> usize {
    if role == SessionRole::Gateway { GATEWAYS * LIMITS.endpoints } else { LIMITS.endpoints }
}

impl<F> SessionEntry<F> {
    /// Packets that wait for it.
    pub fn queued(&self) -> usize {
        self.queue.len()
    }
}
