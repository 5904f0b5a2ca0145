//! Sessions that read many rings and look only at a few.

use super::*;

/// A publisher and its reader in another session.
struct Topic {
    from: SessionId,
    number: u32,
    writer: Writer,
    reader: Reader,
}

impl Topic {
    fn pair(&self) -> (Gid, Gid) {
        (Gid::new(self.from, self.number), self.writer.gid())
    }

    fn publish(&self, sequence: u64) {
        self.writer.publish(meta(sequence), b"sample").unwrap();
    }
}

/// Creates topics of `of` that `from` reads, as a relay or for itself.
fn topics(
    of: &Arc<SessionSegment>,
    from: &Arc<SessionSegment>,
    numbers: std::ops::Range<u32>,
    relays: bool,
) -> Vec<Topic> {
    topics_with(of, from, numbers, relays, |_| {})
}

/// Like [`topics`]; calls `prepare` for each publisher before it gets a reader.
fn topics_with(
    of: &Arc<SessionSegment>,
    from: &Arc<SessionSegment>,
    numbers: std::ops::Range<u32>,
    relays: bool,
    prepare: impl Fn(&Writer),
) -> Vec<Topic> {
    let (there, back) = (peer(from, of), peer(of, from));
    let topic = |number| {
        let (gid, qos) = (Gid::new(of.id(), number), keep_last(1));
        let options = RingOptions { gid, qos, budget: 0, max_message: MAX, expected: 0 };
        let writer = Writer::create(of.clone(), options).unwrap();
        prepare(&writer);
        let (lane, reader) = (from.allocate_lane().unwrap(), Gid::new(from.id(), number));
        let at = lane.location();
        let stands_for = relays.then(|| vec![Gid([7; 16])]);
        let info = ReaderInfo { gid: reader, lane: at, qos, peer: back.clone(), stands_for };
        let grant = writer.attach(info).unwrap();
        let options = ReaderOptions {
            reader,
            writer: gid,
            peer: there.clone(),
            ring: writer.location(),
            lane,
            grant,
            qos,
            max_message: MAX,
        };
        let mut mapped = Reader::map(options).unwrap();
        mapped.follow(reader);
        Topic { from: from.id(), number, writer, reader: mapped }
    };
    numbers.map(topic).collect()
}

fn active(session: &SessionSegment) -> Vec<(Gid, Gid)> {
    let mut found = Vec::new();
    session.take_active(&mut found);
    found
}

/// Number of readers that a look includes in turn, besides the readers with samples.
const IN_TURN: usize = 2;

#[test]
fn a_sample_costs_a_look_at_its_reader_however_many_readers_there_are() {
    for count in [1, 100, 10_000] {
        let (of, from) = (session(), session());
        from.follow();
        let topics = topics(&of, &from, 1..count + 1, true);
        assert_eq!(active(&from).len(), topics.len(), "those that have just come");
        assert!(active(&from).len() <= IN_TURN, "then nothing but a few in turn");
        for (sequence, topic) in (1..=50).zip(topics.iter().cycle()) {
            topic.publish(sequence);
            let found = active(&from);
            assert!(found.contains(&topic.pair()) && found.len() <= 1 + IN_TURN, "{found:?}");
        }
        // After a burst, each ring is looked at once.
        (51..=60).for_each(|sequence| topics[0].publish(sequence));
        assert!(active(&from).len() <= 1 + IN_TURN);
    }
}

#[test]
fn samples_that_overtook_the_journal_are_found() {
    let (of, from) = (session(), session());
    from.follow();
    let topics = topics(&of, &from, 1..4, true);
    active(&from);
    topics[2].publish(1);
    (1..=layout::JOURNAL as u64).for_each(|sequence| topics[0].publish(sequence));
    assert!(active(&from).contains(&topics[2].pair()));
}

#[test]
fn readers_are_checked_in_turn_independently_of_the_journal() {
    let (of, from) = (session(), session());
    from.follow();
    let topics = topics(&of, &from, 1..10, true);
    active(&from);
    let mut found = Vec::new();
    (0..topics.len().div_ceil(IN_TURN)).for_each(|_| from.take_active(&mut found));
    assert!(topics.iter().all(|topic| found.contains(&topic.pair())));
}

#[test]
fn a_journal_that_its_session_corrupts_costs_a_look_at_its_rings_alone() {
    let (of, other, from) = (session(), session(), session());
    from.follow();
    let all = topics(&of, &from, 1..101, true);
    let rest = topics(&other, &from, 101..1101, true);
    active(&from);
    for noted in [u64::MAX, 0, 1 << 40, 7] {
        of.journal().noted.store(noted, Relaxed);
        let found = active(&from);
        assert!(all.iter().all(|topic| found.contains(&topic.pair())));
        assert!(found.len() <= all.len() + IN_TURN);
        rest[0].publish(noted & 7 | 8);
        assert!(active(&from).contains(&rest[0].pair()));
    }
}

#[test]
fn rings_of_one_number_are_each_checked_once() {
    let (of, from) = (session(), session());
    from.follow();
    let number = |writer: &Writer| writer.header.words()[layout::ring::NUMBER].store(7, Relaxed);
    let topics = topics_with(&of, &from, 1..101, true, number);
    active(&from);
    for _ in 0..3 {
        let before = from.activity().marks();
        (0..layout::JOURNAL).for_each(|_| of.journal().note(7));
        let found = active(&from);
        assert!(topics.iter().all(|topic| found.contains(&topic.pair())));
        let marks = from.activity().marks() - before;
        assert!(marks <= (topics.len() + IN_TURN) as u64, "{marks} marks");
    }
}

#[test]
fn sample_missing_in_the_journal_is_found_at_the_end_of_its_publisher() {
    let (of, from) = (session(), session());
    from.follow();
    let topics = topics(&of, &from, 1..101, true);
    active(&from);
    // The publisher died after it had stored the sample and before it noted the entry.
    topics[50].publish(1);
    of.journal().noted.store(0, Relaxed);
    assert!(!active(&from).contains(&topics[50].pair()), "nothing says so");
    topics[50].reader.mark_active();
    assert!(active(&from).contains(&topics[50].pair()));
}

#[test]
fn a_sample_whose_entry_was_counted_and_not_stored_is_found() {
    let (of, from) = (session(), session());
    from.follow();
    let topics = topics(&of, &from, 1..101, true);
    active(&from);
    topics[50].publish(1);
    // The publisher died between the count and the entry.
    of.journal().entries[0].store(0, Relaxed);
    assert!(active(&from).contains(&topics[50].pair()));
}

#[test]
fn a_late_relay_is_found_active_for_earlier_and_later_samples() {
    let (of, from) = (session(), session());
    from.follow();
    let late = transient(keep_last(5));
    let writer = writer(&of, late, 0);
    writer.publish(meta(1), b"before").unwrap();
    assert_eq!(of.journal().noted.load(Relaxed), 0, "nobody follows");
    let (there, lane) = (peer(&from, &of), from.allocate_lane().unwrap());
    let (gid, at) = (Gid::new(from.id(), 1), lane.location());
    let (back, stands_for) = (peer(&of, &from), Some(vec![Gid([7; 16])]));
    let info = ReaderInfo { gid, lane: at, qos: late, peer: back, stands_for };
    let grant = writer.attach(info).unwrap();
    // The sample comes between the grant and the map.
    writer.publish(meta(2), b"between").unwrap();
    let options = ReaderOptions {
        reader: gid,
        writer: writer.gid(),
        peer: there,
        ring: writer.location(),
        lane,
        grant,
        qos: late,
        max_message: MAX,
    };
    let mut reader = Reader::map(options).unwrap();
    reader.follow(gid);
    assert_eq!(active(&from), [(gid, writer.gid())]);
    assert_eq!(std::iter::from_fn(|| take(&mut reader)).count(), 2);
    writer.publish(meta(3), b"after").unwrap();
    assert_eq!(of.journal().noted.load(Relaxed), 2, "what came since it was attached");
}

#[test]
fn memory_that_came_has_its_sessions_readers_looked_at() {
    let (of, from) = (session(), session());
    from.follow();
    let topics = topics(&of, &from, 1..20, true);
    active(&from);
    // The sample is in a new segment.
    topics[0].writer.publish(meta(1), &vec![7; 100_000]).unwrap();
    assert!(topics.iter().all(|topic| topic.reader.missing().is_none()));
    let found = active(&from);
    assert!(topics.iter().all(|topic| found.contains(&topic.pair())));
    assert!(active(&from).len() <= IN_TURN);
}

#[test]
fn ended_and_non_following_readers_are_not_found() {
    let (of, from) = (session(), session());
    let unfollowed = topics(&of, &from, 1..3, true);
    unfollowed[0].publish(1);
    assert!(active(&from).is_empty());
    from.follow();
    let mut followed = topics(&of, &from, 3..5, true);
    active(&from);
    followed.iter().for_each(|topic| topic.publish(1));
    drop(followed.pop());
    let pair = followed[0].pair();
    assert!(active(&from).iter().all(|found| *found == pair));
    drop(followed);
    assert!(active(&from).is_empty());
}

#[test]
fn a_publisher_without_relays_notes_nothing() {
    let (of, from) = (session(), session());
    let topics = topics(&of, &from, 1..2, false);
    topics[0].publish(1);
    assert_eq!(of.journal().noted.load(Relaxed), 0);
}
