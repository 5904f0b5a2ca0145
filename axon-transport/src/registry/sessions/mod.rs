//! The sessions, the packets that wait for each, and the memory of others that each holds.
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
    /// Those that got something to be told.
    ready: BTreeSet<SessionId>,
    /// The first endpoint of each session that was refused, and why.
    refused: Vec<(SessionId, String)>,
    /// What they left to readers that are not here.
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

    /// From now on keeps segments of sessions that end, `most` at a time.
    pub(super) fn keep_left_memory(&mut self, most: usize) {
        self.left.keep_memory(most);
    }

    /// Whether segments of sessions that end are kept.
    pub(super) fn keeps_left_memory(&self) -> bool {
        self.left.keeps_memory()
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
    pub(super) fn push(&mut self, to: &SessionId, message: &SessionMessage, descriptors: Vec<F>) {
        // It is told everything anew.
        if self.entries.get(to).is_none_or(|entry| entry.outbox.is_behind()) {
            return;
        }
        if let Some(output) = SessionPacket::of(message, descriptors) {
            self.push_output(to, output);
        }
    }

    /// A session turns out to be of another user than the daemon's. It is told nothing that is kept for readers of the
    /// same session id.
    pub(super) fn set_user(&mut self, id: &SessionId, user: u32) {
        if let Some(entry) = self.entries.get_mut(id) {
            entry.user = Some(user);
            let kept = entry.outbox.take_kept();
            kept.into_iter().for_each(|output| self.left.keep(output));
        }
    }

    /// Tells a reader's session of a pair that was never made. If it is not here, it is told when it comes.
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
        // With some of them memory is handed over. An id proves nothing: a tool, or another user, may claim a reader's.
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

    /// The session of an endpoint that need not have been announced: GIDs begin as their session's id does.
    fn session_of(&self, gid: &Gid) -> Option<SessionId> {
        let mut ends = [SessionId([0; 16]), SessionId([u8::MAX; 16])];
        ends.iter_mut().for_each(|id| id.0[..12].copy_from_slice(&gid.0[..12]));
        let [first, last] = ends;
        self.entries.range(first..=last).next().map(|(id, _)| *id)
    }

    /// A publisher granted this by way of an earlier daemon.
    pub(super) fn add_earlier_grant(&mut self, by: &SessionId, granted: Granted) {
        let process = self.process_of(by);
        self.left.add_earlier_grant(granted, process);
    }

    fn process_of(&self, id: &SessionId) -> u32 {
        self.entries.get(id).map_or(0, |entry| entry.pid)
    }

    /// A reader is granted something else, or was told that it gets nothing.
    pub(super) fn forget_earlier_grant(&mut self, pair: &Pair) {
        self.left.forget_earlier_grant(pair);
    }

    /// A publisher has ended, and said what its readers lost.
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

    /// The next packet that waits for a session.
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
        self.push(id, &SessionMessage::Refused(SessionRefused::because(text)), Vec::new());
    }

    /// A session ends. Hands its earlier grants to the readers. Called before its pairs end.
    pub(super) fn hand_over_earlier_grants(&mut self, id: &SessionId, lives: bool) {
        let grants = self.left.take_earlier_grants(id);
        grants.into_iter().for_each(|granted| self.hand_over_grant(id, granted, lives));
    }

    /// Hands what a session that ends granted to a reader, and its ring. If its process still `lives`, this waits for the
    /// process's end: the session may come back, and the ring may be written.
    pub(super) fn hand_over_grant(&mut self, id: &SessionId, granted: Granted, lives: bool) {
        let Some(entry) = self.entries.get(id) else { return };
        // The memory of a relayed session is the daemon's, which outlives it.
        let lives = lives && entry.relay.is_none();
        for output in packets_of_grant(entry, granted) {
            if lives {
                self.left.hold_back(output, *id);
            } else {
                self.push_kept(output);
            }
        }
    }

    /// Whether something waits for the end of a session's process.
    pub(super) fn awaits_process(&self, id: &SessionId) -> bool {
        self.left.awaits_process(id)
    }

    /// The process of a session that ended before has ended, too.
    pub(super) fn process_ended(&mut self, id: &SessionId) {
        self.left.take_awaiting(id).into_iter().for_each(|output| self.push_kept(output));
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
        let gone = SessionMessage::SegmentGone(SegmentName { session: *id, number });
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
        let Some(RegisteredSegment { segment, descriptor }) =
            there.or_else(|| self.left.segment(of, number)).cloned()
        else {
            return;
        };
        let opened = SegmentOpened { session: *of, segment };
        self.push(id, &SessionMessage::Segment(opened), vec![descriptor]);
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
            if let Some(RegisteredSegment { segment, descriptor }) =
                self.take_if_missing(to, of, number)
            {
                handed.push(segment);
                descriptors.push(descriptor);
            }
        }
        handed
    }

    /// Hands over the segments that the packet had no room for.
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

    /// Marks a segment of `of` as handed to `to`, and returns it. `None`: `to` has it.
    fn take_if_missing(
        &mut self,
        to: &SessionId,
        of: &SessionId,
        number: u32,
    ) -> Option<RegisteredSegment<F>> {
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
pub(super) fn encode(message: &SessionMessage) -> Option<Arc<[u8]>> {
    match message.encode() {
        Ok(packet) => Some(packet.into()),
        Err(error) => {
            // Everything that is stored is small enough to be passed on.
            tracing::error!(%error, "a control message could not be encoded");
            None
        }
    }
}
