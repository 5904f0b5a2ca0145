//! Handles the daemon's messages on the control thread.

use std::{collections::HashSet, sync::Arc};

use axon_shm::{
    ShmError,
    internal::{Grant, Location, ReaderInfo, RingPeer, Terms, descriptors::PassedFd},
};

use super::{ControlThread, DaemonConnection, pair_log, peers::PeerError, stands_for};
use crate::{
    graph::{EndpointKind, GraphEntry},
    ids::{Gid, SessionId},
    session::endpoint_state::{Accept, NumberKind, ServeRequest, SubscriptionInner},
    wire::session::{
        Attach, Fence, Granted, MAX_DESCRIPTORS, Pair, RelayGivenUp, Segment, SegmentName,
        SegmentOpened, SessionGraph, SessionMessage, SessionRefused, StatusPart, Unmatch, Unmet,
        WriterLeaving,
    },
};

impl ControlThread {
    pub(super) fn handle(&mut self, message: SessionMessage, descriptors: Vec<PassedFd>) {
        match message {
            SessionMessage::Graph(graph) => self.handle_graph(graph),
            SessionMessage::Match(pair) => self.matched(pair),
            SessionMessage::Attach(attach) => self.attach(attach, descriptors),
            SessionMessage::Grant(grant) => self.grant(grant, descriptors),
            SessionMessage::Detach(pair) => {
                self.pairs.remove(&pair);
                self.peers.release(&pair);
                self.detach_reader(&pair);
            }
            SessionMessage::Unmatch(unmatch) => self.unmatch(&unmatch),
            SessionMessage::Leaving(leaving) => self.leave(leaving),
            SessionMessage::Unmet(unmet) => self.unmet(unmet),
            SessionMessage::GivenUp(given_up) => self.give_up(given_up),
            SessionMessage::Fence(fence) => self.fence(fence),
            SessionMessage::Segment(opened) => self.segment(&opened, &descriptors),
            SessionMessage::SegmentGone(gone) => {
                self.peers.gone(&gone.session, gone.number);
            }
            SessionMessage::Status(part) => self.status(&part),
            SessionMessage::Refused(SessionRefused { endpoint, text: reason, .. }) => {
                // The relayed process itself logs the refusal.
                if !self.shared.core.options.keeps_refusals {
                    tracing::error!(reason, "the daemon refuses something of the session");
                }
                match endpoint {
                    Some(gid) => self.shared.refuse(gid, reason),
                    None => self.shared.keep_refusal(reason),
                }
            }
            // A daemon never sends the other messages. They are ignored.
            _ => {}
        }
    }

    /// Handles a change of the graph, or a part of the full graph.
    fn handle_graph(&mut self, graph: SessionGraph) {
        if graph.whole {
            self.graph.begin_whole();
            self.peers.recount();
            self.pairs.begin_whole();
        }
        self.graph.remove(graph.removed);
        self.graph.add(graph.added.into_iter().map(|item| GraphEntry {
            endpoint: Arc::new(item.endpoint),
            daemon: item.daemon,
            reach: item.reach,
        }));
        self.graph.set_version(graph.version);
        if !graph.more {
            self.graph.end_whole();
        }
        self.endpoints_over(&graph.ended.unwrap_or_default());
        if !graph.more {
            let unrepeated = self.pairs.end_whole();
            let told = unrepeated.is_some();
            if let Some(unrepeated) = unrepeated {
                self.drop_pairs(&unrepeated);
                // The session may have missed an answer while it was too slow.
                self.shared.core.memory.begins_anew();
            }
            self.drop_unread(told);
            self.graph.set_changed();
        }
    }

    fn status(&self, part: &StatusPart) {
        if self.shared.core.link.add_status(part) {
            // Wakes the threads that wait for the whole status.
            self.shared.notify(None);
        }
    }

    /// Removes endpoints that ended, perhaps while no daemon could report their attached endpoints.
    fn endpoints_over(&mut self, gids: &[Gid]) {
        if gids.is_empty() {
            return;
        }
        // Thousands of endpoints may end at a time, each attached to one other.
        let gids: HashSet<Gid> = gids.iter().copied().collect();
        self.pairs.remove_endpoints(&gids);
        let (publishers, subscriptions) = self.shared.state().endpoints.all();
        for publisher in publishers {
            let attached = publisher.granted();
            let ended = attached.iter().filter(|gid| gids.contains(gid));
            let detached = ended.filter(|gid| publisher.detach(**gid));
            let writer = publisher.endpoint.gid;
            let detached = detached.inspect(|gid| {
                pair_log::over(&Pair { reader: **gid, writer }, "the reader ended");
            });
            if detached.count() > 0 {
                self.matches.add_writer(&publisher);
            }
        }
        for subscription in subscriptions {
            let mut matched_readers = subscription.lock();
            let reader = subscription.endpoint.gid;
            let writers = matched_readers.all_writers().into_iter();
            let ended = writers.filter(|gid| gids.contains(gid));
            let ended = ended.filter(|gid| matched_readers.end(gid));
            let ended = ended.inspect(|gid| {
                pair_log::over(&Pair { reader, writer: *gid }, "the writer ended");
            });
            let news = ended.count();
            drop(matched_readers);
            if news > 0 {
                self.matches.add_reader(&subscription);
            }
        }
    }

    /// Records that a writer has ended while samples of it still arrive, or that it has not ended after all.
    fn leave(&mut self, WriterLeaving { gid, leaving }: WriterLeaving) {
        let (_, subscriptions) = self.shared.state().endpoints.all();
        for subscription in subscriptions {
            if subscription.lock().leave(&gid, leaving) {
                self.matches.add_reader(&subscription);
            }
        }
    }

    /// Counts the lost samples of a publisher that ended before this session received the grant for its reader.
    fn unmet(&self, Unmet { reader, writer, samples }: Unmet) {
        let subscription = self.shared.state().endpoints.subscriptions.get(&reader).cloned();
        let Some(subscription) = subscription else { return };
        if subscription.lock().count_unmet(&writer, samples) {
            pair_log::unmet(&Pair { reader, writer }, samples);
            let topic = &subscription.endpoint.topic;
            tracing::warn!(
                topic, %writer, samples,
                "samples are lost: their publisher ended before this process was told of it"
            );
            // Wakes the threads that wait for losses.
            self.shared.core.segment.notify();
        }
    }

    /// Records the samples that a relay of a publisher of this session gave up.
    fn give_up(&self, RelayGivenUp { reader, writer, samples }: RelayGivenUp) {
        let publisher = self.shared.state().endpoints.publishers.get(&writer).cloned();
        if let Some(publisher) = publisher {
            publisher.rings.give_up(reader, samples);
            // Wakes the threads that wait for acknowledgements.
            self.shared.core.segment.notify();
        }
    }

    /// Records that a publisher's fence passed: its readers were sent all earlier messages about the publisher.
    fn fence(&self, Fence { writer, number }: Fence) {
        let publisher = self.shared.state().endpoints.publishers.get(&writer).cloned();
        if let Some(publisher) = publisher {
            publisher.was_sent(number);
            // Wakes the threads that wait for acknowledgements.
            self.shared.core.segment.notify();
        }
    }

    /// Ends the pairs that the daemon announced and did not repeat. They were unmatched while the session was too
    /// slow to be told.
    fn drop_pairs(&mut self, over: &HashSet<Pair>) {
        let (publishers, subscriptions) = self.shared.state().endpoints.all();
        for publisher in publishers {
            let (writer, attached) = (publisher.endpoint.gid, publisher.granted());
            for reader in attached {
                let pair = Pair { reader, writer };
                if over.contains(&pair) && !self.is_own_pair(&pair) && publisher.detach(reader) {
                    pair_log::over(&pair, "the daemon did not repeat it to the writer");
                    self.matches.add_writer(&publisher);
                }
            }
        }
        for subscription in subscriptions {
            let reader = subscription.endpoint.gid;
            let mut matched_readers = subscription.lock();
            let gone = matched_readers
                .writers()
                .into_iter()
                .map(|writer| Pair { reader, writer })
                .filter(|pair| over.contains(pair) && !self.is_own_pair(pair))
                .map(|pair| pair.writer);
            let gone =
                gone.collect::<Vec<_>>().into_iter().filter(|writer| matched_readers.end(writer));
            let gone = gone.inspect(|writer| {
                let pair = Pair { reader, writer: *writer };
                pair_log::over(&pair, "the daemon did not repeat it to the reader");
            });
            let news = gone.count();
            drop(matched_readers);
            if news > 0 {
                self.matches.add_reader(&subscription);
            }
        }
    }

    /// Returns whether both endpoints are the session's own. Such a pair ends as soon as one of the endpoints ends.
    fn is_own_pair(&self, pair: &Pair) -> bool {
        pair.reader.is_of(&self.shared.core.id) && pair.writer.is_of(&self.shared.core.id)
    }

    /// Releases memory of other sessions that no reader here uses any more, if the daemon did not report the end of
    /// that memory. The daemon does not know that the session holds it: the memory was given up while there was no
    /// daemon, or while this session was too slow to be told. If everything was `told` anew, requests the memory that
    /// is still read, so that the daemon will report its end.
    fn drop_unread(&mut self, told: bool) {
        let shared = self.shared.clone();
        let read = |writer: &Gid| {
            let subscriptions: Vec<_> =
                shared.state().endpoints.subscriptions.values().cloned().collect();
            subscriptions.iter().any(|subscription| subscription.lock().reads(writer))
        };
        let unnamed = self.peers.drop_unread(read);
        for (session, number) in unnamed.into_iter().filter(|_| told) {
            self.say(SessionMessage::Need(SegmentName { session, number }));
        }
    }

    fn matched(&mut self, pair: Pair) {
        self.pairs.tell(pair);
        self.ask(&pair);
    }

    /// Asks a writer to serve a reader of this session, or repeats the request.
    fn ask(&mut self, pair: &Pair) {
        let Some(subscription) =
            self.shared.state().endpoints.subscriptions.get(&pair.reader).cloned()
        else {
            return;
        };
        if subscription.ignores_local && pair.writer.is_of(&self.shared.core.id) {
            return;
        }
        let segment = self.shared.core.segment.clone();
        let asking = subscription.lock().lane_for(pair.writer, || segment.allocate_lane());
        self.ask_with(&subscription, pair.writer, asking);
    }

    fn ask_with(
        &mut self,
        subscription: &SubscriptionInner,
        writer: Gid,
        asking: Result<ServeRequest, ShmError>,
    ) {
        match asking {
            Ok(asking) => {
                let message = self.attach_message(subscription, writer, asking);
                self.say(message);
            }
            Err(error) => {
                let topic = &subscription.endpoint.topic;
                tracing::error!(topic, %error, "a publisher cannot be received from");
                // The daemon shows this in its status: in a gateway, the caller that waits for samples is on another
                // host.
                let pair = Pair { reader: subscription.endpoint.gid, writer };
                self.tell_failure(&pair, error.to_string());
            }
        }
    }

    pub(super) fn attach_message(
        &self,
        subscription: &SubscriptionInner,
        writer: Gid,
        ServeRequest { lane, after }: ServeRequest,
    ) -> SessionMessage {
        SessionMessage::Attach(Attach {
            reader: subscription.endpoint.gid,
            writer,
            lane,
            qos: subscription.qos,
            session: self.shared.core.id,
            stands_for: stands_for(subscription),
            segments: Vec::new(),
            // Numbers that do not rise do not show which samples came before.
            after: after.filter(|_| subscription.rising),
            carries: subscription.carries.then_some(true),
        })
    }

    fn attach(&mut self, attach: Attach, descriptors: Vec<PassedFd>) {
        let pair = Pair { reader: attach.reader, writer: attach.writer };
        self.pairs.tell(pair);
        // The pair counts even if it is not attached, as in the daemon.
        let peer = self.hold(attach.session, pair, descriptors, &attach.segments);
        let shared = self.shared.clone();
        let own = attach.session == shared.core.id;
        // If both endpoints are the session's own, neither may end between the check and the grant.
        let own_pairs = own.then(|| shared.lock_own_pairs());
        let Some(publisher) = self.shared.state().endpoints.publishers.get(&attach.writer).cloned()
        else {
            return;
        };
        if own && !self.has_lane(&pair, attach.lane) {
            return;
        }
        // Before the reader is served: samples published for it from then on wait until its grant is sent.
        self.shared.core.memory.hands_over();
        let grant = peer.map_err(|e| e.to_string()).and_then(|peer| {
            let Attach { reader: gid, lane, qos, stands_for, after, carries, .. } = attach;
            let reader = ReaderInfo { gid, lane, qos, peer, stands_for };
            let terms = Terms { after, carries: carries == Some(true) };
            publisher.attach(reader, terms).map_err(|e| e.to_string())
        });
        drop(own_pairs);
        match grant {
            Ok((Grant { generation, first }, after, ring)) => {
                let Pair { reader, writer } = pair;
                pair_log::granted(&pair, generation, first);
                let session = self.shared.core.id;
                let segments = Vec::new();
                let after = Some(after);
                let relayed = publisher.relayed.then_some(true);
                let grant = Granted {
                    reader,
                    writer,
                    generation,
                    first,
                    session,
                    ring,
                    segments,
                    after,
                    relayed,
                };
                self.say(SessionMessage::Grant(grant));
                self.matches.add_writer(&publisher);
            }
            Err(error) => {
                let topic = &publisher.endpoint.topic;
                tracing::error!(topic, reader = %pair.reader, error, "a reader is not served");
                self.tell_failure(&pair, error);
            }
        }
    }

    /// Reports to the daemon why a pair that it matched is not attached. The daemon shows the reason.
    fn tell_failure(&mut self, pair: &Pair, reason: String) {
        let Pair { reader, writer } = *pair;
        self.say(SessionMessage::Unmatch(Unmatch { reader, writer, reason }));
    }

    fn grant(&mut self, granted: Granted, descriptors: Vec<PassedFd>) {
        let Granted { reader, writer, generation, first, session, ring, segments, .. } = granted;
        let Granted { after, relayed, .. } = granted;
        let pair = Pair { reader, writer };
        self.pairs.tell(pair);
        // A full packet does not name all segments.
        let all = descriptors.len() < MAX_DESCRIPTORS;
        let peer = self.hold(session, pair, descriptors, &segments);
        if all {
            self.peers.drop_unnamed(&session, writer);
        }
        let shared = self.shared.clone();
        let own = session == shared.core.id;
        let own_pairs = own.then(|| shared.lock_own_pairs());
        let Some(subscription) = self.shared.state().endpoints.subscriptions.get(&reader).cloned()
        else {
            return;
        };
        if own && !self.has_ring(&writer, ring) {
            return;
        }
        let grant = Grant { generation, first };
        let mut matched_readers = subscription.lock();
        let lane = match matched_readers.accept(writer, grant) {
            Accept::Stands => return,
            Accept::AskAgain => {
                pair_log::forgotten(&pair);
                // Under the same lock: the earlier lane is still in use, so this is another lane. The request is
                // therefore not a repetition, which the daemon would not pass on.
                let segment = &self.shared.core.segment;
                let asking = matched_readers.lane_for(writer, || segment.allocate_lane());
                drop(matched_readers);
                return self.ask_with(&subscription, writer, asking);
            }
            Accept::Map(lane) => lane,
        };
        drop(matched_readers);
        let mapped = peer.map_err(|e| e.to_string()).and_then(|peer| {
            let most = shared.core.config.max_message;
            subscription.map(writer, peer, ring, lane, grant, most).map_err(|e| e.to_string())
        });
        match mapped {
            Ok(mapped) => {
                pair_log::accepted(&pair, generation, first);
                let stands_in = !writer.is_of(&session) || relayed == Some(true);
                let linked = matches!(self.link, DaemonConnection::Socket(_));
                let numbers = match subscription.endpoint.kind {
                    EndpointKind::Subscription if stands_in && linked => NumberKind::All,
                    // In a relayed process, later losses on the way are reported explicitly.
                    EndpointKind::Subscription if stands_in => NumberKind::Between,
                    _ if subscription.keeps_all() => NumberKind::Since,
                    _ => NumberKind::None,
                };
                subscription.lock().add(mapped, after, numbers);
                drop(own_pairs);
                self.matches.add_reader(&subscription);
                // The subscription may have history of the writer to take.
                self.shared.core.segment.notify();
            }
            Err(error) => {
                drop(own_pairs);
                let topic = &subscription.endpoint.topic;
                tracing::error!(topic, %writer, error, "a publisher cannot be received from");
                self.tell_failure(&pair, error);
            }
        }
    }

    fn hold(
        &mut self,
        session: SessionId,
        pair: Pair,
        descriptors: Vec<PassedFd>,
        segments: &[Segment],
    ) -> Result<RingPeer, PeerError> {
        let held = self.peers.hold(session, pair, descriptors, segments);
        if matches!(held, Err(PeerError::Missing)) {
            // The daemon assumes that the session holds descriptors that it lacks. A resync starts over.
            self.outbox.push_back((SessionMessage::Resync, Vec::new()));
        }
        if !segments.is_empty() {
            // Wakes the threads that wait for data in the segments.
            self.shared.core.segment.notify();
        }
        held
    }

    /// Returns whether a subscription of this session has that lane for the writer. The daemon's message gives the
    /// locations of lanes and rings. Without this check, it could name the bytes of one of this session's samples.
    fn has_lane(&self, pair: &Pair, lane: Location) -> bool {
        let subscription = self.shared.state().endpoints.subscriptions.get(&pair.reader).cloned();
        // The subscription may have ended, with its lanes, since its request.
        let Some(subscription) = subscription else { return false };
        let has = subscription.lock().lanes().contains(&(pair.writer, lane));
        if !has {
            tracing::error!(
                reader = %pair.reader,
                "ignored an attachment: it names a lane that this session does not have"
            );
        }
        has
    }

    /// Returns whether a publisher of this session has that ring.
    fn has_ring(&self, writer: &Gid, ring: Location) -> bool {
        let publisher = self.shared.state().endpoints.publishers.get(writer).cloned();
        let Some(publisher) = publisher else { return false };
        let has = publisher.rings.has(ring);
        if !has {
            tracing::error!(%writer, "ignored a grant: it names a ring that this session does not have");
        }
        has
    }

    fn segment(&mut self, opened: &SegmentOpened, descriptors: &[PassedFd]) {
        if let [descriptor] = descriptors {
            self.peers.opened(&opened.session, opened.segment, descriptor);
            // Wakes the threads that wait for data in the segment.
            self.shared.core.segment.notify();
        }
    }

    fn unmatch(&mut self, unmatch: &Unmatch) {
        let Unmatch { reader, writer, reason } = unmatch;
        let pair = Pair { reader: *reader, writer: *writer };
        self.pairs.remove(&pair);
        self.peers.release(&pair);
        self.detach_reader(&pair);
        let subscription = self.shared.state().endpoints.subscriptions.get(reader).cloned();
        if let Some(subscription) = subscription {
            if subscription.lock().end(writer) {
                pair_log::over(&pair, reason);
                self.matches.add_reader(&subscription);
            }
            let topic = &subscription.endpoint.topic;
            tracing::debug!(topic, %writer, reason, "a publisher is not received from");
        }
    }

    fn detach_reader(&mut self, pair: &Pair) {
        let publisher = self.shared.state().endpoints.publishers.get(&pair.writer).cloned();
        if let Some(publisher) = publisher.filter(|p| p.detach(pair.reader)) {
            pair_log::over(pair, "the daemon said so to the writer");
            self.matches.add_writer(&publisher);
        }
        if self.shared.core.segment.tidy_some() {
            self.memory.check_later();
        }
    }
}
