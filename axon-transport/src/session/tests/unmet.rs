//! A reader that never gets a publisher's grant, and counts its lost samples.

use axon_shm::internal::Lane;

use super::{followed::Stage, simulated_daemon::Taker, *};
use crate::wire::session::Unmet;

/// Waits for the next message to the daemon about unmet pairs, or about the end of `writer`.
fn told(daemon: &Daemon, writer: Gid) -> SessionMessage {
    daemon.hear(|message| match &message {
        SessionMessage::Unmet(_) => Some(message),
        SessionMessage::EndpointGone(gone) if gone.gid == writer => Some(message),
        _ => None,
    })
}

/// The objects of a reader that asked. It asks as long as they exist.
struct Asked {
    _lane: Lane,
    _taker: Taker,
}

/// Creates a publisher of `qos` that published five samples for a reader that did not get its grant.
fn granted_in_vain(session: &Session, daemon: &Daemon, qos: Qos) -> (Publisher, Gid, Asked) {
    let spec = EndpointSpec::new("/p", "test/Bytes", qos);
    let publisher = session.create_publisher(spec).unwrap();
    let taker = Taker::new();
    let lane = taker.session.allocate_lane().unwrap();
    taker.ask(publisher.endpoint(), lane.location(), None, daemon);
    for _ in 0..5 {
        publisher.publish(b"x").unwrap();
    }
    (publisher, taker.gid, Asked { _lane: lane, _taker: taker })
}

#[test]
fn each_daemon_is_told_the_losses_of_a_reader_that_timed_out() {
    let stage = Stage::new();
    let (session, daemon) = stage.session();
    let (publisher, reader, _asked) = granted_in_vain(&session, &daemon, Qos::keep_all());
    let writer = publisher.gid();
    drop(publisher);
    assert!(session.shared().state().endpoints.publishers.contains_key(&writer), "it stays");
    // The time limit of the publisher has passed.
    session.shared().part_leaving(true);
    session.core().wake();
    let unmet = SessionMessage::Unmet(Unmet { reader, writer, samples: 5 });
    assert_eq!(told(&daemon, writer), unmet);
    assert!(matches!(told(&daemon, writer), SessionMessage::EndpointGone(_)));
    drop(daemon);
    let daemon = stage.daemon(2);
    assert_eq!(told(&daemon, writer), unmet, "the first one may not have passed it on");
}

#[test]
fn an_ending_session_waits_for_a_daemon_to_report_reader_losses() {
    let stage = Stage::new();
    let (session, daemon) = stage.session();
    let (publisher, reader, _asked) =
        granted_in_vain(&session, &daemon, Qos::default().with_depth(2));
    let writer = publisher.gid();
    drop(daemon);
    until("it is lost", || session.daemon().is_none());
    // The publisher does not stay for readers that keep only the last samples.
    drop(publisher);
    let ending = thread::spawn(move || drop(session));
    let daemon = stage.daemon(2);
    let unmet = Unmet { reader, writer, samples: 2 };
    assert_eq!(told(&daemon, writer), SessionMessage::Unmet(unmet), "of five, as many as it keeps");
    drop(daemon);
    ending.join().unwrap();
}

#[test]
fn a_publisher_whose_reader_has_taken_up_its_grant_tells_nothing() {
    let (session, daemon) = session();
    let spec = EndpointSpec::new("/p", "test/Bytes", Qos::keep_all());
    let publisher = session.create_publisher(spec).unwrap();
    let writer = publisher.gid();
    let _taking = Taker::new().attach(&publisher, None, &daemon);
    publisher.publish(b"x").unwrap();
    drop(publisher);
    assert!(matches!(told(&daemon, writer), SessionMessage::EndpointGone(_)));
}

#[test]
fn a_reader_counts_reported_losses_once_and_only_without_a_grant() {
    let (session, daemon) = session();
    let far = Far::new(&daemon);
    let (met, _) = far.matched(&session, &daemon);
    let unmet = subscription(&session);
    daemon.say(SessionMessage::Match(far.pair(&unmet)), &[]);
    let attach = daemon.hear_attach();
    let late = far.grant(&attach);
    let say = |subscription: &Subscription, samples| {
        let Pair { reader, writer } = far.pair(subscription);
        daemon.say(SessionMessage::Unmet(Unmet { reader, writer, samples }), &[]);
    };
    say(&met, 7);
    say(&unmet, 7);
    until("it is counted", || unmet.lost() == 7);
    say(&unmet, 7);
    daemon.say(SessionMessage::Grant(late), &[]);
    far.publish(1, b"x");
    until("the other takes", || take(&met) == Some(1));
    followed::done(&daemon, &met);
    assert_eq!((unmet.lost(), met.lost()), (7, 0));
    assert!(unmet.matched().is_empty(), "it has ended");

    daemon.say(SessionMessage::Match(far.pair(&unmet)), &[]);
    daemon.hear_attach();
    say(&unmet, u64::MAX);
    followed::done(&daemon, &met);
    assert_eq!(unmet.lost(), 7, "nobody lost 2^64 samples");
}

#[test]
fn each_daemon_is_told_the_pending_grant_of_an_absent_reader() {
    let stage = Stage::new();
    let (session, daemon) = stage.session();
    let (publisher, reader, _asked) = granted_in_vain(&session, &daemon, Qos::keep_all());
    let writer = publisher.gid();
    let _taking = Taker::new().attach(&publisher, None, &daemon);
    drop(daemon);
    let daemon = stage.daemon(2);
    let granted = daemon.hear(|message| match message {
        SessionMessage::Grant(granted) => Some(granted),
        _ => None,
    });
    assert_eq!((granted.reader, granted.writer, granted.first), (reader, writer, 0));
    drop(publisher);
    session.shared().part_leaving(true);
    session.core().wake();
    let next = daemon.hear(|message| match &message {
        SessionMessage::Grant(_) | SessionMessage::Unmet(_) => Some(message),
        _ => None,
    });
    assert_eq!(next, SessionMessage::Unmet(Unmet { reader, writer, samples: 5 }), "one grant");
}

#[test]
fn a_reader_takes_samples_of_a_publisher_that_ended_during_the_grant() {
    let (session, daemon) = session();
    let far = Far::new(&daemon);
    let subscription = subscription(&session);
    daemon.say(SessionMessage::Match(far.pair(&subscription)), &[]);
    let granted = far.grant(&daemon.hear_attach());
    far.publish(1, b"x");
    far.publish(2, b"x");
    let introduction = far.introduction();
    let introduction: Vec<_> = introduction.iter().map(AsFd::as_fd).collect();
    daemon.say(SessionMessage::Grant(granted), &introduction);
    let Pair { reader, writer } = far.pair(&subscription);
    daemon.say(SessionMessage::Unmatch(Unmatch { reader, writer, reason: "gone".into() }), &[]);
    until("the first came", || take(&subscription) == Some(1));
    assert_eq!((take(&subscription), subscription.lost()), (Some(2), 0));
    until("it is gone", || subscription.matched().is_empty());
}
