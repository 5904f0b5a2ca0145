//! Cases that only a simulated daemon can produce, because they depend on an order of events.

use axon_shm::{
    PublishError,
    internal::{Lane, Reader, ReaderOptions},
};

use super::*;
use crate::{
    graph::{Endpoint, EndpointKind},
    session::control::pending_endpoints,
    wire::session::{GraphItem, RelayGivenUp},
};

/// A reader, and its view of the publisher's session.
pub(super) struct Taking {
    reader: Reader,
    view: Arc<PeerSession>,
}

impl Taking {
    /// Waits for the next sample, and returns its number. The session may have announced the sample's memory meanwhile.
    pub(super) fn take(&mut self, daemon: &Daemon) -> u64 {
        let mut taken = None;
        until("a sample", || {
            while let Ok(ReceivedMessage { message, descriptors }) =
                socket::receive(&daemon.socket, &mut Vec::new())
            {
                if let (SessionMessage::Segment(opened), [descriptor]) = (message, &descriptors[..])
                {
                    self.view.add_segment(opened.segment.into(), descriptor).unwrap();
                }
            }
            taken = self.reader.take(&mut Vec::new()).unwrap();
            taken.is_some()
        });
        taken.unwrap().meta.sequence
    }
}

/// A reader of another session, which takes when the test permits.
pub(super) struct Taker {
    pub(super) session: Arc<SessionSegment>,
    pub(super) gid: Gid,
}

impl Taker {
    pub(super) fn new() -> Self {
        let session = SessionSegment::create(SessionId::random()).unwrap();
        let gid = Gid::new(session.id(), 1);
        Self { session, gid }
    }

    /// Attaches the reader to a publisher, as a relay for others or not.
    pub(super) fn attach(
        &self,
        to: &Publisher,
        stands_for: Option<Vec<Gid>>,
        daemon: &Daemon,
    ) -> Taking {
        let lane = self.session.allocate_lane().unwrap();
        let granted = self.ask(to.endpoint(), lane.location(), stands_for, daemon);
        self.take_up(to.endpoint(), lane, &granted, daemon)
    }

    /// Asks for a publisher's grant.
    pub(super) fn ask(
        &self,
        of: &Endpoint,
        lane: Location,
        stands_for: Option<Vec<Gid>>,
        daemon: &Daemon,
    ) -> Granted {
        let attach = Attach {
            reader: self.gid,
            writer: of.gid,
            lane,
            qos: of.qos,
            session: self.session.id(),
            stands_for,
            segments: Vec::new(),
            after: None,
            carries: None,
        };
        let PeerDescriptors { segment, doorbell, pidfd } = self.session.descriptors().unwrap();
        let descriptors = [segment.as_fd(), doorbell.as_fd(), pidfd.as_fd()];
        daemon.say(SessionMessage::Attach(attach), &descriptors);
        daemon.hear(|message| match message {
            SessionMessage::Grant(granted) => Some(granted),
            _ => None,
        })
    }

    /// Attaches to the ring that the publisher granted.
    pub(super) fn take_up(
        &self,
        of: &Endpoint,
        lane: Lane,
        granted: &Granted,
        daemon: &Daemon,
    ) -> Taking {
        let Granted { generation, first, ring, .. } = *granted;
        let view = PeerSession::map(daemon.id, daemon.handed.try_clone().unwrap()).unwrap();
        let mut reader = Reader::map(ReaderOptions {
            reader: self.gid,
            writer: of.gid,
            peer: RingPeer::Remote(view.clone()),
            ring,
            lane,
            grant: Grant { generation, first },
            qos: of.qos,
            max_message: 1 << 20,
        })
        .unwrap();
        reader.tell_progress();
        Taking { reader, view }
    }

    /// Returns the reader as the graph shows it.
    fn endpoint(&self, to: &Publisher) -> Endpoint {
        let kind = EndpointKind::Subscription;
        Endpoint { gid: self.gid, kind, ..to.endpoint().clone() }
    }
}

/// A remote reader, for which a relay stands.
const ELSEWHERE: Gid = Gid([5; 16]);
/// A publisher keeps only a few samples of this length.
const LARGE_SAMPLE: &[u8] = &[7; 1 << 19];

/// A publisher that is matched only with [`ELSEWHERE`], through a relay.
struct Relayed {
    publisher: Publisher,
    relay: Gid,
    daemon: Daemon,
    session: Session,
}

impl Relayed {
    fn new(qos: Qos) -> (Self, Taking) {
        let (session, daemon) = session();
        let publisher = publisher(&session, qos);
        let taker = Taker::new();
        let taking = taker.attach(&publisher, Some(vec![ELSEWHERE]), &daemon);
        until("it is matched", || publisher.matched() == [ELSEWHERE]);
        (Self { publisher, relay: taker.gid, daemon, session }, taking)
    }

    /// Creates a pair with [`Qos::keep_all`], and a relay that confirms its samples later.
    fn with_receipts() -> (Self, Taking) {
        let (relayed, mut taking) = Self::new(Qos::keep_all());
        taking.reader.finish_later();
        (relayed, taking)
    }

    /// Publishes three samples, which the relay takes.
    fn three(&self, taking: &mut Taking) {
        for number in 1..=3 {
            self.publisher.publish(b"x").unwrap();
            assert_eq!(taking.take(&self.daemon), number);
        }
    }

    /// Publishes until there is no room; returns how many samples that took.
    fn fill(&self) -> u64 {
        let mut published = 0;
        while self.publisher.publish(LARGE_SAMPLE).is_ok() {
            published += 1;
            assert!(published < 1000, "its budget is much less");
        }
        published
    }

    /// The daemon reports that the relay gave up `samples` samples.
    fn gives_up(&self, samples: u64) {
        let given_up = RelayGivenUp { reader: self.relay, writer: self.publisher.gid(), samples };
        self.daemon.say(SessionMessage::GivenUp(given_up), &[]);
    }

    /// The daemon reports that the relay ended.
    fn ends(&self) {
        let pair = Pair { reader: self.relay, writer: self.publisher.gid() };
        self.daemon.say(SessionMessage::Detach(pair), &[]);
    }
}

fn appears(daemon: &Daemon, endpoint: Endpoint) {
    let added = vec![GraphItem { endpoint, daemon: None, reach: None }];
    let graph = SessionGraph {
        version: 2,
        whole: false,
        added,
        removed: Vec::new(),
        more: false,
        ended: None,
    };
    daemon.say(SessionMessage::Graph(graph), &[]);
}

/// Waits until the session has handled all earlier messages: it then asks about a pair.
fn has_heard(daemon: &Daemon, asking: &Subscription) {
    let writer = Gid::new(SessionId::random(), 1);
    daemon.say(SessionMessage::Match(Pair { reader: asking.gid(), writer }), &[]);
    daemon.hear(|message| {
        matches!(message, SessionMessage::Attach(attach) if attach.writer == writer).then_some(())
    });
}

fn shows(session: &Session, gid: Gid) -> bool {
    session.graph().endpoints.contains_key(&gid)
}

fn publisher(session: &Session, qos: Qos) -> Publisher {
    session.create_publisher(EndpointSpec::new("/p", "test/Bytes", qos)).unwrap()
}

/// Tries until the session had to hold something back for less than its patience, however slow the
/// machine.
fn in_time(mut attempt: impl FnMut() -> bool) {
    for _ in 0..100 {
        let begun = Instant::now();
        let held = attempt();
        if begun.elapsed() < pending_endpoints::ARRIVAL_TIMEOUT {
            assert!(held, "it was counted before it was reached");
            return;
        }
    }
    panic!("this machine is too slow for it");
}

#[test]
fn a_subscription_is_counted_once_it_is_reached() {
    let (session, daemon) = session();
    let publisher = publisher(&session, Qos::default());
    let asking = subscription(&session);
    in_time(|| {
        let taker = Taker::new();
        appears(&daemon, taker.endpoint(&publisher));
        has_heard(&daemon, &asking);
        let held = !shows(&session, taker.gid);
        let mut taking = taker.attach(&publisher, None, &daemon);
        assert!(session.wait_graph(EVER, |graph| graph.endpoints.contains_key(&taker.gid)));
        let number = publisher.publish(b"x").unwrap();
        assert_eq!(taking.take(&daemon), number);
        held
    });
    // A reader that no endpoint here matches need not be waited for.
    let other = Taker::new();
    let stranger = Endpoint { topic: "/other".into(), ..other.endpoint(&publisher) };
    appears(&daemon, stranger);
    has_heard(&daemon, &asking);
    assert!(shows(&session, other.gid));
}

#[test]
fn a_publisher_is_counted_once_it_is_received_from() {
    let (session, daemon) = session();
    let asking = subscription(&session);
    in_time(|| {
        let far = Far::new(&daemon);
        let subscription = subscription(&session);
        let gid = far.writer.gid();
        let kind = EndpointKind::Publisher;
        appears(&daemon, Endpoint { gid, kind, ..subscription.endpoint().clone() });
        has_heard(&daemon, &asking);
        let mut held = !shows(&session, gid);
        for reader in [&asking, &subscription] {
            daemon.say(SessionMessage::Match(far.pair(reader)), &[]);
            let attach = daemon.hear(|message| match message {
                SessionMessage::Attach(attach) if attach.writer == gid => Some(attach),
                _ => None,
            });
            held &= !shows(&session, gid);
            let introduction = far.introduction();
            let introduction: Vec<_> = introduction.iter().map(AsFd::as_fd).collect();
            let introduction = if reader.gid() == asking.gid() { &introduction[..] } else { &[] };
            daemon.say(SessionMessage::Grant(far.grant(&attach)), introduction);
        }
        assert!(session.wait_graph(EVER, |graph| graph.endpoints.contains_key(&gid)));
        far.publish(1, b"x");
        assert!(subscription.recv(&mut Vec::new(), Some(EVER)).is_ok());
        assert!(asking.recv(&mut Vec::new(), Some(EVER)).is_ok());
        held
    });
}

#[test]
fn a_sample_is_acknowledged_when_the_relay_has_it() {
    let (relayed, mut taking) = Relayed::new(Qos::default());
    let Relayed { publisher, daemon, session, .. } = &relayed;
    assert!(publisher.wait_acknowledged(Duration::ZERO), "nothing was published");
    let room = || session.segment().armed_word(Purpose::Room);
    for round in 0..3u8 {
        publisher.publish(&[round]).unwrap();
        assert!(!publisher.wait_acknowledged(Duration::ZERO));
        thread::scope(|scope| {
            let waiting = scope.spawn(|| publisher.wait_acknowledged(EVER));
            until("it sleeps", || room().load(std::sync::atomic::Ordering::Relaxed) != 0);
            assert!(!waiting.is_finished());
            taking.take(daemon);
            assert!(waiting.join().unwrap(), "nobody told it");
        });
    }
    // A relay that has ended carries no samples, so the publisher does not wait for it.
    publisher.publish(b"last").unwrap();
    thread::scope(|scope| {
        let waiting = scope.spawn(|| publisher.wait_acknowledged(EVER));
        until("it sleeps", || room().load(std::sync::atomic::Ordering::Relaxed) != 0);
        // The daemon reports the end of the relay, and no samples that were given up.
        drop(taking);
        relayed.ends();
        assert!(waiting.join().unwrap(), "nobody told it");
    });
}

#[test]
fn a_sample_that_is_given_up_is_not_acknowledged() {
    let (relayed, mut taking) = Relayed::with_receipts();
    let publisher = &relayed.publisher;
    relayed.three(&mut taking);
    taking.reader.finish(1);
    assert_eq!((publisher.unacknowledged(), publisher.given_up()), (2, 0));
    thread::scope(|scope| {
        let waiting = scope.spawn(|| publisher.wait_acknowledged(EVER));
        relayed.gives_up(2);
        relayed.ends();
        assert!(!waiting.join().unwrap());
    });
    until("it ended", || publisher.matched().is_empty());
    assert_eq!((publisher.unacknowledged(), publisher.given_up()), (0, 2));
    assert!(publisher.wait_acknowledged(Duration::ZERO), "it was said once");
}

#[test]
fn a_publisher_that_goes_on_since_its_relay_left_has_no_acknowledgement() {
    let (relayed, mut taking) = Relayed::with_receipts();
    let publisher = &relayed.publisher;
    let published = relayed.fill();
    assert_eq!(taking.take(&relayed.daemon), 1);
    drop(taking);
    assert_eq!(publisher.publish(LARGE_SAMPLE), Ok(published + 1), "nobody holds it back");
    for _ in 0..3 {
        assert!(
            !publisher.wait_acknowledged(Duration::ZERO),
            "the daemon has not said what became of it"
        );
    }
    relayed.gives_up(published);
    relayed.ends();
    until("it ended", || publisher.matched().is_empty());
    assert!(!publisher.wait_acknowledged(Duration::ZERO));
    assert_eq!(publisher.given_up(), published);
}

#[test]
fn given_up_sample_of_a_relay_is_acknowledged_after_the_report_of_the_daemon() {
    let (relayed, mut taking) = Relayed::with_receipts();
    let publisher = &relayed.publisher;
    relayed.three(&mut taking);
    taking.reader.give_up(2);
    taking.reader.finish(3);
    assert!(!publisher.wait_acknowledged(Duration::ZERO), "two are lost");
    assert_eq!((publisher.unacknowledged(), publisher.given_up()), (0, 2));
    // The message about these samples comes later, and does not count them again.
    relayed.gives_up(2);
    relayed.ends();
    until("it ended", || publisher.matched().is_empty());
    assert_eq!(publisher.given_up(), 2);
    assert!(publisher.wait_acknowledged(Duration::ZERO), "it was said once");
}

#[test]
fn no_more_is_given_up_than_was_published() {
    let (relayed, _taking) = Relayed::new(Qos::keep_all());
    let publisher = &relayed.publisher;
    let given_up = |samples, all| {
        relayed.gives_up(samples);
        until("it is counted", || publisher.given_up() == all);
        assert!(!publisher.wait_acknowledged(Duration::ZERO), "each is told");
    };
    publisher.publish(b"x").unwrap();
    given_up(u64::MAX, 1);
    publisher.publish(b"x").unwrap();
    given_up(u64::MAX - 1, 2);
}

#[test]
fn a_reliable_publisher_blocks_until_a_stalled_reader_takes_again() {
    let (relayed, mut taking) = Relayed::new(Qos::keep_all());
    let Relayed { publisher, daemon, .. } = &relayed;
    let published = relayed.fill();
    assert!(matches!(publisher.publish(LARGE_SAMPLE), Err(PublishError::Blocked { .. })));
    // No sample is given up, and each taken sample makes room.
    for sequence in 1..=published {
        assert_eq!(taking.take(daemon), sequence);
    }
    publisher.publish(LARGE_SAMPLE).unwrap();
    assert_eq!((taking.take(daemon), taking.reader.lost()), (published + 1, 0));
}

#[test]
fn an_endpoint_that_is_refused_is_not_in_the_graph() {
    let (session, daemon) = session();
    let node = session.create_node("n", "/", "/").unwrap();
    let asking = subscription(&session);
    let refused = publisher(&session, Qos::default());
    let reader =
        session.create_subscription(EndpointSpec::new("/p", "test/Bytes", Qos::default())).unwrap();
    assert!(shows(&session, refused.gid()), "until it is refused");
    let refuse = |gid| {
        let refusal =
            SessionRefused { endpoint: Some(gid), ..SessionRefused::because("too many".into()) };
        daemon.say(SessionMessage::Refused(refusal), &[]);
    };
    refuse(refused.gid());
    let changed = [Waitable::GuardCondition(node.graph_changed())];
    while shows(&session, refused.gid()) {
        assert_eq!(session.wait_for(&changed, Some(EVER)).unwrap(), [0], "the change is told");
    }
    assert!(shows(&session, reader.gid()) && shows(&session, asking.gid()));
    // A refused endpoint keeps its pairs within its own session.
    refused.publish(b"x").unwrap();
    assert!(reader.has_data());
    // The daemon sends the whole graph, without this endpoint, and a refusal of an endpoint that is gone.
    daemon.tell_all(Vec::new());
    let gone = refused.gid();
    drop(refused);
    refuse(gone);
    refuse(Gid::new(SessionId::random(), 1));
    has_heard(&daemon, &asking);
    assert!(!shows(&session, gone) && shows(&session, reader.gid()));
    assert!(session.shared().state().graph.refused.is_empty());
}

#[test]
fn one_that_is_refused_while_it_is_made_is_never_shown_again() {
    let (session, daemon) = session();
    let asking = subscription(&session);
    for _ in 0..50 {
        let (created, gid) = thread::scope(|scope| {
            let creating = scope.spawn(|| publisher(&session, Qos::default()));
            let gid = daemon.hear(|message| match message {
                SessionMessage::Endpoint(announce) if announce.endpoint.topic == "/p" => {
                    Some(announce.endpoint.gid)
                }
                _ => None,
            });
            let refusal =
                SessionRefused { endpoint: Some(gid), ..SessionRefused::because("no".into()) };
            daemon.say(SessionMessage::Refused(refusal), &[]);
            (creating.join().unwrap(), gid)
        });
        has_heard(&daemon, &asking);
        assert_eq!(created.gid(), gid);
        assert!(!shows(&session, gid));
    }
}
