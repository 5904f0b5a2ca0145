//! A daemon that replaces another one, and readers that are attached again.

use axon_shm::{PublishError, internal::probe};
use rustix::net::accept_with;

use super::*;
use crate::{
    config::{Config, OsFiles},
    session::{daemon::address::Address, tests::simulated_daemon::Taker},
    session_key::OWNER,
};

/// The address at which the test plays one daemon after another.
pub(super) struct Stage {
    listener: OwnedFd,
    config: Config,
    _dir: tempfile::TempDir,
}

impl Stage {
    pub(super) fn new() -> Self {
        let dir = tempfile::tempdir().unwrap();
        let run = dir.path().join("run").into_os_string();
        let env = [("AXON_RUNTIME_DIR".into(), run), ("AXON_DAEMON".into(), "require".into())];
        let config = Config::resolve(env, None, &OsFiles).unwrap();
        let (mut listeners, _) = Address::of(&config).bind().unwrap().into_parts();
        let listener = listeners.pop().expect("a path");
        Self { listener, config, _dir: dir }
    }

    /// Waits until a session has connected to the next daemon.
    pub(super) fn daemon(&self, number: u8) -> Daemon {
        let mut fds = [PollFd::new(&self.listener, PollFlags::IN)];
        assert_eq!(poll(&mut fds, Some(&EVER.try_into().unwrap())), Ok(1), "nobody comes");
        let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
        let socket = accept_with(&self.listener, flags).unwrap();
        let (hello, descriptors) = loop {
            match hear(&socket) {
                ReceivedMessage { message: SessionMessage::Hello(hello), descriptors } => {
                    break (hello, descriptors);
                }
                ReceivedMessage { message: SessionMessage::Unknown(OWNER), .. } => {}
                other => panic!("before HELLO: {:?}", other.message),
            }
        };
        let [segment, doorbell, pidfd] = <[_; 3]>::try_from(descriptors).expect("three");
        let handed = PeerDescriptors { segment, doorbell, pidfd };
        let daemon = Daemon { socket, id: hello.session, handed };
        let welcome = Welcome {
            protocol: PROTOCOL,
            daemon: DaemonId([number; 16]),
            pid: std::process::id(),
            ranges: Some(true),
        };
        daemon.say(SessionMessage::Welcome(welcome), &[probe().unwrap().as_fd()]);
        daemon.tell_all(Vec::new());
        daemon
    }

    pub(super) fn session(&self) -> (Session, Daemon) {
        let config = self.config.clone();
        let opening = thread::spawn(move || Session::open(&config, SessionOptions::new("t")));
        let daemon = self.daemon(1);
        (opening.join().unwrap().unwrap(), daemon)
    }
}

/// Waits until the session has handled all earlier messages: it then asks for the pair that the last message announces.
pub(super) fn done(daemon: &Daemon, asking: &Subscription) {
    let writer = Gid::new(SessionId::random(), 1);
    daemon.say(SessionMessage::Match(Pair { reader: asking.gid(), writer }), &[]);
    daemon.hear(|message| {
        matches!(message, SessionMessage::Attach(attach) if attach.writer == writer).then_some(())
    });
}

#[test]
fn pair_survives_a_resync_from_a_new_daemon() {
    let stage = Stage::new();
    let (session, daemon) = stage.session();
    let far = Far::new(&daemon);
    let (subscription, _) = far.matched(&session, &daemon);
    let publisher =
        session.create_publisher(EndpointSpec::new("/p", "test/Bytes", Qos::keep_all())).unwrap();
    let taker = Taker::new();
    let taking = taker.attach(&publisher, None, &daemon);
    drop(daemon);
    let daemon = stage.daemon(2);
    // The new daemon has nothing more to report about the other sessions: they are stopped, and have not connected to
    // it.
    daemon.tell_all(Vec::new());
    done(&daemon, &subscription);
    assert_eq!(subscription.matched(), [far.writer.gid()]);
    assert_eq!(publisher.matched(), [taker.gid]);
    far.publish(1, b"x");
    assert_eq!(take(&subscription), Some(1));
    // The publisher still waits for its reader.
    let held_back = (0..1 << 14).any(|_| match publisher.publish(&[0; 4096]) {
        Ok(_) => false,
        Err(PublishError::Blocked { .. }) => true,
        Err(error) => panic!("{error}"),
    });
    assert!(held_back, "nobody is waited for");
    drop(taking);

    // A pair that this daemon announced, and does not repeat, is over.
    let Pair { reader, writer } = far.pair(&subscription);
    daemon.say(SessionMessage::Match(Pair { reader, writer }), &[]);
    daemon.hear_attach();
    daemon.tell_all(Vec::new());
    done(&daemon, &subscription);
    assert!(subscription.matched().is_empty());
}

#[test]
fn a_reattached_reader_resumes_its_position_and_counts_missing_samples() {
    let (session, daemon) = session();
    let far = Far::new(&daemon);
    let (subscription, _) = far.matched(&session, &daemon);
    let pair = far.pair(&subscription);
    let lose = || {
        let Pair { reader, writer } = pair;
        daemon.say(SessionMessage::Unmatch(Unmatch { reader, writer, reason: "lost".into() }), &[]);
        until("it is over", || subscription.matched().is_empty());
    };
    let attach_after = |number| {
        daemon.say(SessionMessage::Match(pair), &[]);
        let attach = daemon.hear_attach();
        assert_eq!(attach.after, Some(number));
        let granted = far.grant(&attach);
        let introduction = far.introduction();
        let introduction: Vec<_> = introduction.iter().map(AsFd::as_fd).collect();
        daemon.say(SessionMessage::Grant(granted), &introduction);
        assert!(subscription.wait_matched(1, EVER));
    };
    far.publish(1, b"x");
    assert_eq!(take(&subscription), Some(1));
    lose();
    far.publish(2, b"x");
    far.publish(3, b"x");
    attach_after(1);
    assert_eq!((take(&subscription), take(&subscription)), (Some(2), Some(3)));
    assert_eq!(subscription.lost(), 0, "all of it stood");

    // If no reader is attached, no sample stays in the ring.
    lose();
    assert!(far.writer.detach(pair.reader));
    far.publish(4, b"x");
    far.publish(5, b"x");
    attach_after(3);
    far.publish(6, b"x");
    assert_eq!(take(&subscription), Some(6));
    assert_eq!(subscription.lost(), 2);
}

/// An earlier daemon did not pass on a publisher's grant. The test checks the result after the application has dropped
/// the publisher, or the whole session.
fn a_grant_is_lost(session_ends: bool) {
    let stage = Stage::new();
    let (session, daemon) = stage.session();
    let publisher =
        session.create_publisher(EndpointSpec::new("/p", "test/Bytes", Qos::keep_all())).unwrap();
    let endpoint = publisher.endpoint().clone();
    let taker = Taker::new();
    let lane = taker.session.allocate_lane().unwrap();
    let granted = taker.ask(&endpoint, lane.location(), None, &daemon);
    drop(daemon);
    until("it is lost", || session.daemon().is_none());
    publisher.publish(b"x").unwrap();
    publisher.publish(b"x").unwrap();
    drop(publisher);
    let (ending, session) = if session_ends {
        (Some(thread::spawn(move || drop(session))), None)
    } else {
        (None, Some(session))
    };
    let daemon = stage.daemon(2);
    daemon.hear(|message| {
        matches!(message, SessionMessage::Endpoint(announce) if announce.endpoint.gid == endpoint.gid)
            .then_some(())
    });
    let again = taker.ask(&endpoint, lane.location(), None, &daemon);
    let of = |granted: &Granted| (granted.generation, granted.first, granted.ring);
    assert_eq!(of(&again), of(&granted), "the one that stands");
    let mut taking = taker.take_up(&endpoint, lane, &again, &daemon);
    assert_eq!([taking.take(&daemon), taking.take(&daemon)], [1, 2]);
    if let Some(ending) = ending {
        ending.join().unwrap();
    } else if let Some(session) = &session {
        let gone = || !session.shared().state().endpoints.publishers.contains_key(&endpoint.gid);
        until("it is gone", gone);
    }
    drop(session);
}

#[test]
fn dropped_publisher_waits_for_a_reader_without_its_grant_while_no_daemon_runs() {
    a_grant_is_lost(false);
}

#[test]
fn ended_session_waits_for_a_reader_without_its_grant_while_no_daemon_runs() {
    a_grant_is_lost(true);
}

#[test]
fn dropped_publisher_ends_at_once_after_its_reader_took_the_grant() {
    let stage = Stage::new();
    let (session, daemon) = stage.session();
    let publisher =
        session.create_publisher(EndpointSpec::new("/p", "test/Bytes", Qos::keep_all())).unwrap();
    let gid = publisher.gid();
    let _taking = Taker::new().attach(&publisher, None, &daemon);
    drop(daemon);
    until("it is lost", || session.daemon().is_none());
    drop(publisher);
    assert!(!session.shared().state().endpoints.publishers.contains_key(&gid));
}
