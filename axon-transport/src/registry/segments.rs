//! The segments of sessions' memory, and the sessions that receive each of them.
//!
//! A session that reads from another session receives its segments with objects, and the segments with samples of
//! the publishers that it reads from. It receives existing segments with the message that introduces the two
//! sessions, and later segments when they are opened. If a segment is missing nevertheless, the session asks for it.

use super::{MAX_SEGMENTS, Registry, SessionSegment, Violation};
use crate::{
    ids::{Gid, SessionId},
    wire::session::{MAX_DESCRIPTORS, Message, Refused, Segment, SegmentName, SegmentOpened},
};

impl<F: Clone> Registry<F> {
    /// A session has one segment more.
    pub(super) fn open_segment(
        &mut self,
        id: &SessionId,
        segment: Segment,
        mut descriptors: Vec<F>,
    ) -> Result<(), Violation> {
        let (Some(descriptor), true) = (descriptors.pop(), descriptors.is_empty()) else {
            return Err(Violation::Descriptors(descriptors.len()));
        };
        let Some(entry) = self.sessions.get_mut(id) else { return Ok(()) };
        let number = segment.number;
        if number == 0 || entry.segments.contains_key(&number) {
            return Err(Violation::Segments(number));
        }
        if entry.segments.len() >= MAX_SEGMENTS {
            self.refuse_segment(id, &format!("a session has {MAX_SEGMENTS}"));
            return Ok(());
        }
        entry.segments.insert(number, SessionSegment { segment, descriptor });
        let readers: Vec<SessionId> = self
            .sessions
            .iter()
            .filter(|(_, s)| s.known.contains_key(id))
            .map(|(reader, _)| *reader)
            .filter(|reader| self.reads(reader, id, &segment))
            .collect();
        for reader in readers {
            self.hand(&reader, id, number);
        }
        Ok(())
    }

    /// A segment of a session's memory is not taken, since `there_are` as many as may be. The session
    /// goes on, and is told once until it gives another one up.
    pub fn refuse_segment(&mut self, id: &SessionId, there_are: &str) {
        let Some(entry) = self.sessions.get_mut(id) else { return };
        if std::mem::replace(&mut entry.short, true) {
            return;
        }
        let text = format!(
            "more memory of it: {there_are}. Other processes do not see the samples in it: have \
             fewer publishers of samples over 4 KiB in one process"
        );
        self.note_refused(id, &text);
        self.push(id, &Message::Refused(Refused::because(text)), Vec::new());
    }

    /// A session has given a segment up.
    pub(super) fn close_segment(&mut self, id: &SessionId, number: u32) {
        let Some(entry) = self.sessions.get_mut(id) else { return };
        if entry.segments.remove(&number).is_none() {
            return;
        }
        entry.short = false;
        let gone = Message::SegmentGone(SegmentName { session: *id, number });
        let mut readers = Vec::new();
        for (reader, entry) in &mut self.sessions {
            if let Some(known) = entry.known.get_mut(id)
                && known.segments.remove(&number)
            {
                readers.push((*reader, known.asked.remove(&number)));
            }
        }
        // A session that has not taken it, as that of a stopped process, need not hear of it, nor keep its memory. One
        // that asked for it may have it from before, and then keeps it until it hears.
        readers.retain(|(reader, asked)| !self.take_back(reader, id, number) || *asked);
        let readers: Vec<_> = readers.into_iter().map(|(reader, _)| reader).collect();
        self.push_shared(&readers, &gone);
    }

    /// A session misses a segment of another, which it reads from.
    pub(super) fn need_segment(&mut self, id: &SessionId, of: &SessionId, number: u32) {
        let known = self.sessions.get_mut(id).and_then(|entry| entry.known.get_mut(of));
        let Some(known) = known else { return self.hand_left(id, of, number) };
        known.segments.remove(&number);
        self.hand(id, of, number);
        if let Some(known) = self.sessions.get_mut(id).and_then(|entry| entry.known.get_mut(of))
            && known.segments.contains(&number)
        {
            known.asked.insert(number);
        }
    }

    /// The segments of session `of` in which a reader of `writer` looks.
    pub(super) fn segments_for(&self, of: &SessionId, writer: &Gid) -> Vec<u32> {
        let Some(entry) = self.sessions.get(of) else { return Vec::new() };
        let concerns = |s: &&SessionSegment<F>| s.segment.publisher.is_none_or(|p| p == *writer);
        entry.segments.values().filter(concerns).map(|s| s.segment.number).collect()
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
        let segment = self.sessions.get(of)?.segments.get(&number)?.clone();
        let known = self.sessions.get_mut(to)?.known.get_mut(of)?;
        known.segments.insert(number).then_some(segment)
    }

    /// Whether a session reads from another what is in this segment of its memory.
    fn reads(&self, reader: &SessionId, of: &SessionId, segment: &Segment) -> bool {
        let Some(known) = self.sessions.get(reader).and_then(|s| s.known.get(of)) else {
            return false;
        };
        let owns = |gid: &Gid| self.endpoints.get(gid).is_some_and(|e| e.session == *reader);
        known
            .pairs
            .iter()
            .filter(|pair| owns(&pair.reader))
            .any(|pair| segment.publisher.is_none_or(|publisher| publisher == pair.writer))
    }
}
