//! The sessions, the packets that wait for each, and the memory of other sessions that each holds.
//!
//! A session that reads from another session receives its segments with objects, and the segments with samples of
//! the publishers that it reads from. It receives existing segments with the message that introduces the two
//! sessions, and later segments when they are opened. If a segment is missing nevertheless, the session asks for it.

mod entry;
mod memory;
mod outbox;
mod retained;
mod shares;

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Arc,
};

pub(super) use self::outbox::DueMessage;
pub use self::{
    entry::SessionEntry,
    memory::{OwnMemory, RegisteredSegment},
    outbox::SessionPacket,
};
use self::{
    memory::NotTaken,
    outbox::Pushed,
    retained::{RetainedState, packets_of_grant},
};
use super::limits::{MAX_SEGMENTS, MAX_SESSIONS, Violation};
use crate::{
    ids::{DaemonId, Gid, SessionId},
    wire::session::{
        Granted, MAX_DESCRIPTORS, Pair, Segment, SegmentName, SegmentOpened, SessionMessage,
        SessionRefused, SessionRole, Unmet,
    },
};

/// All sessions.
#[derive(Debug)]
pub(super) struct Sessions<F> {
    entries: BTreeMap<SessionId, SessionEntry<F>>,
    /// The sessions that got something to send.
    ready: BTreeSet<SessionId>,
    /// The first refusal of each session.
    refused: Vec<(SessionId, String)>,
    /// What sessions left for readers that are not connected.
    left: RetainedState<F>,
}

impl<F> Default for Sessions<F> {
    fn default() -> Self {
        Self {
            entries: BTreeMap::new(),
            ready: BTreeSet::new(),
            refused: Vec::new(),
            left: RetainedState::default(),
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

    /// Adds a session, which will be sent the complete state.
    ///
    /// # Errors
    /// There are too many sessions.
    pub(super) fn insert(
        &mut self,
        id: SessionId,
        entry: SessionEntry<F>,
    ) -> Result<(), Violation> {
        if self.entries.len() >= MAX_SESSIONS {
            return Err(Violation::Sessions);
        }
        let tool = entry.role == SessionRole::Tool;
        self.left.session_came(&id);
        self.entries.insert(id, entry);
        if !tool {
            self.fall_behind(&id);
            self.left.take_for(&id).into_iter().for_each(|output| self.push_kept(output));
        }
        Ok(())
    }

    pub(super) fn remove(&mut self, id: &SessionId) {
        if let Some(entry) = self.entries.remove(id) {
            self.left.session_ended(*id, entry.segments, entry.outbox.into_kept());
        }
        self.ready.remove(id);
    }

    /// Keeps up to `most` segments of sessions that end from now on.
    pub(super) fn keep_left_memory(&mut self, most: usize) {
        self.left.keep_memory(most);
    }

    /// Returns whether segments of sessions that end are kept.
    pub(super) fn keeps_left_memory(&self) -> bool {
        self.left.keeps_memory()
    }

    /// Takes the sessions that got something to send since the last call.
    pub(super) fn take_ready(&mut self) -> BTreeSet<SessionId> {
        std::mem::take(&mut self.ready)
    }

    /// Drops the packets that wait for a session, except for kept ones. It is sent the complete state instead.
    pub(super) fn fall_behind(&mut self, id: &SessionId) {
        if let Some(entry) = self.entries.get_mut(id) {
            entry.outbox.fall_behind();
            self.ready.insert(*id);
        }
    }

    /// Sends the complete state to a session that asked for it, or whose view of the graph changed.
    pub(super) fn request_resync(&mut self, id: &SessionId) {
        if let Some(entry) = self.entries.get_mut(id) {
            entry.outbox.request_resync();
            self.ready.insert(*id);
        }
    }

    /// Handles changed links: `listed` returns the linked peers that a list of static peers names. Returns the sessions
    /// that now list other peers.
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
        // Their view of the graph changed.
        changed.iter().for_each(|id| self.request_resync(id));
        changed
    }

    /// Keeps the first refusal of a session for the status. The session itself is told of all.
    pub(super) fn note_refused(&mut self, id: &SessionId, text: &str) {
        if let Some(entry) = self.entries.get_mut(id)
            && !std::mem::replace(&mut entry.refused, true)
        {
            self.refused.push((*id, text.to_owned()));
        }
    }

    /// Takes the refusals since the last call, the first of each session.
    pub(super) fn take_refused(&mut self) -> Vec<(SessionId, String)> {
        std::mem::take(&mut self.refused)
    }

    /// Queues a message for one session.
    pub(super) fn push(&mut self, to: &SessionId, message: &SessionMessage, descriptors: Vec<F>) {
        // It will be sent the complete state.
        if self.entries.get(to).is_none_or(|entry| entry.outbox.is_behind()) {
            return;
        }
        if let Some(output) = SessionPacket::of(message, descriptors) {
            self.push_output(to, output);
        }
    }

    /// Records that a session belongs to another user than the daemon's. It does not get packets that are kept for
    /// readers with its session id.
    pub(super) fn set_user(&mut self, id: &SessionId, user: u32) {
        if let Some(entry) = self.entries.get_mut(id) {
            entry.user = Some(user);
            let kept = entry.outbox.take_kept();
            kept.into_iter().for_each(|output| self.left.keep(output));
        }
    }

    /// Tells a reader's session of a pair that never came about. If the session is not connected, it is told later.
    pub(super) fn tell_unmet(&mut self, by: &SessionId, unmet: Unmet) {
        self.forget_earlier_grant(&Pair { reader: unmet.reader, writer: unmet.writer });
        let process = self.process_of(by);
        let output =
            SessionPacket::kept(&SessionMessage::Unmet(unmet), Vec::new(), unmet.reader, process);
        output.into_iter().for_each(|output| self.push_kept(output));
    }

    fn push_kept(&mut self, output: SessionPacket<F>) {
        let Some(reader) = output.kept_for else { return };
        let to = self.session_of(&reader);
        // Some of the packets pass memory on. An id proves nothing: a tool, or another user, may claim the id of a
        // reader's session.
        let takes =
            |entry: &&mut SessionEntry<F>| entry.role != SessionRole::Tool && entry.user.is_none();
        match to.and_then(|id| Some((id, self.entries.get_mut(&id).filter(takes)?))) {
            None => self.left.keep(output),
            Some((id, entry)) => {
                entry.outbox.push_kept(output);
                self.ready.insert(id);
            }
        }
    }

    /// Returns the session of an endpoint that need not be announced: a GID begins like its session's id.
    fn session_of(&self, gid: &Gid) -> Option<SessionId> {
        let mut ends = [SessionId([0; 16]), SessionId([u8::MAX; 16])];
        ends.iter_mut().for_each(|id| id.0[..12].copy_from_slice(&gid.0[..12]));
        let [first, last] = ends;
        self.entries.range(first..=last).next().map(|(id, _)| *id)
    }

    /// Adds a grant that a publisher made through an earlier daemon.
    pub(super) fn add_earlier_grant(&mut self, by: &SessionId, granted: Granted) {
        let process = self.process_of(by);
        self.left.add_earlier_grant(granted, process);
    }

    fn process_of(&self, id: &SessionId) -> u32 {
        self.entries.get(id).map_or(0, |entry| entry.pid)
    }

    /// Removes the earlier grant of a reader that got another one, or was told that it gets nothing.
    pub(super) fn forget_earlier_grant(&mut self, pair: &Pair) {
        self.left.forget_earlier_grant(pair);
    }

    /// Removes the earlier grants of a publisher that has ended and reported its readers' losses.
    pub(super) fn forget_earlier_grants(&mut self, writer: &Gid) {
        self.left.forget_earlier_grants(writer);
    }

    /// Queues a packet for several sessions, which share its memory.
    pub(super) fn push_encoded(&mut self, to: &[SessionId], packet: &Arc<[u8]>) {
        for id in to {
            self.push_output(id, SessionPacket::plain(Arc::clone(packet)));
        }
    }

    fn push_output(&mut self, to: &SessionId, output: SessionPacket<F>) {
        let Some(entry) = self.entries.get_mut(to) else { return };
        match entry.outbox.push(output) {
            Pushed::Queued => {
                self.ready.insert(*to);
            }
            Pushed::Full => self.fall_behind(to),
            Pushed::Behind => {}
        }
    }

    /// Takes the next packet for a session.
    pub(super) fn pop(&mut self, id: &SessionId) -> Option<SessionPacket<F>> {
        self.entries.get_mut(id)?.outbox.pop()
    }

    pub(super) fn put_back(&mut self, id: &SessionId, output: SessionPacket<F>) {
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
    /// Adds a segment of a session. `owns` returns whether an endpoint belongs to a session.
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

    /// Refuses a segment of a session's memory, because `there_are` as many as permitted. The session goes on. It is
    /// told once, until it gives up another segment.
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
        self.push(id, &SessionMessage::Refused(SessionRefused::because(text)), Vec::new());
    }

    /// Passes the earlier grants of a session that ends to the readers. Called before its pairs end.
    pub(super) fn hand_over_earlier_grants(&mut self, id: &SessionId, lives: bool) {
        let grants = self.left.take_earlier_grants(id);
        grants.into_iter().for_each(|granted| self.hand_over_grant(id, granted, lives));
    }

    /// Passes the grant of a session that ends to a reader, with the ring. If the session's process still `lives`, this
    /// waits for the process's end: the session may come back, and may still write the ring.
    pub(super) fn hand_over_grant(&mut self, id: &SessionId, granted: Granted, lives: bool) {
        let Some(entry) = self.entries.get(id) else { return };
        // The daemon has the memory of a relayed session, and keeps it after the session's end.
        let lives = lives && entry.relay.is_none();
        for output in packets_of_grant(entry, granted) {
            if lives {
                self.left.hold_back(output, *id);
            } else {
                self.push_kept(output);
            }
        }
    }

    /// Returns whether packets wait for the end of a session's process.
    pub(super) fn awaits_process(&self, id: &SessionId) -> bool {
        self.left.awaits_process(id)
    }

    /// Handles the end of the process of a session that ended before.
    pub(super) fn process_ended(&mut self, id: &SessionId) {
        self.left.take_awaiting(id).into_iter().for_each(|output| self.push_kept(output));
    }

    /// Returns whether a reader's session is sent the complete state, which does not contain earlier grants.
    pub(super) fn is_told_anew(&self, id: &SessionId) -> bool {
        self.entries.get(id).is_some_and(|entry| entry.outbox.mark().is_none())
    }

    /// Removes a segment that a session has given up.
    pub(super) fn close_segment(&mut self, id: &SessionId, number: u32) {
        if !self.entries.get_mut(id).is_some_and(|entry| entry.segments.close(number)) {
            return;
        }
        let mut told = Vec::new();
        for (reader, entry) in &mut self.entries {
            let Some(asked) = entry.held.close(id, number) else { continue };
            // A session that has not taken the segment yet (its process may be stopped) need not be told, and need not
            // get the memory. A session that asked for it may have it from before, and keeps it until it is told.
            if !entry.outbox.take_back(id, number) || asked {
                told.push(*reader);
            }
        }
        let gone = SessionMessage::SegmentGone(SegmentName { session: *id, number });
        if let Some(packet) = encode(&gone) {
            self.push_encoded(&told, &packet);
        }
    }

    /// Sends a segment that a session misses. The session reads from the segment's owner.
    pub(super) fn need_segment(&mut self, id: &SessionId, of: &SessionId, number: u32) {
        if !self.entries.get_mut(id).is_some_and(|entry| entry.held.miss(of, number)) {
            return self.hand_left(id, of, number);
        }
        self.hand(id, of, number);
        if let Some(entry) = self.entries.get_mut(id) {
            entry.held.note_asked(of, number);
        }
    }

    /// Sends a segment to a session that this daemon has not introduced to `of`: the session knows the segment from an
    /// earlier daemon.
    fn hand_left(&mut self, id: &SessionId, of: &SessionId, number: u32) {
        if !self.keeps_left_memory() {
            return;
        }
        let there = self.entries.get(of).and_then(|entry| entry.segments.get(number));
        let Some(RegisteredSegment { segment, descriptor }) =
            there.or_else(|| self.left.segment(of, number)).cloned()
        else {
            return;
        };
        let opened = SegmentOpened { session: *of, segment };
        self.push(id, &SessionMessage::Segment(opened), vec![descriptor]);
    }

    /// Returns the numbers of the segments of session `of` that a reader of `writer` may access.
    pub(super) fn segments_for(&self, of: &SessionId, writer: &Gid) -> Vec<u32> {
        self.entries.get(of).map(|entry| entry.segments.numbers_for(writer)).unwrap_or_default()
    }

    /// Adds the descriptors of those segments that `to` lacks, as many as fit in one packet.
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
            if let Some(RegisteredSegment { segment, descriptor }) =
                self.take_if_missing(to, of, number)
            {
                handed.push(segment);
                descriptors.push(descriptor);
            }
        }
        handed
    }

    /// Sends the segments for which the packet had no room.
    pub(super) fn hand_over_rest(&mut self, to: &SessionId, of: &SessionId, writer: &Gid) {
        for number in self.segments_for(of, writer) {
            self.hand(to, of, number);
        }
    }

    fn hand(&mut self, to: &SessionId, of: &SessionId, number: u32) {
        if let Some(RegisteredSegment { segment, descriptor }) =
            self.take_if_missing(to, of, number)
        {
            let opened = SegmentOpened { session: *of, segment };
            self.push(to, &SessionMessage::Segment(opened), vec![descriptor]);
        }
    }

    /// Marks a segment of `of` as sent to `to`, and returns it; `None` if `to` has it.
    fn take_if_missing(
        &mut self,
        to: &SessionId,
        of: &SessionId,
        number: u32,
    ) -> Option<RegisteredSegment<F>> {
        let segment = self.entries.get(of)?.segments.get(number)?.clone();
        self.entries.get_mut(to)?.held.hand(of, number).then_some(segment)
    }

    /// Returns the descriptors of `of` if `to` holds none yet, and records that `to` holds them for `pair`.
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

    /// Records for two sessions that `pair`, for which they held each other's descriptors, ends.
    pub(super) fn part(&mut self, pair: &Pair, one: &SessionId, other: &SessionId) {
        for (at, of) in [(one, other), (other, one)] {
            if let Some(entry) = self.entries.get_mut(at) {
                entry.held.forget(of, pair);
            }
        }
    }
}

/// Encodes a message as a packet.
pub(super) fn encode(message: &SessionMessage) -> Option<Arc<[u8]>> {
    match message.encode() {
        Ok(packet) => Some(packet.into()),
        Err(error) => {
            // Everything that the registry stores is small enough for a packet.
            tracing::error!(%error, "a control message could not be encoded");
            None
        }
    }
}
