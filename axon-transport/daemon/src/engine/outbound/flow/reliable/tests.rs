use std::rc::Rc;

use axon_shm::{ids::Gid, qos::Qos};
use axon_transport::{MessageInfo, config::TopicPriority};

use super::*;
use crate::engine::{
    outbound::{
        budget::Budget,
        flow::{PeerCredit, UsedCredit},
        model::route,
        queue::Offered,
    },
    rings::RingSample,
    sample::stream_header::StreamHeader,
    sim::pair::Pair,
};

const PUBLISHER: Gid = Gid([1; 16]);

/// A stream towards a peer that reads all.
struct Way {
    pair: Pair,
    info: FlowInfo,
    queue: Queue,
    credit: Rc<PeerCredit>,
    reliable: ReliableStream,
    counters: Counters,
    done: FlowProgress,
    offered: u64,
}

impl Way {
    fn new(acknowledged: bool) -> Self {
        let mut info = FlowInfo::new(PUBLISHER, &route(7, TopicPriority::Normal));
        info.acknowledged = acknowledged;
        let credit = PeerCredit::new();
        Self {
            pair: Pair::new(),
            info,
            queue: Queue::new(&Qos::keep_all(), Budget::new(1 << 30).of_peer()),
            reliable: ReliableStream::new(credit.share()),
            credit,
            counters: Counters::default(),
            done: FlowProgress::default(),
            offered: 0,
        }
    }

    /// Samples of this length wait in the queue.
    fn offer(&mut self, samples: u64, length: usize) {
        for _ in 0..samples {
            self.offered += 1;
            let info = MessageInfo::of(PUBLISHER, self.offered);
            let sample =
                RingSample::new(info, vec![self.offered as u8; length].into(), self.pair.now());
            let offered = self.queue.offer(sample, self.pair.now());
            assert!(matches!(offered, Offered::Queued { dropped: 0 }));
        }
    }

    /// Writes until there is a reason to pause.
    fn write(&mut self) -> FlowPause {
        let (now, mut frames) = (self.pair.now(), Frames::default());
        let mut carrier = self.pair.carrier();
        let Self { info, queue, counters, done, .. } = self;
        loop {
            let reliable = &mut self.reliable;
            if let Some(pause) =
                reliable.write(info, queue, &mut frames, &mut carrier, counters, done, now)
            {
                return pause;
            }
        }
    }

    /// Writes, and lets the packets go, until nothing waits.
    fn write_all(&mut self) {
        while self.write() == FlowPause::Blocked {
            self.pair.exchange();
        }
        self.pair.exchange();
    }

    /// The same towards a peer that reads what comes.
    fn write_and_read_all(&mut self) {
        while self.write() == FlowPause::Blocked {
            self.pair.exchange();
            let _ = self.pair.read(self.stream());
        }
        self.pair.exchange();
        let _ = self.pair.read(self.stream());
    }

    fn stream(&self) -> StreamId {
        self.reliable.stream.unwrap()
    }

    fn timeout(&mut self) -> Option<Duration> {
        let now = self.pair.now();
        self.reliable.handle_timeout(now, &self.queue, &mut self.pair.carrier())
    }
}

#[test]
fn samples_follow_the_header_on_one_stream_and_stay_until_they_are_acknowledged() {
    let mut way = Way::new(true);
    assert_eq!(way.write(), FlowPause::Empty);
    assert!(!way.reliable.is_open(), "nothing was to send");
    way.offer(3, 10);
    way.write_all();
    let stream = way.stream();
    way.offer(2, 10);
    way.write_all();
    assert_eq!(way.stream(), stream);
    let (bytes, is_finished) = way.pair.read(stream).unwrap();
    let header = way.info.reliable_header(false).encode();
    assert_eq!(bytes[..header.len()], header);
    let parsed = StreamHeader::plain(7, PUBLISHER);
    assert_eq!(header, parsed.encode());
    let each = (bytes.len() - header.len()) / 5;
    let last: Vec<_> = bytes[header.len()..].chunks(each).map(|frame| frame[each - 1]).collect();
    assert_eq!((last, is_finished), (vec![1, 2, 3, 4, 5], false));
    assert!(way.queue.has_sent() && way.reliable.credit().is_used());
    assert_eq!(way.done, FlowProgress::default(), "the peer says what it has");
    way.queue.acknowledge(5);
    way.reliable.note_sent(&way.queue);
    assert!(!way.reliable.credit().is_used());
}

#[test]
fn samples_of_an_unacknowledged_flow_are_done_once_quic_has_them() {
    let mut way = Way::new(false);
    way.offer(3, 10);
    assert_eq!(way.write(), FlowPause::Empty);
    assert_eq!(way.done, FlowProgress { sequence: Some(3), given_up: 0 });
    assert!(way.queue.is_empty() && !way.reliable.credit().is_used());
}

#[test]
fn a_long_sample_makes_progress_while_quic_takes_it() {
    let mut way = Way::new(true);
    way.offer(1, 1 << 20);
    assert_eq!(way.write(), FlowPause::Blocked);
    assert!(way.reliable.is_writing() && way.reliable.left() > 0);
    assert_eq!(way.timeout(), Some(STREAM_IDLE + way.pair.now()), "it was not idle");
    let mut read = 0;
    while way.write() == FlowPause::Blocked {
        way.pair.exchange();
        read += way.pair.read(way.stream()).unwrap().0.len();
    }
    way.pair.exchange();
    read += way.pair.read(way.stream()).unwrap().0.len();
    assert!(read > 1 << 20, "{read}");
    assert_eq!((way.reliable.parts(), way.reliable.is_writing()), (4, false));
}

#[test]
fn samples_retransmitted_over_another_link_are_no_progress() {
    let mut way = Way::new(true);
    way.offer(8, 128 << 10);
    way.write_and_read_all();
    assert_eq!(way.reliable.parts(), 4);
    for _ in 0..3 {
        way.reliable.rewind(&mut way.queue);
        way.write_and_read_all();
        assert_eq!(way.reliable.parts(), 4);
    }
    // Nor is it where another flow goes on.
    let mut next = Way::new(true);
    next.reliable.go_on(way.reliable.sent_progress());
    next.offer(8, 128 << 10);
    next.write_and_read_all();
    assert_eq!(next.reliable.parts(), 0);
    // What is new counts.
    way.offer(2, 128 << 10);
    way.write_and_read_all();
    next.offer(2, 128 << 10);
    next.write_and_read_all();
    assert_eq!((way.reliable.parts(), next.reliable.parts()), (5, 1));
}

#[test]
fn a_long_sample_waits_for_credit_and_a_short_one_does_not() {
    let mut way = Way::new(true);
    let mut other = way.credit.share();
    other.set(UsedCredit::of(usize::MAX, usize::MAX >> 1));
    way.offer(1, 100);
    assert_eq!(way.write(), FlowPause::Empty);
    way.offer(1, 1 << 20);
    assert_eq!(way.write(), FlowPause::NoCredit);
    assert_eq!(way.queue.waiting(), 1);
    drop(other);
    assert_eq!(way.write(), FlowPause::Blocked);
    assert_eq!(way.queue.waiting(), 0);
}

#[test]
fn a_peer_that_stops_the_stream_gets_no_sample_of_it_again() {
    let mut way = Way::new(true);
    way.offer(3, 10);
    way.write_all();
    let stream = way.stream();
    way.pair.stop(stream);
    let Way { pair, info, queue, counters, done, reliable, .. } = &mut way;
    reliable.handle_stopped(pair.client(), info, queue, counters, done);
    assert_eq!(way.done, FlowProgress { sequence: Some(3), given_up: 3 });
    assert!(!way.reliable.is_open() && way.queue.is_empty());
    assert_eq!(way.counters.take_lost().iter().map(|loss| loss.samples).sum::<u64>(), 3);
    way.offer(1, 10);
    way.write_all();
    assert_ne!(way.stream(), stream, "later samples have another stream");
}

#[test]
fn a_stop_that_quic_tells_while_a_sample_is_written_is_the_same() {
    let mut way = Way::new(true);
    way.offer(1, 10);
    way.write_all();
    way.pair.stop(way.stream());
    way.offer(1, 10);
    assert_eq!(way.write(), FlowPause::Empty);
    assert_eq!(way.done, FlowProgress { sequence: Some(2), given_up: 2 });
    assert!(!way.reliable.is_open());
}

#[test]
fn a_new_link_resends_unacknowledged_samples() {
    let mut way = Way::new(true);
    way.offer(3, 10);
    way.write_all();
    let before = way.stream();
    way.queue.acknowledge(1);
    let Way { pair, queue, reliable, .. } = &mut way;
    reliable.leave(Some(pair.client()), queue);
    assert!(!way.reliable.is_open() && !way.reliable.is_writing());
    assert!(!way.reliable.credit().is_used() && way.queue.waiting() == 2);
    way.pair.exchange();
    assert!(way.pair.read(before).unwrap().1, "the old stream is finished");
    way.write_all();
    let (bytes, _) = way.pair.read(way.stream()).unwrap();
    assert_eq!(bytes.last(), Some(&3));
}

#[test]
fn a_stream_is_finished_once_it_is_idle_and_nothing_is_in_flight() {
    let mut way = Way::new(true);
    assert_eq!(way.timeout(), None, "no stream is open");
    way.offer(1, 10);
    way.write_all();
    let (stream, sent_at) = (way.stream(), way.reliable.active_at);
    assert_eq!(way.timeout(), Some(sent_at + STREAM_IDLE));
    while way.pair.now() < sent_at + STREAM_IDLE {
        way.pair.exchange();
    }
    let again = way.timeout();
    assert_eq!(again, Some(way.pair.now() + Duration::from_secs(1)), "a sample is in flight");
    way.queue.acknowledge(1);
    assert_eq!(way.timeout(), None);
    assert!(!way.reliable.is_open());
    way.pair.exchange();
    assert!(way.pair.read(stream).unwrap().1);
}
