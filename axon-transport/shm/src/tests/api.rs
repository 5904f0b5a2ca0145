//! The interface for use without a daemon, over a socket pair.

use std::{
    os::{
        fd::{AsFd, OwnedFd},
        unix::net::{UnixDatagram, UnixStream},
    },
    thread,
};

use rustix::{
    event::{PollFd, PollFlags, poll},
    net::{AddressFamily, SocketFlags, SocketType, socketpair},
};

use super::*;
use crate::qos::Reliability;

pub(super) const SOON: Option<Duration> = Some(EVER);

pub(super) fn pair() -> (OwnedFd, OwnedFd) {
    socketpair(AddressFamily::UNIX, SocketType::SEQPACKET, SocketFlags::CLOEXEC, None).unwrap()
}

pub(super) fn together(
    publisher: &Publisher,
    context: &Context,
    qos: Qos,
) -> (Result<Gid, ConnectError>, Result<Subscriber, ConnectError>) {
    let (ours, theirs) = pair();
    thread::scope(|scope| {
        let served = scope.spawn(|| publisher.serve(ours, SOON));
        let subscriber = Subscriber::connect(context, theirs, SubscriberOptions::new(qos), SOON);
        (served.join().unwrap(), subscriber)
    })
}

pub(super) fn publisher(context: &Context, qos: Qos) -> Publisher {
    Publisher::new(context, PublisherOptions::new(qos).max_len(MAX)).unwrap()
}

#[test]
fn one_publisher_serves_many_in_the_same_context_and_in_others() {
    let (here, there) = (Context::new().unwrap(), Context::new().unwrap());
    let publisher = publisher(&here, keep_last(5));
    let mut subscribers: Vec<_> = [&here, &there, &there]
        .map(|context| {
            let (served, subscriber) = together(&publisher, context, keep_last(5));
            let subscriber = subscriber.unwrap();
            assert_eq!(served.unwrap(), subscriber.gid());
            subscriber
        })
        .into();
    assert_eq!(publisher.subscribers().len(), 3);
    for (sequence, len) in [0, 10, 1000, 5000, MAX as usize].into_iter().enumerate() {
        let sequence = sequence as u64 + 1;
        assert_eq!(publisher.publish(&pattern(sequence, len)).unwrap(), sequence);
        for subscriber in &mut subscribers {
            let sample = subscriber.recv(SOON).unwrap().unwrap();
            assert_eq!((sample.meta().sequence, sample.len()), (sequence, len));
            let mut bytes = Vec::new();
            sample.copy_to(&mut bytes).unwrap();
            assert!(bytes == pattern(sequence, len));
        }
    }
    assert!(publisher.reap().is_empty());
    let kept = {
        publisher.publish(&pattern(9, 5000)).unwrap();
        subscribers[1].take().unwrap().unwrap()
    };
    let gone = subscribers.remove(1).gid();
    assert_eq!(publisher.reap(), [gone]);
    drop(kept);
    assert!(publisher.dismiss(subscribers[0].gid()));
    assert!(!publisher.dismiss(gone));
    assert_eq!(publisher.subscribers(), [subscribers[1].gid()]);
}

#[test]
fn a_receiver_sleeps_until_there_is_something_or_its_time_is_over() {
    let (here, there) = (Context::new().unwrap(), Context::new().unwrap());
    let publisher = publisher(&here, Qos::keep_all());
    let mut subscriber = together(&publisher, &there, Qos::keep_all()).1.unwrap();
    assert!(subscriber.recv(Some(Duration::from_millis(5))).unwrap().is_none());
    assert!(subscriber.recv(Some(Duration::ZERO)).unwrap().is_none());
    thread::scope(|scope| {
        scope.spawn(|| {
            for number in 1..=500 {
                while publisher.publish(&pattern(number, 6000)).is_err() {}
            }
        });
        for number in 1..=500 {
            let sample = subscriber.recv(SOON).unwrap().expect("a sample");
            assert_eq!(sample.meta().sequence, number);
        }
    });
    assert_eq!((subscriber.received(), subscriber.lost()), (500, 0));
    assert!(!subscriber.publisher_ended());
}

#[test]
fn an_event_loop_is_told_of_samples() {
    let (here, there) = (Context::new().unwrap(), Context::new().unwrap());
    let publisher = publisher(&here, keep_last(1));
    let mut subscriber = together(&publisher, &there, keep_last(1)).1.unwrap();
    let event = there.event().unwrap();
    for number in 1..=100 {
        event.clear();
        event.arm(false);
        assert!(!subscriber.has_data());
        publisher.publish(b"x").unwrap();
        let mut fds = [PollFd::from_borrowed_fd(event.as_fd(), PollFlags::IN)];
        assert_eq!(poll(&mut fds, Some(&EVER.try_into().unwrap())), Ok(1));
        assert_eq!(subscriber.take().unwrap().unwrap().meta().sequence, number);
    }
}

#[test]
fn incompatible_qos_is_reported_at_both_ends() {
    let context = Context::new().unwrap();
    let offered = Qos { reliability: Reliability::BestEffort, ..Qos::default() };
    let requested = Qos { reliability: Reliability::Reliable, ..Qos::default() };
    let publisher = publisher(&context, offered);
    let (served, subscriber) = together(&publisher, &context, requested);
    assert!(matches!(served, Err(ConnectError::Incompatible(_))));
    let Err(ConnectError::Refused(reason)) = subscriber else { panic!("{subscriber:?}") };
    assert!(reason.contains("RELIABILITY"), "{reason}");
    assert!(publisher.subscribers().is_empty());
}

#[test]
fn misbehaving_peers_are_refused_at_connect() {
    let context = Context::new().unwrap();
    let publisher = publisher(&context, Qos::default());
    let options = SubscriberOptions::new(Qos::default());
    let soon = Some(Duration::from_millis(5));
    // A silent peer, and a closed socket.
    let (ours, theirs) = pair();
    assert!(matches!(publisher.serve(&ours, soon), Err(ConnectError::Timeout)));
    let silent = Subscriber::connect(&context, &theirs, options, soon);
    assert!(matches!(silent, Err(ConnectError::Timeout)));
    let (ours, theirs) = pair();
    drop(theirs);
    assert!(matches!(publisher.serve(&ours, soon), Err(ConnectError::Closed)));
    let closed = Subscriber::connect(&context, &ours, options, soon);
    assert!(matches!(closed, Err(ConnectError::Closed)));
    // Invalid data: as packets, and as a stream.
    for noise in [&b""[..], b"x", &[0x82, 3, 0], &[0x82, 2, 0x82, 7, 0x80], &[0xff; 2000]] {
        let (ours, theirs) = UnixDatagram::pair().unwrap();
        theirs.send(noise).unwrap();
        let served = publisher.serve(&ours, soon);
        assert!(
            matches!(served, Err(ConnectError::Protocol(_) | ConnectError::Closed)),
            "{served:?}"
        );
    }
    let (ours, mut theirs) = UnixStream::pair().unwrap();
    std::io::Write::write_all(&mut theirs, &[0xff; 100]).unwrap();
    assert!(matches!(publisher.serve(&ours, soon), Err(ConnectError::Protocol(_))));
    // A request with the descriptors of another session, and one with a GID of another session.
    let (ours, theirs) = UnixDatagram::pair().unwrap();
    let (a, b) = (SessionId::random(), SessionId::random());
    for reader in [Gid::new(a, 1), Gid::new(b, 1)] {
        let lane = Location { segment: 0, offset: 4096 };
        let asked = connect::AttachRequest { session: a, reader, lane, qos: Qos::default() };
        let channel = connect::ConnectChannel::new(theirs.as_fd(), soon);
        let (_, line) = connect::line().unwrap();
        channel.ask(&asked, &context.session().descriptors().unwrap(), line).unwrap();
        assert!(publisher.serve(&ours, soon).is_err());
        // The subscriber is told.
        assert!(channel.await_granted(reader).is_err());
    }
    assert!(publisher.subscribers().is_empty());
}

#[test]
fn an_answer_that_comes_too_late_is_not_taken_for_the_next() {
    let (here, there) = (Context::new().unwrap(), Context::new().unwrap());
    let publisher = publisher(&here, Qos::default());
    let (ours, theirs) = pair();
    let options = SubscriberOptions::new(Qos::default());
    let soon = Some(Duration::from_millis(5));
    let late = Subscriber::connect(&there, &theirs, options, soon);
    assert!(matches!(late, Err(ConnectError::Timeout)));
    publisher.serve(&ours, soon).unwrap();
    thread::scope(|scope| {
        scope.spawn(|| publisher.serve(&ours, SOON));
        let mut subscriber = Subscriber::connect(&there, &theirs, options, SOON).unwrap();
        publisher.publish(b"x").unwrap();
        assert_eq!(subscriber.recv(SOON).unwrap().unwrap().len(), 1);
        // The subscriber of the late answer was never connected.
        assert_eq!(publisher.reap().len(), 1);
        assert_eq!(publisher.subscribers(), [subscriber.gid()]);
    });
}
