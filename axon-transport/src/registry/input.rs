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

/// Factor by which the gateway may have more endpoints than another session.
const GATEWAYS: usize = 4;

impl<F: Clone> Registry<F> {
    /// Adds a session whose HELLO was accepted. It will be sent the whole graph, as far as its `scope` permits. Without
    /// a `scope`, ranges do not apply to it.
    ///
    /// # Errors
    /// There are too many sessions.
    pub fn handle_connect(
        &mut self,
        id: SessionId,
        role: SessionRole,
        name: String,
        pid: u32,
        descriptors: Option<[F; 3]>,
        scope: Option<Scope>,
    ) -> Result<(), Violation> {
        // If the session comes back, its process still lives.
        while self.disconnect_in_parts(&id, true) {}
        self.sessions.insert(id, SessionEntry::new(role, name, pid, descriptors, scope))?;
        self.rescoped |= role == SessionRole::Application;
        Ok(())
    }

    /// Records that a session belongs to another user than the daemon's. Must be called before it has endpoints.
    pub fn set_user(&mut self, id: &SessionId, user: u32) {
        self.users.add(user);
        self.sessions.set_user(id, user);
    }

    /// Applies these access rules from now on. Ends pairs that they do not allow, and makes pairs that they allow.
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

    /// Removes a session that is gone, and its endpoints.
    pub fn handle_disconnect(&mut self, id: &SessionId) {
        while self.handle_disconnect_in_parts(id) {}
    }

    /// Like [`handle_disconnect`](Self::handle_disconnect), but does only a part. Returns whether there is more to do.
    /// In the meantime the session is sent nothing.
    pub fn handle_disconnect_in_parts(&mut self, id: &SessionId) -> bool {
        self.disconnect_in_parts(id, false)
    }

    /// Like [`handle_disconnect_in_parts`](Self::handle_disconnect_in_parts), for a session whose process may live on.
    /// Grants that its readers get after the process's end wait for [`handle_process_end`](Self::handle_process_end).
    pub fn handle_hang_up_in_parts(&mut self, id: &SessionId) -> bool {
        self.disconnect_in_parts(id, true)
    }

    /// Returns whether packets of a session that hung up wait for the end of its process.
    pub fn awaits_process(&self, id: &SessionId) -> bool {
        self.sessions.awaits_process(id)
    }

    /// Handles the end of the process of a session that hung up before.
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

    /// Passes the grants of an ending publisher to those of its readers that would not be sent them otherwise.
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

    /// Handles a message of a session.
    ///
    /// # Errors
    /// No session sends such a message; the caller must disconnect the session.
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
                // The complete state costs much more to send than to request.
                self.sessions.request_resync(id);
                Ok(())
            }
            _ => Err(Violation::Unexpected),
        }
    }

    fn announce(&mut self, id: &SessionId, announce: Announce) -> Result<(), Violation> {
        let Announce { endpoint, role, stands_for, ring, only } = announce;
        let gid = endpoint.gid;
        // A server has a ring for each of its clients, which GRANT names.
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
            // The endpoint ended while there was no daemon. Its peers may still be attached to it, and sessions that
            // have not come back yet must be told of it, too.
            None if gid.is_of(id) => {
                self.changes.bury(gid);
                Ok(())
            }
            // A stand-in that was refused, or whose GID another endpoint took over.
            None if self.sessions.get(id).is_some_and(|s| s.role == SessionRole::Gateway) => Ok(()),
            _ => Err(Violation::NotItsOwn(gid)),
        }
    }

    /// Handles LEAVING. An endpoint that leaves keeps its pairs until its samples have arrived. It does not count as
    /// matched, and gets no further pairs. LEAVING can also be taken back.
    fn leave(&mut self, id: &SessionId, leave: WriterLeaving) -> Result<(), Violation> {
        let WriterLeaving { gid, leaving } = leave;
        // The endpoint may have been refused.
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

    /// Returns the readers of an endpoint's messages.
    fn readers_of(&self, writer: &LocalEndpoint) -> impl Iterator<Item = &LocalEndpoint> {
        let pairs = self.pairs.existing(self.endpoints.prospective_pairs(&writer.endpoint));
        let pairs = pairs.filter(|pair| pair.writer == writer.endpoint.gid);
        pairs.filter_map(|pair| self.endpoints.get(&pair.reader))
    }

    /// Handles FENCE: a session asks whether the readers that must lose nothing were sent everything about its
    /// publisher.
    fn fence(&mut self, id: &SessionId, fence: Fence) -> Result<(), Violation> {
        // The publisher may have been refused.
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

    /// Handles UNMET: a publisher ends, and one of its readers never took up its grant.
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

    /// Passes the reader's ATTACH to the writer's session.
    pub(super) fn forward_attach(&mut self, pair: &Pair) {
        let Some(mut attach) = self.pairs.attach_of(pair).cloned() else { return };
        let Some(to) = self.endpoints.session_of(&pair.writer) else { return };
        attach.stands_for = self.stands_for(pair);
        self.pairs.set_told(pair, attach.stands_for.as_ref());
        let (of, lane) = (attach.session, attach.lane.segment);
        let mut descriptors = self.sessions.introduce(&to, &of, pair);
        // The publisher accesses only the lane.
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
            // The reader has not come back from an earlier daemon yet.
            self.sessions.add_earlier_grant(id, grant);
        } else if self.pairs.grant(grant) {
            self.sessions.forget_earlier_grant(&pair);
            self.forward_grant(&pair);
        }
        Ok(())
    }

    /// Passes the writer's grant to the reader's session. Returns false if there is none.
    pub(super) fn forward_grant(&mut self, pair: &Pair) -> bool {
        let Some(mut grant) = self.pairs.grant_of(pair).cloned() else { return false };
        let (Some(to), Some(writer)) =
            (self.endpoints.session_of(&pair.reader), self.endpoints.get(&pair.writer))
        else {
            return false;
        };
        let (of, leaving) = (grant.session, writer.leaving);
        let mut descriptors = self.sessions.introduce(&to, &of, pair);
        // The ring's own segment comes first. Segments that do not fit follow.
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

    /// Handles a failure: a session cannot map memory of another session that one of its endpoints needs.
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
        // If the writer's side failed, the pair stays: the reader may ask it again.
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

    /// Passes on to the publisher's session that a relay gave up samples.
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

/// Returns the most endpoints of one session. The gateway's endpoints stand for those of its peers, and the gateway
/// limits them per peer.
fn most_endpoints(role: SessionRole) -> usize {
    if role == SessionRole::Gateway { GATEWAYS * LIMITS.endpoints } else { LIMITS.endpoints }
}
