//! Tests of a session with a daemon that the test simulates: the session's reaction to messages, and the order of its
//! own messages.

mod followed;
mod handed;
mod simulated_daemon;
mod unmet;

use std::{
    env, fs,
    io::Write as _,
    os::fd::{AsFd, BorrowedFd, OwnedFd},
    process::Command,
    sync::Arc,
    thread,
    time::{Duration, Instant},
};

use axon_shm::{
    Meta,
    internal::{
        Grant, Location, PeerDescriptors, PeerSession, Purpose, ReaderInfo, RingOptions, RingPeer,
        SegmentInfo, SegmentKind, SessionSegment, Terms, Writer,
    },
};
use rustix::{
    event::{PollFd, PollFlags, poll},
    fs::fstat,
    net::{AddressFamily, SocketFlags, SocketType, socketpair},
    process::{Resource, Rlimit, getrlimit, setrlimit},
};

use super::{
    daemon::socket::{self, ReceivedMessage, SocketError},
    endpoints::EndpointFactory,
    *,
};
use crate::{
    config::{Config, OsFiles},
    graph::EndpointKind,
    ids::{DaemonId, Gid, SessionId},
    qos::{Durability, Qos},
    wire::session::{
        Attach, Granted, PROTOCOL, Pair, Segment, SegmentOpened, SessionGraph, SessionMessage,
        SessionRefused, Unmatch, Welcome,
    },
};

/// Timeout of a wait; only a lost message takes this long.
const EVER: Duration = Duration::from_secs(60);
const LARGE: usize = 100_000;

/// The daemon's end of a session's socket.
struct Daemon {
    socket: OwnedFd,
    /// The id of the session, and the descriptors that it passed.
    id: SessionId,
    handed: PeerDescriptors,
}

/// Opens a session. Its daemon, which the test simulates, sends it an empty graph.
fn session() -> (Session, Daemon) {
    let (kind, flags) = (SocketType::SEQPACKET, SocketFlags::CLOEXEC);
    let (socket, theirs) = socketpair(AddressFamily::UNIX, kind, flags, None).unwrap();
    let config = Config::resolve([], None, &OsFiles).unwrap();
    let opening = thread::spawn(move || Session::over(theirs, &config, SessionOptions::new("t")));
    let ReceivedMessage { message: SessionMessage::Hello(hello), descriptors } = hear(&socket)
    else {
        panic!("something else before HELLO")
    };
    let [segment, doorbell, pidfd] = <[_; 3]>::try_from(descriptors).expect("three");
    let handed = PeerDescriptors { segment, doorbell, pidfd };
    let daemon = Daemon { socket, id: hello.session, handed };
    let pid = std::process::id();
    let welcome =
        Welcome { protocol: PROTOCOL, daemon: DaemonId([7; 16]), pid, ranges: Some(true) };
    daemon.say(SessionMessage::Welcome(welcome), &[]);
    daemon.tell_all(Vec::new());
    (opening.join().unwrap().unwrap(), daemon)
}

fn hear(socket: &OwnedFd) -> ReceivedMessage {
    let mut buffer = Vec::new();
    loop {
        match socket::receive(socket, &mut buffer) {
            Ok(received) => return received,
            Err(SocketError::NotReady) => {
                let mut fds = [PollFd::new(socket, PollFlags::IN)];
                assert_eq!(poll(&mut fds, Some(&EVER.try_into().unwrap())), Ok(1), "in vain");
            }
            Err(error) => panic!("{error}"),
        }
    }
}

impl Daemon {
    /// Waits for the next message that `pick` accepts.
    fn hear<T>(&self, mut pick: impl FnMut(SessionMessage) -> Option<T>) -> T {
        loop {
            if let Some(picked) = pick(hear(&self.socket).message) {
                return picked;
            }
        }
    }

    fn hear_attach(&self) -> Attach {
        self.hear(|message| match message {
            SessionMessage::Attach(attach) => Some(attach),
            _ => None,
        })
    }

    fn say(&self, message: SessionMessage, descriptors: &[BorrowedFd<'_>]) {
        socket::send(&self.socket, &message.encode().unwrap(), descriptors).unwrap();
    }

    fn graph(&self, whole: bool, more: bool) {
        let (added, removed) = (Vec::new(), Vec::new());
        let graph = SessionGraph { version: 1, whole, added, removed, more, ended: None };
        self.say(SessionMessage::Graph(graph), &[]);
    }

    /// Sends the whole graph again, with these messages.
    fn tell_all(&self, what: Vec<(SessionMessage, Vec<OwnedFd>)>) {
        self.graph(true, true);
        for (message, descriptors) in what {
            self.say(message, &descriptors.iter().map(AsFd::as_fd).collect::<Vec<_>>());
        }
        self.graph(false, false);
    }
}

/// Another session with a publisher, and its view of the session under test.
struct Far {
    session: Arc<SessionSegment>,
    writer: Writer,
    view: RingPeer,
}

impl Far {
    fn new(daemon: &Daemon) -> Self {
        let session = SessionSegment::create(SessionId::random()).unwrap();
        let view = PeerSession::map(daemon.id, daemon.handed.try_clone().unwrap()).unwrap();
        Self::with(1, session, RingPeer::Remote(view))
    }

    /// Creates another publisher of the same session, so that the two sessions stay connected when this publisher ends.
    fn beside(&self) -> Self {
        Self::with(2, self.session.clone(), self.view.clone())
    }

    fn with(number: u32, session: Arc<SessionSegment>, view: RingPeer) -> Self {
        let (gid, qos) = (Gid::new(session.id(), number), Qos::keep_all());
        let options = RingOptions { gid, qos, budget: 16 << 20, max_message: 1 << 20, expected: 0 };
        let writer = Writer::create(session.clone(), options).unwrap();
        Self { session, writer, view }
    }

    fn publish(&self, sequence: u64, payload: &[u8]) {
        let meta = Meta::at_nanos(sequence, 0);
        self.writer.publish(meta, payload).unwrap();
    }

    /// Returns the writer's answer to a reader that asked.
    fn grant(&self, attach: &Attach) -> Granted {
        let Attach { reader, writer, lane, qos, after, .. } = *attach;
        let (peer, stands_for) = (self.view.clone(), None);
        let info = ReaderInfo { gid: reader, lane, qos, peer, stands_for };
        let terms = Terms { after, carries: false };
        let (Grant { generation, first }, _) = self.writer.attach_on(info, terms).unwrap();
        let (session, ring) = (self.session.id(), self.writer.location());
        let segments = Vec::new();
        let (after, relayed) = (None, None);
        Granted { reader, writer, generation, first, session, ring, segments, after, relayed }
    }

    fn introduction(&self) -> Vec<OwnedFd> {
        let PeerDescriptors { segment, doorbell, pidfd } = self.session.descriptors().unwrap();
        [segment, doorbell, pidfd].map(|fd| fd.as_fd().try_clone_to_owned().unwrap()).into()
    }

    fn segment(&self, number: u32) -> (Segment, OwnedFd) {
        let (info, descriptor) = self.session.segment(number).unwrap().expect("that segment");
        (info.into(), descriptor)
    }

    /// Announces a segment to the session under test.
    fn hand(&self, number: u32, daemon: &Daemon) {
        let (segment, descriptor) = self.segment(number);
        let opened = SegmentOpened { session: self.session.id(), segment };
        daemon.say(SessionMessage::Segment(opened), &[descriptor.as_fd()]);
    }

    /// Creates a subscription that is matched with the publisher, and returns it with its grant.
    fn matched(&self, session: &Session, daemon: &Daemon) -> (Subscription, Granted) {
        let subscription = subscription(session);
        daemon.say(SessionMessage::Match(self.pair(&subscription)), &[]);
        let granted = self.grant(&daemon.hear_attach());
        let introduction = self.introduction();
        let introduction: Vec<_> = introduction.iter().map(AsFd::as_fd).collect();
        daemon.say(SessionMessage::Grant(granted.clone()), &introduction);
        assert!(subscription.wait_matched(1, EVER));
        (subscription, granted)
    }

    fn pair(&self, subscription: &Subscription) -> Pair {
        Pair { reader: subscription.gid(), writer: self.writer.gid() }
    }

    /// Returns the inode of the memory of the publisher's large samples.
    fn inode(&self) -> u64 {
        let samples = |info: &SegmentInfo| matches!(info.kind, SegmentKind::Samples(_));
        let info = self.session.segments().into_iter().find(samples).expect("large samples");
        fstat(self.segment(info.number).1).unwrap().st_ino
    }

    /// Lets time pass until the memory of its large samples is given up.
    fn give_memory_up(&self) {
        let now = Instant::now();
        for second in 0..60 {
            self.writer.reclaim_idle(now + Duration::from_secs(second));
        }
        assert!(self.session.segments().is_empty());
    }
}

fn subscription(session: &Session) -> Subscription {
    session.create_subscription(EndpointSpec::new("/t", "test/Bytes", Qos::keep_all())).unwrap()
}

fn take(subscription: &Subscription) -> Option<u64> {
    subscription.take(&mut Vec::new()).map(|info| info.sequence)
}

/// Waits for something that must come.
fn until(what: &str, mut reached: impl FnMut() -> bool) {
    let deadline = Instant::now() + EVER;
    while !reached() {
        assert!(Instant::now() < deadline, "in vain: {what}");
        thread::sleep(Duration::from_millis(5));
    }
}

/// Returns how often this process maps the file.
fn maps_of(inode: u64) -> usize {
    let maps = fs::read_to_string("/proc/self/maps").unwrap();
    let is = |line: &&str| line.split_whitespace().nth(4) == Some(&inode.to_string());
    maps.lines().filter(is).count()
}

#[test]
fn memory_in_a_repeated_grant_wakes_the_waiting_reader() {
    let (session, daemon) = session();
    let far = Far::new(&daemon);
    let (subscription, granted) = far.matched(&session, &daemon);
    far.publish(1, &[1; LARGE]);
    let start = Instant::now();
    let received = thread::scope(|scope| {
        let reader = scope.spawn(|| subscription.recv(&mut Vec::new(), Some(EVER)));
        daemon.hear(|message| matches!(message, SessionMessage::Need(_)).then_some(()));
        // The session has found that the sample's memory is missing, and sleeps.
        let armed = session.segment().armed_word(Purpose::Samples);
        until("it sleeps", || armed.load(std::sync::atomic::Ordering::Relaxed) != 0);
        thread::sleep(Duration::from_millis(20));
        let (segment, descriptor) = far.segment(1);
        let granted = Granted { segments: vec![segment], ..granted };
        daemon.say(SessionMessage::Grant(granted), &[descriptor.as_fd()]);
        reader.join().unwrap()
    });
    assert_eq!(received.map(|info| info.sequence), Ok(1));
    assert!(start.elapsed() < EVER, "a wake-up was lost");
}

#[test]
fn a_segment_that_is_refused_does_not_spoil_the_grant_it_came_with() {
    let (session, daemon) = session();
    let far = Far::new(&daemon);
    let subscription = subscription(&session);
    daemon.say(SessionMessage::Match(far.pair(&subscription)), &[]);
    let granted = far.grant(&daemon.hear_attach());
    let segments = vec![Segment { number: 77, publisher: None }];
    let mut descriptors = far.introduction();
    descriptors.push(fs::File::open("/dev/null").unwrap().into());
    let descriptors: Vec<_> = descriptors.iter().map(AsFd::as_fd).collect();
    daemon.say(SessionMessage::Grant(Granted { segments, ..granted }), &descriptors);
    assert!(subscription.wait_matched(1, EVER));
    far.publish(1, b"x");
    assert_eq!(take(&subscription), Some(1));
}

#[test]
fn a_segment_is_announced_before_the_rings_in_it() {
    let (session, daemon) = session();
    // More rings than fit in the first segment.
    let spec = || EndpointSpec::new("/t", "test/Bytes", Qos::default());
    let _publishers: Vec<_> = (0..300).map(|_| session.create_publisher(spec()).unwrap()).collect();
    let mut told = Vec::new();
    let ring = daemon.hear(|message| match message {
        SessionMessage::Segment(opened) => {
            told.push(opened.segment.number);
            None
        }
        SessionMessage::Endpoint(announce) => announce.ring.filter(|ring| ring.segment != 0),
        _ => None,
    });
    assert_eq!((ring.segment, told), (1, vec![1]));
}

#[test]
fn a_writer_that_grants_anew_and_anew_takes_no_more_than_two_lanes() {
    let (session, daemon) = session();
    let far = Far::new(&daemon);
    let (subscription, mut granted) = far.matched(&session, &daemon);
    let rounds = 50;
    let mut lanes = Vec::new();
    for round in 0..rounds {
        // The sample that each grant leaves unread keeps its lane.
        far.publish(round + 1, b"x");
        let generation = granted.generation ^ 1 | 2;
        daemon.say(SessionMessage::Grant(Granted { generation, ..granted }), &[]);
        let attach = daemon.hear_attach();
        lanes.push(attach.lane);
        granted = far.grant(&attach);
        daemon.say(SessionMessage::Grant(granted.clone()), &[]);
    }
    far.publish(rounds + 1, b"x");
    lanes.sort();
    lanes.dedup();
    assert!(lanes.len() <= 3, "{} lanes", lanes.len());
    let mut taken = Vec::new();
    until("the last sample", || {
        taken.extend(take(&subscription));
        taken.last() == Some(&(rounds + 1))
    });
    assert_eq!(subscription.received() + subscription.lost(), rounds + 1);
}

#[test]
fn memory_that_was_given_up_while_the_session_was_behind_is_let_go() {
    let (session, daemon) = session();
    let far = Far::new(&daemon);
    let (subscription, granted) = far.matched(&session, &daemon);
    let on = far.beside();
    let (_other, again) = on.matched(&session, &daemon);
    for repeated in [true, false] {
        far.publish(1 + u64::from(!repeated), &[1; LARGE]);
        let number = far.session.segments()[0].number;
        far.hand(number, &daemon);
        until("the sample", || take(&subscription).is_some());
        let inode = far.inode();
        assert_eq!(maps_of(inode), 2, "the publisher's, and the reader's");
        far.give_memory_up();
        assert_eq!(maps_of(inode), 1);
        let mut all = vec![(SessionMessage::Grant(again.clone()), far.introduction())];
        if repeated {
            all.push((SessionMessage::Grant(granted.clone()), Vec::new()));
        }
        daemon.tell_all(all);
        until("nobody keeps it", || maps_of(inode) == 0);
        assert_eq!(subscription.matched().len(), usize::from(repeated));
    }
}

#[test]
fn a_reader_requests_the_memory_of_an_ended_writer() {
    let (session, daemon) = session();
    let far = Far::new(&daemon);
    let (subscription, _) = far.matched(&session, &daemon);
    let on = far.beside();
    let (_other, granted) = on.matched(&session, &daemon);
    far.publish(1, &[1; LARGE]);
    let number = far.session.segments()[0].number;
    far.hand(number, &daemon);
    daemon.tell_all(vec![(SessionMessage::Grant(granted), far.introduction())]);
    let needed = daemon.hear(|message| match message {
        SessionMessage::Need(need) => Some((need.session, need.number)),
        _ => None,
    });
    assert_eq!(needed, (far.session.id(), number), "so that it is told when that is gone");
    assert!(subscription.matched().is_empty());
    assert_eq!(take(&subscription), Some(1));
    assert_eq!(subscription.lost(), 0);
}

#[test]
fn samples_in_memory_an_ended_writer_did_not_leave_are_lost() {
    let (session, daemon) = session();
    let far = Far::new(&daemon);
    let (subscription, _) = far.matched(&session, &daemon);
    let lane = subscription.inner.lock().lanes()[0].1;
    // The session is not told of the memory of the large samples, and the writer ends; its process lives.
    for sequence in 1..=20 {
        far.publish(sequence, &vec![1; if sequence == 1 { 1 } else { LARGE }]);
    }
    let Pair { reader, writer } = far.pair(&subscription);
    let unmatch = Unmatch { reader, writer, reason: "gone".into() };
    daemon.say(SessionMessage::Unmatch(unmatch), &[]);
    until("it is over", || subscription.matched().is_empty());
    assert_eq!(take(&subscription), Some(1), "what is there");
    until("the others are lost", || take(&subscription).is_none() && subscription.lost() == 19);
    // All of them are lost at once: the session does not wait for each in turn.
    assert!(!subscription.has_data());
    assert_eq!(session.segment().allocate_lane().unwrap().location(), lane, "nor is it kept");
}

#[test]
fn a_daemon_cannot_have_a_session_read_its_own_samples_as_rings_and_lanes() {
    let (session, daemon) = session();
    let latched = Qos::default().with_durability(Durability::TransientLocal);
    let publisher =
        session.create_publisher(EndpointSpec::new("/t", "test/Bytes", latched)).unwrap();
    // The daemon takes no part in pairs that the session attaches itself, so this subscription is added without that.
    let spec = EndpointSpec::new("/t", "test/Bytes", latched);
    let described = EndpointFactory(&session).describe(spec, EndpointKind::Subscription).unwrap();
    let subscription = session.adopt_subscription(described);
    let (reader, writer, own) = (subscription.gid(), publisher.gid(), session.id());
    // A sample that looks like the ring.
    let mut forged = [0u8; 4096];
    forged[..8].copy_from_slice(b"AXONRNG2");
    forged[16..32].copy_from_slice(&writer.0);
    forged[264] = 4;
    publisher.publish(&forged).unwrap();
    let ring = daemon.hear(|message| match message {
        SessionMessage::Endpoint(announce) if announce.endpoint.gid == writer => announce.ring,
        _ => None,
    });
    let mut memory = vec![0; 512 << 10];
    rustix::io::pread(&daemon.handed.segment, &mut memory, 0).unwrap();
    let is = |at: &usize| &memory[*at..*at + 8] == b"AXONRNG2" && *at as u64 != ring.offset;
    let at = (4096..memory.len()).step_by(128).find(is).expect("the sample");
    let sample = Location { segment: 0, offset: at as u64 };

    daemon.say(SessionMessage::Match(Pair { reader, writer }), &[]);
    let asked = daemon.hear_attach();
    // The daemon sends the grant that a publisher would send to its first reader.
    let (generation, segments) = (5 << 24 | 1, Vec::new());
    let (first, session, ring, after) = (0, own, sample, None);
    let relayed = None;
    let granted =
        Granted { reader, writer, generation, first, session, ring, segments, after, relayed };
    daemon.say(SessionMessage::Grant(granted), &[]);
    daemon.say(SessionMessage::Attach(Attach { lane: sample, ..asked.clone() }), &[]);
    daemon.say(SessionMessage::Attach(asked), &[]);
    // The answer to this message shows that the session has handled the messages before it.
    daemon
        .say(SessionMessage::Match(Pair { reader, writer: Gid::new(SessionId::random(), 1) }), &[]);
    let mut grants = Vec::new();
    daemon.hear(|message| match message {
        SessionMessage::Grant(granted) => {
            grants.push(granted);
            None
        }
        other => matches!(other, SessionMessage::Attach(_)).then_some(()),
    });
    assert!(subscription.matched().is_empty(), "a sample is no ring");
    assert_eq!(grants.len(), 1, "a sample is no lane");
    // A correct grant is accepted.
    daemon.say(SessionMessage::Grant(grants.remove(0)), &[]);
    assert!(subscription.wait_matched(1, EVER));
    publisher.publish(b"x").unwrap();
    assert!(subscription.take(&mut Vec::new()).is_some());
}

/// Runs a test in a process of its own if it changes a state of the whole process. Returns whether this is that
/// process.
fn alone(test: &str) -> bool {
    const ALONE: &str = "AXON_TEST_ALONE";
    if env::var(ALONE).is_ok_and(|name| name == test) {
        return true;
    }
    let mut command = Command::new(env::current_exe().unwrap());
    command.args([&format!("session::tests::{test}"), "--exact"]).env(ALONE, test);
    let output = command.output().unwrap();
    std::io::stderr().write_all(&output.stdout).unwrap();
    assert!(output.status.success(), "it failed in a process of its own");
    false
}

#[test]
fn memory_that_could_not_be_handed_over_for_want_of_descriptors_is_later() {
    if !alone("memory_that_could_not_be_handed_over_for_want_of_descriptors_is_later") {
        return;
    }
    let (session, daemon) = session();
    let latched = Qos::default().with_durability(Durability::TransientLocal);
    let publisher =
        session.create_publisher(EndpointSpec::new("/p", "test/Bytes", latched)).unwrap();
    let subscription = subscription(&session);
    let limit = getrlimit(Resource::Nofile);
    setrlimit(Resource::Nofile, Rlimit { current: Some(200), ..limit }).unwrap();
    let open = || fs::File::open("/dev/null").ok();
    let mut all: Vec<_> = std::iter::from_fn(open).collect();
    // One descriptor is left, for the memory itself.
    all.pop();
    publisher.publish(&[1; LARGE]).unwrap();
    let (reader, writer) = (subscription.gid(), Gid::new(SessionId::random(), 1));
    daemon.say(SessionMessage::Match(Pair { reader, writer }), &[]);
    daemon.hear(|message| match message {
        SessionMessage::Segment(_) => panic!("there was no descriptor for it"),
        other => matches!(other, SessionMessage::Attach(_)).then_some(()),
    });
    drop(all);
    let told = daemon.hear(|message| match message {
        SessionMessage::Segment(opened) => Some(opened.segment.publisher),
        _ => None,
    });
    assert_eq!(told, Some(publisher.gid()));
}
