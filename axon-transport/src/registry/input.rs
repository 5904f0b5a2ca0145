//! Handles the messages of sessions.

use std::collections::BTreeSet;

use axon_shm::internal::holds;

use super::{
    Registry, Violation, endpoints::LocalEndpoint, limits::MAX_REFUSED, output::PAIRS_TOGETHER,
    relayed::MAX_REASON, sessions::SessionEntry,
};
use crate::{
    access::AccessRules,
    graph::{EndpointKind, LIMITS, Scope, writes},
    ids::{Gid, SessionId},
    text,
    wire::session::{
        Announce, Attach, EndpointRole, Fence, Granted, Pair, RelayGivenUp, SessionMessage,
        SessionRefused, SessionRole, Unmatch, Unmet, WriterLeaving,
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
        // The process of one that comes back lives.
        while self.disconnect_in_parts(&id, true) {}
        self.sessions.insert(id, SessionEntry::new(role, name, pid, descriptors, scope))?;
        self.rescoped |= role == SessionRole::Application;
        Ok(())
    }

    /// A session is of another user than the daemon's. Has to be called before it has endpoints.
    pub fn set_user(&mut self, id: &SessionId, user: u32) {
        self.users.add(user);
        self.sessions.set_user(id, user);
    }

    /// These access rules count from now on. Pairs that they do not allow end, and those that they allow are made.
    pub fn set_access(&mut self, rules: AccessRules) {
        self.users.set_rules(rules);
        let of_users = self.sessions.iter().filter(|(_, entry)| entry.user.is_some());
        let of_users: Vec<_> = of_users.map(|(id, entry)| (*id, entry.endpoints.clone())).collect();
        for (id, endpoints) in of_users {
            self.sessions.request_resync(&id);
            if let Some(entry) = self.sessions.get_mut(&id) {
                entry.refused = false;
            }
            endpoints.iter().for_each(|gid| self.judge(&id, gid));
        }
    }

    /// A session that is gone, and its endpoints with it.
    pub fn handle_disconnect(&mut self, id: &SessionId) {
        while self.handle_disconnect_in_parts(id) {}
    }

    /// As [`handle_disconnect`](Self::handle_disconnect), a part of it; whether there is more to do. The rest of
    /// the session is told nothing any more.
    pub fn handle_disconnect_in_parts(&mut self, id: &SessionId) -> bool {
        self.disconnect_in_parts(id, false)
    }

    /// As [`handle_disconnect_in_parts`](Self::handle_disconnect_in_parts), of a session whose process may live on. What
    /// its readers are handed once that has ended waits for [`handle_process_end`](Self::handle_process_end).
    pub fn handle_hang_up_in_parts(&mut self, id: &SessionId) -> bool {
        self.disconnect_in_parts(id, true)
    }

    /// Whether something of a session that hung up waits for the end of its process.
    pub fn awaits_process(&self, id: &SessionId) -> bool {
        self.sessions.awaits_process(id)
    }

    /// The process of a session that hung up before has ended.
    pub fn handle_process_end(&mut self, id: &SessionId) {
        self.sessions.process_ended(id);
    }

    fn disconnect_in_parts(&mut self, id: &SessionId, lives: bool) -> bool {
        self.sessions.fall_behind(id);
        self.sessions.hand_over_earlier_grants(id, lives);
        let mut pairs = 0;
        while let Some(entry) = self.sessions.get_mut(id) {
            let before = self.pairs.len();
            let Some(gid) = entry.endpoints.pop_first() else {
                self.sessions.remove(id);
                self.rescoped = true;
                return false;
            };
            self.hand_over_grants(id, &gid, lives);
            self.remove_endpoint(&gid, "its session ended");
            pairs += 1 + before - self.pairs.len();
            if pairs >= PAIRS_TOGETHER {
                return true;
            }
        }
        false
    }

    /// The session of a publisher ends: those of its readers that would not hear of its grants are handed them.
    fn hand_over_grants(&mut self, id: &SessionId, gid: &Gid, lives: bool) {
        let Some(writer) = self.endpoints.get(gid) else { return };
        if writer.endpoint.kind != EndpointKind::Publisher || !writer.endpoint.gid.is_of(id) {
            return;
        }
        let pairs = self.pairs.existing(self.endpoints.prospective_pairs(&writer.endpoint));
        let granted = pairs.filter_map(|pair| self.pairs.grant_of(&pair)).filter(|granted| {
            let reader = self.endpoints.session_of(&granted.reader);
            reader.is_some_and(|reader| self.sessions.is_told_anew(&reader))
        });
        let granted: Vec<Granted> = granted.cloned().collect();
        granted.into_iter().for_each(|granted| self.sessions.hand_over_grant(id, granted, lives));
    }

    /// A message of a session.
    ///
    /// # Errors
    /// When no session sends such a message; the caller disconnects it.
    pub fn handle_message(
        &mut self,
        id: &SessionId,
        message: SessionMessage,
        descriptors: Vec<F>,
    ) -> Result<(), Violation> {
        let tool = self.sessions.get(id).is_none_or(|s| s.role == SessionRole::Tool);
        let carries = matches!(message, SessionMessage::Segment(_) | SessionMessage::Unknown(_));
        if !descriptors.is_empty() && !carries {
            return Err(Violation::Descriptors(descriptors.len()));
        }
        match message {
            SessionMessage::Unknown(_) => Ok(()),
            _ if tool => Err(Violation::Unexpected),
            SessionMessage::Endpoint(announce) => self.announce(id, announce),
            SessionMessage::Segment(opened) => {
                let owns = |id: &SessionId, gid: &Gid| self.endpoints.session_of(gid) == Some(*id);
                self.sessions.open_segment(id, opened.segment, descriptors, owns)
            }
            SessionMessage::SegmentGone(gone) => {
                self.sessions.close_segment(id, gone.number);
                Ok(())
            }
            SessionMessage::Need(need) => {
                self.sessions.need_segment(id, &need.session, need.number);
                Ok(())
            }
            SessionMessage::EndpointGone(gone) => self.gone(id, gone.gid),
            SessionMessage::Leaving(leaving) => self.leave(id, leaving),
            SessionMessage::Attach(attach) => self.attach(id, attach),
            SessionMessage::Grant(grant) => self.grant(id, grant),
            SessionMessage::Detach(pair) => self.detach(id, pair),
            SessionMessage::GivenUp(given_up) => self.give_up(id, given_up),
            SessionMessage::Fence(fence) => self.fence(id, fence),
            SessionMessage::Unmet(unmet) => self.unmet(id, unmet),
            SessionMessage::Unmatch(unmatch) => self.fail(id, unmatch),
            SessionMessage::Resync => {
                // Everything costs much more to tell than to ask for.
                self.sessions.request_resync(id);
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
        if let Some(known) = self.endpoints.get(&gid) {
            if known.session != *id || known.role != role {
                return Err(Violation::NotItsOwn(gid));
            }
            if self.endpoints.set_stands_for(&gid, stands_for) {
                self.rematch(&gid);
            }
            return Ok(());
        }
        let refusal = if !endpoint.is_sane() {
            Some("a name, type hash or depth out of bounds".to_owned())
        } else if entry.endpoints.len() >= most_endpoints(entry.role) {
            Some(format!("its session has {} endpoints already", entry.endpoints.len()))
        } else {
            let new = self.endpoints.prospective_pairs(&endpoint).len();
            self.pairs.refusal(id, new, entry.role == SessionRole::Gateway)
        };
        if let Some(why) = refusal {
            let refused = SessionRefused::of(&endpoint, &why);
            self.sessions.note_refused(id, &refused.text);
            if let Some(entry) = self.sessions.get_mut(id)
                && entry.refused_endpoints.len() < MAX_REFUSED
                && endpoint.is_sane()
            {
                entry.refused_endpoints.insert(gid, (endpoint, why));
            }
            self.push(id, &SessionMessage::Refused(refused), Vec::new());
            return Ok(());
        }
        if let Some(entry) = self.sessions.get_mut(id) {
            entry.refused_endpoints.remove(&gid);
            entry.endpoints.insert(gid);
        }
        let denial = self.denial(id, role, &endpoint);
        if let Some(why) = &denial {
            self.note_denied(id, &endpoint, why);
        }
        let denied = denial.is_some();
        if role == EndpointRole::Application && !denied {
            self.graph_add_local(&endpoint);
        }
        let (session, leaving) = (*id, false);
        let local =
            LocalEndpoint { session, endpoint, role, stands_for, only, ring, denied, leaving };
        self.endpoints.insert(local);
        self.match_endpoint(&gid);
        Ok(())
    }

    fn gone(&mut self, id: &SessionId, gid: Gid) -> Result<(), Violation> {
        if gid.is_of(id) {
            self.sessions.forget_earlier_grants(&gid);
        }
        if let Some(entry) = self.sessions.get_mut(id) {
            entry.refused_endpoints.remove(&gid);
        }
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
                self.changes.bury(gid);
                Ok(())
            }
            // A stand-in that was refused, or that another one took the place of.
            None if self.sessions.get(id).is_some_and(|s| s.role == SessionRole::Gateway) => Ok(()),
            _ => Err(Violation::NotItsOwn(gid)),
        }
    }

    /// Handles LEAVING. An endpoint that leaves keeps its pairs until its samples have arrived. It does not count as matched,
    /// and is matched with no further endpoint. LEAVING can also take that back.
    fn leave(&mut self, id: &SessionId, leave: WriterLeaving) -> Result<(), Violation> {
        let WriterLeaving { gid, leaving } = leave;
        // It may have been refused.
        let Some(local) = self.endpoints.get(&gid) else { return Ok(()) };
        if local.session != *id || !writes(local.endpoint.kind) {
            return Err(Violation::NotItsOwn(gid));
        }
        let shown = local.role == EndpointRole::Application && !local.denied;
        let shown = shown.then(|| local.endpoint.clone());
        if !self.endpoints.set_leaving(&gid, leaving) {
            return Ok(());
        }
        if let Some(endpoint) = shown {
            if leaving {
                self.changes.remove(gid, true);
            } else {
                self.graph_add_local(&endpoint);
            }
        }
        let readers = self.endpoints.get(&gid).into_iter().flat_map(|w| self.readers_of(w));
        let readers: BTreeSet<SessionId> = readers.map(|reader| reader.session).collect();
        for reader in readers {
            self.push(&reader, &SessionMessage::Leaving(leave), Vec::new());
        }
        if !leaving {
            self.match_endpoint(&gid);
        }
        Ok(())
    }

    /// The readers of what an endpoint writes.
    fn readers_of(&self, writer: &LocalEndpoint) -> impl Iterator<Item = &LocalEndpoint> {
        let pairs = self.pairs.existing(self.endpoints.prospective_pairs(&writer.endpoint));
        let pairs = pairs.filter(|pair| pair.writer == writer.endpoint.gid);
        pairs.filter_map(|pair| self.endpoints.get(&pair.reader))
    }

    /// A session asks whether those that may lose nothing were sent all about its publisher.
    fn fence(&mut self, id: &SessionId, fence: Fence) -> Result<(), Violation> {
        // It may have been refused.
        let Some(writer) = self.endpoints.get(&fence.writer) else { return Ok(()) };
        if writer.session != *id {
            return Err(Violation::NotItsOwn(fence.writer));
        }
        let readers = self.readers_of(writer).filter(|_| holds(&writer.endpoint.qos));
        let keeping = readers.filter(|reader| holds(&reader.endpoint.qos));
        let keeping: BTreeSet<SessionId> = keeping.map(|reader| reader.session).collect();
        self.fences.ask(*id, fence, keeping.into_iter().collect(), &self.sessions);
        self.answer_fences();
        Ok(())
    }

    /// A publisher ends, and one of its readers never took up what it was granted.
    fn unmet(&mut self, id: &SessionId, unmet: Unmet) -> Result<(), Violation> {
        if !unmet.writer.is_of(id) {
            return Err(Violation::NotItsOwn(unmet.writer));
        }
        self.sessions.tell_unmet(id, unmet);
        Ok(())
    }

    fn attach(&mut self, id: &SessionId, attach: Attach) -> Result<(), Violation> {
        if self.endpoints.is_of_another(&attach.reader, id) {
            return Err(Violation::NotItsOwn(attach.reader));
        }
        let pair = Pair { reader: attach.reader, writer: attach.writer };
        if self.pairs.attach(Attach { session: *id, segments: Vec::new(), ..attach }) {
            self.forward_attach(&pair);
        }
        Ok(())
    }

    /// Tells the writer's session what the reader asked.
    pub(super) fn forward_attach(&mut self, pair: &Pair) {
        let Some(mut attach) = self.pairs.attach_of(pair).cloned() else { return };
        let Some(to) = self.endpoints.session_of(&pair.writer) else { return };
        attach.stands_for = self.stands_for(pair);
        self.pairs.set_told(pair, attach.stands_for.as_ref());
        let (of, lane) = (attach.session, attach.lane.segment);
        let mut descriptors = self.sessions.introduce(&to, &of, pair);
        // The publisher looks at nothing but the lane.
        attach.segments = self.sessions.hand_over(&to, &of, [lane], &mut descriptors);
        self.push(&to, &SessionMessage::Attach(attach), descriptors);
    }

    fn grant(&mut self, id: &SessionId, grant: Granted) -> Result<(), Violation> {
        if self.endpoints.is_of_another(&grant.writer, id) {
            return Err(Violation::NotItsOwn(grant.writer));
        }
        let pair = Pair { reader: grant.reader, writer: grant.writer };
        let grant = Granted { session: *id, segments: Vec::new(), ..grant };
        if self.pairs.attach_of(&pair).is_none() && grant.writer.is_of(id) {
            // The reader has not come back from an earlier daemon.
            self.sessions.add_earlier_grant(id, grant);
        } else if self.pairs.grant(grant) {
            self.sessions.forget_earlier_grant(&pair);
            self.forward_grant(&pair);
        }
        Ok(())
    }

    /// Tells the reader's session what the writer granted. Whether there was something to tell.
    pub(super) fn forward_grant(&mut self, pair: &Pair) -> bool {
        let Some(mut grant) = self.pairs.grant_of(pair).cloned() else { return false };
        let (Some(to), Some(writer)) =
            (self.endpoints.session_of(&pair.reader), self.endpoints.get(&pair.writer))
        else {
            return false;
        };
        let (of, leaving) = (grant.session, writer.leaving);
        let mut descriptors = self.sessions.introduce(&to, &of, pair);
        // The ring's own first: those that do not fit follow.
        let numbers = self.sessions.segments_for(&of, &pair.writer);
        let numbers = [grant.ring.segment].into_iter().chain(numbers);
        grant.segments = self.sessions.hand_over(&to, &of, numbers, &mut descriptors);
        self.push(&to, &SessionMessage::Grant(grant), descriptors);
        self.sessions.hand_over_rest(&to, &of, &pair.writer);
        if leaving {
            let leaving = SessionMessage::Leaving(WriterLeaving { gid: pair.writer, leaving });
            self.push(&to, &leaving, Vec::new());
        }
        true
    }

    /// A session cannot map what one of its endpoints needs of another's session.
    fn fail(&mut self, id: &SessionId, unmatch: Unmatch) -> Result<(), Violation> {
        let Unmatch { reader, writer, reason } = unmatch;
        let owns = |gid: &Gid| self.endpoints.session_of(gid) == Some(*id);
        let pair = Pair { reader, writer };
        if !self.pairs.contains(&pair) {
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
        self.sessions.note_refused(id, &text);
        // A writer may be asked again.
        if reads { self.detach(id, pair) } else { Ok(()) }
    }

    fn detach(&mut self, id: &SessionId, pair: Pair) -> Result<(), Violation> {
        if self.endpoints.is_of_another(&pair.reader, id) {
            return Err(Violation::NotItsOwn(pair.reader));
        }
        if !self.pairs.remove(&pair) {
            return Ok(());
        }
        if let Some(to) = self.endpoints.session_of(&pair.writer)
            && to != *id
        {
            self.sessions.part(&pair, &to, id);
            self.push(&to, &SessionMessage::Detach(pair), Vec::new());
        }
        let Pair { reader, writer } = pair;
        let reason = "detached".to_owned();
        self.push(id, &SessionMessage::Unmatch(Unmatch { reader, writer, reason }), Vec::new());
        Ok(())
    }

    /// A relay gave up samples of a publisher, whose session is told.
    fn give_up(&mut self, id: &SessionId, given_up: RelayGivenUp) -> Result<(), Violation> {
        let RelayGivenUp { reader, writer, .. } = given_up;
        let relay = self.endpoints.get(&reader).filter(|e| e.role == EndpointRole::Relay);
        if relay.is_some_and(|relay| relay.session != *id) {
            return Err(Violation::NotItsOwn(reader));
        }
        let read = relay.is_some() && self.pairs.contains(&Pair { reader, writer });
        if let (Some(to), true) = (self.endpoints.session_of(&writer), read) {
            self.push(&to, &SessionMessage::GivenUp(given_up), Vec::new());
        }
        Ok(())
    }
}

/// Endpoints of one session. The gateway's are those that it has for its peers, for which it has bounds of its own.
fn most_endpoints(role: SessionRole) -> usize {
    if role == SessionRole::Gateway { GATEWAYS * LIMITS.endpoints } else { LIMITS.endpoints }
}
