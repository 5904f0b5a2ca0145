//! Subscriptions that take from rings.

use std::sync::Arc;

use axon_shm::{
    Meta, PublishError, TakeError,
    internal::{Reader, ReaderInfo, ReaderOptions, RingOptions, RingPeer, SessionSegment, Writer},
};

use super::{
    SubscriptionInner, matched_reader::NumberKind, matched_readers::MatchedReaders, taking::Take,
};
use crate::{
    graph::{Endpoint, EndpointKind},
    ids::{Gid, SessionId},
    qos::Qos,
    wire::session::EndpointRole,
};

/// Returns a writer and its reader. The publisher is of the same session, and is made for the subscription.
pub(super) fn reading(session: &Arc<SessionSegment>, writer: Gid, reader: Gid) -> (Writer, Reader) {
    let (qos, peer) = (Qos::default(), RingPeer::Local(session.clone()));
    let options = RingOptions { gid: writer, qos, budget: 0, max_message: 10, expected: 0 };
    let publisher = Writer::create(session.clone(), options).unwrap();
    let lane = session.allocate_lane().unwrap();
    let at = lane.location();
    let info = ReaderInfo { gid: reader, lane: at, qos, peer: peer.clone(), stands_for: None };
    let (grant, ring) = (publisher.attach(info).unwrap(), publisher.location());
    let options = ReaderOptions { reader, writer, peer, ring, lane, grant, qos, max_message: 10 };
    (publisher, Reader::map(options).unwrap())
}

fn subscription(gid: Gid) -> SubscriptionInner {
    let endpoint = Endpoint::example(gid, EndpointKind::Subscription);
    SubscriptionInner::new(endpoint, EndpointRole::Application, Vec::new())
}

/// A server that reads its client's requests by way of one daemon after the other. Numbers that each brings, with the
/// second daemon's clock behind that of the first.
struct Served {
    session: Arc<SessionSegment>,
    client: Gid,
    server: Gid,
    requests: MatchedReaders,
    inner: SubscriptionInner,
    rings: Vec<Writer>,
}

impl Served {
    fn new() -> Self {
        let session = SessionSegment::create(SessionId::random()).unwrap();
        let [client, server] = [1, 2].map(|number| Gid::new(session.id(), number));
        let endpoint = Endpoint::example(server, EndpointKind::Server);
        let qos = Qos::keep_all();
        Self {
            inner: SubscriptionInner::of_service(endpoint, EndpointRole::Application, qos),
            requests: MatchedReaders::of_service(),
            session,
            client,
            server,
            rings: Vec::new(),
        }
    }

    /// Delivers these requests as the next daemon does.
    fn daemon(&mut self, numbers: impl IntoIterator<Item = u64>) {
        let (ring, reader) = reading(&self.session, self.client, self.server);
        self.requests.end(&self.client);
        self.requests.add(reader, None, NumberKind::None);
        let stamp = -(self.rings.len() as i64);
        for number in numbers {
            ring.publish(Meta::at_nanos(number, stamp), b"request").unwrap();
        }
        self.rings.push(ring);
    }

    /// Takes a request. One that is `short_of` has no memory.
    fn take(&mut self, short_of: Option<u64>) -> Option<u64> {
        let mut out = Vec::new();
        let take = |reader: &mut Reader| {
            if reader.peek()?.is_some_and(|meta| Some(meta.sequence) == short_of) {
                return Err(TakeError::NoMemory { len: 7 });
            }
            Ok(reader.take(&mut out)?.map(|taken| (taken.meta, ())))
        };
        Take::begin(&mut self.requests, self.inner.take_rules())
            .next(take)
            .map(|(info, ())| info.sequence)
    }

    fn take_all(&mut self) -> Vec<u64> {
        std::iter::from_fn(|| self.take(None)).collect()
    }
}

#[test]
fn a_server_takes_each_request_once_in_order_however_many_daemons_bring_it() {
    let mut of = Served::new();
    of.daemon([1, 2, 3]);
    assert_eq!(of.take(None), Some(1));
    of.daemon([2, 3, 4]);
    of.daemon([2, 3, 4, 5]);
    assert_eq!(of.take_all(), [2, 3, 4, 5], "what an earlier daemon left is not given up as taken");
    let mut of = Served::new();
    for daemon in 0..20 {
        // No request is answered, so the client sends all again.
        of.daemon(1..=daemon / 2);
    }
    assert_eq!(of.take_all(), (1..10).collect::<Vec<_>>());
    of.daemon(1..=10);
    assert_eq!(of.take_all(), [10]);
}

#[test]
fn request_without_memory_holds_up_later_ones_of_its_client() {
    let mut of = Served::new();
    of.daemon([1, 2]);
    of.daemon([1, 2, 3]);
    assert_eq!(of.take(Some(1)), None, "the first waits in both rings");
    assert_eq!(of.take_all(), [1, 2, 3]);
    let mut of = Served::new();
    of.daemon([1]);
    of.daemon([2]);
    assert_eq!(of.take(Some(1)), None);
    let taken = std::iter::from_fn(|| {
        let take =
            |reader: &mut Reader| Ok(reader.take(&mut Vec::new())?.map(|taken| (taken.meta, ())));
        Take::begin(&mut of.requests, of.inner.take_rules())
            .next_of(&of.client, take)
            .map(|(info, ())| info.sequence)
    });
    assert_eq!(taken.collect::<Vec<_>>(), [1, 2]);
}

#[test]
fn clients_that_were_there_last_are_remembered_when_there_were_very_many() {
    let mut of = Served::new();
    // Clients that made one call each, and one that is there when the daemon is killed.
    for number in 0..12_000 {
        of.requests.remember(Gid::new(of.session.id(), 10 + number), 1);
    }
    of.daemon([1, 2]);
    assert_eq!(of.take_all(), [1, 2]);
    of.requests.end(&of.client);
    for number in 0..2000 {
        of.requests.remember(Gid::new(of.session.id(), 100_000 + number), 1);
    }
    of.daemon([1, 2, 3]);
    assert_eq!(of.take_all(), [3]);
}

#[test]
fn a_sample_without_memory_to_copy_wakes_no_waiter_at_once() {
    let session = SessionSegment::create(SessionId::random()).unwrap();
    let [writer, gid] = [1, 2].map(|number| Gid::new(session.id(), number));
    let (publisher, reader) = reading(&session, writer, gid);
    let mut matched_readers = MatchedReaders::default();
    matched_readers.add(reader, None, NumberKind::None);
    publisher.publish_next(0, b"sample").unwrap();
    assert!(matched_readers.slots().has_data());
    let inner = subscription(gid);
    let none = |_: &mut Reader| Err::<Option<(Meta, ())>, _>(TakeError::NoMemory { len: 6 });
    assert!(
        Take::begin(&mut matched_readers, inner.take_rules()).next(none).is_none()
            && !matched_readers.slots().has_data()
    );
    // A caller that asks nevertheless gets it, if it can be had.
    let mut out = Vec::new();
    let take = |reader: &mut Reader| Ok(reader.take(&mut out)?.map(|taken| (taken.meta, ())));
    assert!(Take::begin(&mut matched_readers, inner.take_rules()).next(take).is_some());
    assert_eq!(out, b"sample");
}

#[test]
fn unannounced_samples_of_an_ended_writer_are_read() {
    let session = SessionSegment::create(SessionId::random()).unwrap();
    session.follow();
    let [gid, writers @ ..] =
        std::array::from_fn::<_, 20, _>(|number| Gid::new(session.id(), number as u32));
    let mut matched_readers = MatchedReaders::default();
    let publishers = writers.map(|writer| {
        let (publisher, mut reader) = reading(&session, writer, gid);
        reader.follow(gid);
        matched_readers.add(reader, None, NumberKind::None);
        publisher
    });
    let active = || {
        let mut found = Vec::new();
        session.take_active(&mut found);
        found
    };
    assert_eq!(active().len(), writers.len());
    // The writer behaves like one that died before it marked itself as active: no relay reads here, so it is not
    // marked.
    publishers[10].publish_next(0, b"sample").unwrap();
    assert!(!active().contains(&(gid, writers[10])));
    assert!(matched_readers.end(&writers[10]));
    assert!(
        active().contains(&(gid, writers[10])) && matched_readers.slots().has_from(&writers[10])
    );
}

#[test]
fn numbers_from_other_hosts_leave_losses_that_can_be_counted() {
    const FURTHEST: u64 = 1 + (1 << 32);
    let session = SessionSegment::create(SessionId::random()).unwrap();
    let [gid, writers @ ..] = [1, 2, 3].map(|number| Gid::new(session.id(), number));
    let (mut matched_readers, inner, mut out) =
        (MatchedReaders::default(), subscription(gid), Vec::new());
    let mut publishers = Vec::new();
    for writer in writers {
        let (publisher, reader) = reading(&session, writer, gid);
        matched_readers.add(reader, None, NumberKind::All);
        let say = |sequence| publisher.publish(Meta::at_nanos(sequence, 0), b"sample");
        say(1).unwrap();
        // A gap of this size cannot be a loss.
        let refused = PublishError::Sequence { sequence: u64::MAX, last: 1 };
        assert_eq!(say(u64::MAX).unwrap_err(), refused);
        say(FURTHEST).unwrap();
        publishers.push(publisher);
    }
    let mut numbers = Vec::new();
    let mut take = |matched_readers: &mut MatchedReaders| {
        let take = |reader: &mut Reader| Ok(reader.take(&mut out)?.map(|t| (t.meta, ())));
        Take::begin(matched_readers, inner.take_rules()).next(take)
    };
    while let Some((info, ())) = take(&mut matched_readers) {
        numbers.push(info.sequence);
    }
    numbers.sort_unstable();
    let lost = 2 * (FURTHEST - 2);
    assert_eq!(numbers, [1, 1, FURTHEST, FURTHEST]);
    assert_eq!((matched_readers.new_losses(), matched_readers.losses()), (lost, lost));
    assert!(writers.iter().all(|writer| matched_readers.end(writer)));
    assert_eq!((matched_readers.new_losses(), matched_readers.losses()), (0, lost));
}
