//! The sessions, the packets that wait for each, and the memory of others that each holds.
//!
//! A session that reads from another session receives its segments with objects, and the segments with samples of
//! the publishers that it reads from. It receives existing segments with the message that introduces the two
//! sessions, and later segments when they are opened. If a segment is missing nevertheless, the session asks for it.

mod left;
mod memory;
mod outbox;

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Arc,
};

pub(super) use self::outbox::Due;
use self::{
    left::{LeftMemory, LeftNews, Pledges},
    memory::{HeldMemory, NotTaken},
    outbox::{Outbox, Pushed},
};
pub use self::{
    memory::{OwnMemory, SessionSegment},
    outbox::Output,
};
use super::{
    limits::{MAX_SEGMENTS, MAX_SESSIONS, Violation},
    relayed::RelayCounters,
};
use crate::{
    config::DiscoveryRange,
    graph::{Endpoint, EndpointRange, RangeToHost, Scope},
    ids::{DaemonId, Gid, SessionId},
    wire::session::{
        Granted, MAX_DESCRIPTORS, Message, Pair, Refused, Segment, SegmentName, SegmentOpened,
        SessionRole, Unmatch, Unmet,
    },
};

/// A session as the registry knows it.
#[derive(Debug)]
pub struct SessionEntry<F> {
    /// What kind it is.
    pub role: SessionRole,
    /// Its process's name.
    pub name: String,
    /// Its process.
    pub pid: u32,
    /// Its user, where that is another than the daemon's.
    pub user: Option<u32>,
    /// How far it is discovered; `None` of the gateway, and of all in a registry within a process.
    pub scope: Option<Scope>,
    /// Daemons of the linked peers that it lists.
    pub lists: BTreeSet<DaemonId>,
    /// Its endpoints.
    pub endpoints: BTreeSet<Gid>,
    /// Segment, doorbell and pidfd; a tool has none, nor has a session that nobody can meet.
    pub descriptors: Option<[F; 3]>,
    /// The segments of its memory besides the first.
    pub segments: OwnMemory<F>,
    /// What is shown of its relay, where it is relayed. Pairs within it are its own process's.
    pub relay: Option<Arc<RelayCounters>>,
    /// What waits for it.
    pub(super) outbox: Outbox<F>,
    /// The memory of other sessions whose descriptors it holds.
    pub(super) held: HeldMemory,
    /// An endpoint of its was refused.
    pub(super) refused: bool,
    /// The first of its endpoints that were refused, and why.
    pub(super) refused_endpoints: BTreeMap<Gid, (Endpoint, String)>,
}

impl<F> SessionEntry<F> {
    pub(super) fn new(
        role: SessionRole,
        name: String,
        pid: u32,
        descriptors: Option<[F; 3]>,
        scope: Option<Scope>,
    ) -> Self {
        Self {
            role,
            name,
            pid,
            user: None,
            scope,
            lists: BTreeSet::new(),
            endpoints: BTreeSet::new(),
            descriptors,
            segments: OwnMemory::default(),
            relay: None,
            // There is no graph that a tool could be behind with.
            outbox: Outbox::new(role != SessionRole::Tool),
            held: HeldMemory::default(),
            refused: false,
            refused_endpoints: BTreeMap::new(),
        }
    }

    /// Packets that wait for it.
    pub fn queued(&self) -> usize {
        self.outbox.len()
    }

    /// The first of its endpoints that were refused, and why.
    pub fn refused_endpoints(&self) -> impl Iterator<Item = (&Endpoint, &str)> {
        self.refused_endpoints.values().map(|(endpoint, why)| (endpoint, &**why))
    }

    /// Of how many sessions it holds memory.
    pub fn holds_memory_of(&self) -> usize {
        self.held.len()
    }

    /// Its range, and the daemons of linked peers that it lists; `None` where ranges do not apply.
    pub(super) fn reach(&self) -> Option<EndpointRange> {
        let scope = self.scope.as_ref()?;
        Some(EndpointRange { range: scope.range, lists: self.lists.iter().copied().collect() })
    }

    pub(super) fn toward(&self, peer: &DaemonId) -> Option<RangeToHost> {
        let scope = self.scope.as_ref()?;
        Some(RangeToHost { range: scope.range, lists: self.lists.contains(peer) })
    }

    pub(super) fn is_off(&self) -> bool {
        self.scope.as_ref().is_some_and(|scope| scope.range == DiscoveryRange::Off)
    }
}

/// All sessions.
#[derive(Debug)]
pub(super) struct Sessions<F> {
    entries: BTreeMap<SessionId, SessionEntry<F>>,
    /// Those that got something to be told.
    ready: BTreeSet<SessionId>,
    /// The first endpoint of each session that was refused, and why.
    refused: Vec<(SessionId, String)>,
    /// Memory of those that ended.
    left: LeftMemory<F>,
    /// What is for readers whose sessions are not here.
    news: LeftNews<F>,
    pledges: Pledges,
}

impl<F> Default for Sessions<F> {
    fn default() -> Self {
        Self {
            entries: BTreeMap::new(),
            ready: BTreeSet::new(),
            refused: Vec::new(),
            left: LeftMemory::default(),
            news: LeftNews::default(),
            pledges: Pledges::default(),
        }
    }
}

impl<F> Sessions<F> {
    pub(super) fn iter(&self) -> impl Iterator<Item = (&SessionId, &SessionEntry<F>)> {
        self.entries.iter()
    }

    pub(super) fn get(&self, id: &SessionId) -> Option<&SessionEntry<F>> {
        self.entries.get(id)
    }

    pub(super) fn get_mut(&mut self, id: &SessionId) -> Option<&mut SessionEntry<F>> {
        self.entries.get_mut(id)
    }

    /// A session came. It is told everything.
    ///
    /// # Errors
    /// When there are too many.
    pub(super) fn insert(
        &mut self,
        id: SessionId,
        entry: SessionEntry<F>,
    ) -> Result<(), Violation> {
        if self.entries.len() >= MAX_SESSIONS {
            return Err(Violation::Sessions);
        }
        let tool = entry.role == SessionRole::Tool;
        self.left.forget(&id);
        self.entries.insert(id, entry);
        if !tool {
            self.fall_behind(&id);
            self.news.take(&id).into_iter().for_each(|output| self.push_kept(output));
        }
        Ok(())
    }

    pub(super) fn remove(&mut self, id: &SessionId) {
        if let Some(entry) = self.entries.remove(id) {
            self.left.keep(*id, entry.segments);
            // It may come back.
            entry.outbox.into_kept().for_each(|output| self.news.keep(output));
        }
        self.ready.remove(id);
    }

    /// From now on keeps segments of sessions that end, `most` at a time.
    pub(super) fn keep_left_memory(&mut self, most: usize) {
        self.left = LeftMemory::new(most);
    }

    /// Whether segments of sessions that end are kept.
    pub(super) fn keeps_left_memory(&self) -> bool {
        self.left.is_kept()
    }

    /// Sessions that got something to be told since the last call.
    pub(super) fn take_ready(&mut self) -> BTreeSet<SessionId> {
        std::mem::take(&mut self.ready)
    }

    /// Drops what waits for a session; it is told everything anew.
    pub(super) fn fall_behind(&mut self, id: &SessionId) {
        if let Some(entry) = self.entries.get_mut(id) {
            entry.outbox.fall_behind();
            self.ready.insert(*id);
        }
    }

    /// A session asked to be told everything anew, or is shown another part of the graph now.
    pub(super) fn request_resync(&mut self, id: &SessionId) {
        if let Some(entry) = self.entries.get_mut(id) {
            entry.outbox.request_resync();
            self.ready.insert(*id);
        }
    }

    /// Links changed: `listed` tells which linked peers a list of static peers names. Returns the sessions that list
    /// other peers now.
    pub(super) fn relist(
        &mut self,
        listed: impl Fn(&[String]) -> BTreeSet<DaemonId>,
    ) -> Vec<SessionId> {
        let mut changed = Vec::new();
        for (id, entry) in &mut self.entries {
            let Some(scope) = &entry.scope else { continue };
            let now = if scope.static_peers.is_empty() {
                BTreeSet::new()
            } else {
                listed(&scope.static_peers)
            };
            if entry.lists != now {
                entry.lists = now;
                changed.push(*id);
            }
        }
        // What they are shown of the graph is another part.
        changed.iter().for_each(|id| self.request_resync(id));
        changed
    }

    /// Keeps the first refusal of a session for the status; it is told all of them.
    pub(super) fn note_refused(&mut self, id: &SessionId, text: &str) {
        if let Some(entry) = self.entries.get_mut(id)
            && !std::mem::replace(&mut entry.refused, true)
        {
            self.refused.push((*id, text.to_owned()));
        }
    }

    /// The refusals since the last call, the first of each session.
    pub(super) fn take_refused(&mut self) -> Vec<(SessionId, String)> {
        std::mem::take(&mut self.refused)
    }

    /// Queues a message for one session.
    pub(super) fn push(&mut self, to: &SessionId, message: &Message, descriptors: Vec<F>) {
        // It is told everything anew.
        if self.entries.get(to).is_none_or(|entry| entry.outbox.is_behind()) {
            return;
        }
        if let Some(output) = Output::of(message, descriptors) {
            self.push_output(to, output);
        }
    }

    /// A session turns out to be of another user than the daemon's. It is told nothing that is kept for readers of the
    /// same session id.
    pub(super) fn set_user(&mut self, id: &SessionId, user: u32) {
        if let Some(entry) = self.entries.get_mut(id) {
            entry.user = Some(user);
            let kept = entry.outbox.take_kept();
            kept.into_iter().for_each(|output| self.news.keep(output));
        }
    }

    /// Tells a reader's session of a pair that was never made. If it is not here, it is told when it comes.
    pub(super) fn tell_unmet(&mut self, unmet: Unmet) {
        self.forget_pledge(&Pair { reader: unmet.reader, writer: unmet.writer });
        let output = Output::kept(&Message::Unmet(unmet), Vec::new(), unmet.reader);
        output.into_iter().for_each(|output| self.push_kept(output));
    }

    fn push_kept(&mut self, output: Output<F>) {
        let Some(reader) = output.kept_for else { return };
        let to = self.session_of(&reader);
        // With some of them memory is handed over. An id proves nothing: a tool, or another user, may claim a reader's.
        let takes =
            |entry: &&mut SessionEntry<F>| entry.role != SessionRole::Tool && entry.user.is_none();
        match to.and_then(|id| Some((id, self.entries.get_mut(&id).filter(takes)?))) {
            None => self.news.keep(output),
            Some((id, entry)) => {
                if entry.outbox.push_kept(output) {
                    self.ready.insert(id);
                }
            }
        }
    }

    /// The session of an endpoint that need not have been announced: GIDs begin as their session's id does.
    fn session_of(&self, gid: &Gid) -> Option<SessionId> {
        let mut ends = [SessionId([0; 16]), SessionId([u8::MAX; 16])];
        ends.iter_mut().for_each(|id| id.0[..12].copy_from_slice(&gid.0[..12]));
        let [first, last] = ends;
        self.entries.range(first..=last).next().map(|(id, _)| *id)
    }

    /// A publisher granted this by way of an earlier daemon.
    pub(super) fn pledge(&mut self, granted: Granted) {
        self.pledges.note(granted);
    }

    /// A reader is granted something else, or was told that it gets nothing.
    pub(super) fn forget_pledge(&mut self, pair: &Pair) {
        self.pledges.forget(|of| (of.reader, of.writer) == (pair.reader, pair.writer));
    }

    /// A publisher has ended, and said what its readers lost.
    pub(super) fn forget_pledges(&mut self, writer: &Gid) {
        self.pledges.forget(|granted| granted.writer == *writer);
    }

    /// Queues a packet for several sessions, which share its memory.
    pub(super) fn push_encoded(&mut self, to: &[SessionId], packet: &Arc<[u8]>) {
        for id in to {
            self.push_output(id, Output::plain(Arc::clone(packet)));
        }
    }

    fn push_output(&mut self, to: &SessionId, output: Output<F>) {
        let Some(entry) = self.entries.get_mut(to) else { return };
        match entry.outbox.push(output) {
            Pushed::Queued => {
                self.ready.insert(*to);
            }
            Pushed::Full => self.fall_behind(to),
            Pushed::Behind => {}
        }
    }

    /// The next packet that waits for a session.
    pub(super) fn pop(&mut self, id: &SessionId) -> Option<Output<F>> {
        self.entries.get_mut(id)?.outbox.pop()
    }

    pub(super) fn put_back(&mut self, id: &SessionId, output: Output<F>) {
        if let Some(entry) = self.entries.get_mut(id) {
            entry.outbox.put_back(output);
        }
    }

    pub(super) fn tell_status(&mut self, id: &SessionId, text: Arc<[u8]>) {
        if let Some(entry) = self.entries.get_mut(id) {
            entry.outbox.tell_status(text);
            self.ready.insert(*id);
        }
    }

    pub(super) fn repeat_status(&mut self, id: &SessionId) -> bool {
        self.entries.get_mut(id).is_some_and(|entry| entry.outbox.repeat_status())
    }
}

impl<F: Clone> Sessions<F> {
    /// A session has one segment more. `owns` tells whether an endpoint is of a session.
    pub(super) fn open_segment(
        &mut self,
        id: &SessionId,
        segment: Segment,
        mut descriptors: Vec<F>,
        owns: impl Fn(&SessionId, &Gid) -> bool,
    ) -> Result<(), Violation> {
        let (Some(descriptor), true) = (descriptors.pop(), descriptors.is_empty()) else {
            return Err(Violation::Descriptors(descriptors.len()));
        };
        let Some(entry) = self.entries.get_mut(id) else { return Ok(()) };
        let number = segment.number;
        match entry.segments.open(segment, descriptor) {
            Ok(()) => {}
            Err(NotTaken::Number) => return Err(Violation::Segments(number)),
            Err(NotTaken::Full) => {
                self.refuse_segment(id, &format!("a session has {}", MAX_SEGMENTS));
                return Ok(());
            }
        }
        let reads = |reader: &SessionId, entry: &SessionEntry<F>| {
            let mut pairs = entry.held.pairs_with(id).filter(|pair| owns(reader, &pair.reader));
            pairs.any(|pair| segment.publisher.is_none_or(|publisher| publisher == pair.writer))
        };
        let readers = self.entries.iter().filter(|(reader, entry)| reads(reader, entry));
        let readers: Vec<SessionId> = readers.map(|(reader, _)| *reader).collect();
        for reader in readers {
            self.hand(&reader, id, number);
        }
        Ok(())
    }

    /// A segment of a session's memory is not taken, since `there_are` as many as may be. The session
    /// goes on, and is told once until it gives another one up.
    pub(super) fn refuse_segment(&mut self, id: &SessionId, there_are: &str) {
        let Some(entry) = self.entries.get_mut(id) else { return };
        if !entry.segments.note_short() {
            return;
        }
        let text = format!(
            "more memory of it: {there_are}. Other processes do not see the samples in it: have \
             fewer publishers of samples over 4 KiB in one process"
        );
        self.note_refused(id, &text);
        self.push(id, &Message::Refused(Refused::because(text)), Vec::new());
    }

    /// A session ends. Hands what it pledged to the readers, who find in the rings what there was for them: all of what
    /// is in the session's own segments, and the number of what is not. Called before its pairs end.
    pub(super) fn hand_over_pledges(&mut self, id: &SessionId) {
        let pledged = self.pledges.take(id);
        pledged.into_iter().for_each(|granted| self.hand_over_grant(id, granted));
    }

    /// Hands what a session that ends granted to a reader, and its ring.
    pub(super) fn hand_over_grant(&mut self, id: &SessionId, granted: Granted) {
        // What another user may give to readers here, the access rules say, and these may have changed.
        let Some(entry) = self.entries.get(id).filter(|entry| entry.user.is_none()) else { return };
        let Some(descriptors) = entry.descriptors.clone() else { return };
        let mut descriptors = Vec::from(descriptors);
        let own = entry.segments.iter().filter(|of| of.segment.publisher.is_none());
        let (ring, others): (Vec<_>, Vec<_>) =
            own.partition(|of| of.segment.number == granted.ring.segment);
        let own = ring.into_iter().chain(others).take(MAX_DESCRIPTORS - descriptors.len());
        let (segments, maps): (Vec<_>, Vec<_>) =
            own.map(|of| (of.segment, of.descriptor.clone())).unzip();
        descriptors.extend(maps);
        let Granted { reader, writer, .. } = granted;
        let grant = Message::Grant(Granted { segments, ..granted });
        let end = Unmatch { reader, writer, reason: "its session ended".to_owned() };
        let grant = Output::kept(&grant, descriptors, reader);
        let end = Output::kept(&Message::Unmatch(end), Vec::new(), reader);
        grant.into_iter().chain(end).for_each(|output| self.push_kept(output));
    }

    /// Whether a reader's session is told everything anew, and so not what was granted before.
    pub(super) fn is_told_anew(&self, id: &SessionId) -> bool {
        self.entries.get(id).is_some_and(|entry| entry.outbox.mark().is_none())
    }

    /// A session has given a segment up.
    pub(super) fn close_segment(&mut self, id: &SessionId, number: u32) {
        if !self.entries.get_mut(id).is_some_and(|entry| entry.segments.close(number)) {
            return;
        }
        let mut told = Vec::new();
        for (reader, entry) in &mut self.entries {
            let Some(asked) = entry.held.close(id, number) else { continue };
            // A session that has not taken it, as that of a stopped process, need not hear of it, nor keep its memory.
            // One that asked for it may have it from before, and then keeps it until it hears.
            if !entry.outbox.take_back(id, number) || asked {
                told.push(*reader);
            }
        }
        let gone = Message::SegmentGone(SegmentName { session: *id, number });
        if let Some(packet) = encode(&gone) {
            self.push_encoded(&told, &packet);
        }
    }

    /// A session misses a segment of another, which it reads from.
    pub(super) fn need_segment(&mut self, id: &SessionId, of: &SessionId, number: u32) {
        if !self.entries.get_mut(id).is_some_and(|entry| entry.held.miss(of, number)) {
            return self.hand_left(id, of, number);
        }
        self.hand(id, of, number);
        if let Some(entry) = self.entries.get_mut(id) {
            entry.held.note_asked(of, number);
        }
    }

    /// A session that this daemon has not introduced to `of` misses a segment of that session: it knows it from an
    /// earlier daemon.
    fn hand_left(&mut self, id: &SessionId, of: &SessionId, number: u32) {
        if !self.keeps_left_memory() {
            return;
        }
        let there = self.entries.get(of).and_then(|entry| entry.segments.get(number));
        let Some(SessionSegment { segment, descriptor }) =
            there.or_else(|| self.left.segment(of, number)).cloned()
        else {
            return;
        };
        let opened = SegmentOpened { session: *of, segment };
        self.push(id, &Message::Segment(opened), vec![descriptor]);
    }

    /// The segments of session `of` in which a reader of `writer` looks.
    pub(super) fn segments_for(&self, of: &SessionId, writer: &Gid) -> Vec<u32> {
        self.entries.get(of).map(|entry| entry.segments.numbers_for(writer)).unwrap_or_default()
    }

    /// Adds the descriptors of those segments that `to` lacks, as many as go into one packet.
    pub(super) fn hand_over(
        &mut self,
        to: &SessionId,
        of: &SessionId,
        numbers: impl IntoIterator<Item = u32>,
        descriptors: &mut Vec<F>,
    ) -> Vec<Segment> {
        let mut handed = Vec::new();
        for number in numbers {
            if descriptors.len() == MAX_DESCRIPTORS {
                break;
            }
            if let Some(SessionSegment { segment, descriptor }) = self.lacking(to, of, number) {
                handed.push(segment);
                descriptors.push(descriptor);
            }
        }
        handed
    }

    /// Hands over those that did not go into the packet.
    pub(super) fn hand_over_rest(&mut self, to: &SessionId, of: &SessionId, writer: &Gid) {
        for number in self.segments_for(of, writer) {
            self.hand(to, of, number);
        }
    }

    fn hand(&mut self, to: &SessionId, of: &SessionId, number: u32) {
        if let Some(SessionSegment { segment, descriptor }) = self.lacking(to, of, number) {
            let opened = SegmentOpened { session: *of, segment };
            self.push(to, &Message::Segment(opened), vec![descriptor]);
        }
    }

    /// A segment of `of` that `to` was not handed, and now is.
    fn lacking(
        &mut self,
        to: &SessionId,
        of: &SessionId,
        number: u32,
    ) -> Option<SessionSegment<F>> {
        let segment = self.entries.get(of)?.segments.get(number)?.clone();
        self.entries.get_mut(to)?.held.hand(of, number).then_some(segment)
    }

    /// The descriptors of `of` when `to` holds none yet, and notes that it does for `pair`.
    pub(super) fn introduce(&mut self, to: &SessionId, of: &SessionId, pair: &Pair) -> Vec<F> {
        if to == of {
            return Vec::new();
        }
        let Some(descriptors) = self.entries.get(of).and_then(|s| s.descriptors.clone()) else {
            return Vec::new();
        };
        let Some(entry) = self.entries.get_mut(to) else { return Vec::new() };
        if entry.held.introduce(*of, *pair) { descriptors.into() } else { Vec::new() }
    }

    /// Two sessions are about to be told that `pair`, for which they held each other's descriptors, is over.
    pub(super) fn part(&mut self, pair: &Pair, one: &SessionId, other: &SessionId) {
        for (at, of) in [(one, other), (other, one)] {
            if let Some(entry) = self.entries.get_mut(at) {
                entry.held.forget(of, pair);
            }
        }
    }
}

/// The packet of a message.
pub(super) fn encode(message: &Message) -> Option<Arc<[u8]>> {
    match message.encode() {
        Ok(packet) => Some(packet.into()),
        Err(error) => {
            // Everything that is stored is small enough to be passed on.
            tracing::error!(%error, "a control message could not be encoded");
            None
        }
    }
}
