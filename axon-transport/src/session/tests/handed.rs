//! Memory of large samples that a reader needs, and that a killed daemon may not have sent to it.

use rustix::process::{Pid, PidfdFlags, pidfd_open};

use super::{simulated_daemon::Taker, *};
use crate::wire::session::Fence;

/// Waits for the session's next fence. Also returns whether the session announced memory before it.
fn hear_fence(daemon: &Daemon) -> (Fence, bool) {
    let mut told = false;
    let fence = daemon.hear(|message| match message {
        SessionMessage::Segment(_) => {
            told = true;
            None
        }
        SessionMessage::Fence(fence) => Some(fence),
        _ => None,
    });
    (fence, told)
}

#[test]
fn sample_is_delivered_after_its_segment() {
    let (session, daemon) = session();
    let spec = EndpointSpec::new("/p", "test/Bytes", Qos::keep_all());
    let publisher = session.create_publisher(spec).unwrap();
    let taker = Taker::new();
    let _taking = taker.attach(&publisher, None, &daemon);
    publisher.publish(b"small").unwrap();
    assert_eq!(publisher.delivered_up_to(), 0, "its grant may not have been sent");
    let (granted, _) = hear_fence(&daemon);
    assert_eq!(granted.writer, publisher.gid());
    daemon.say(SessionMessage::Fence(granted), &[]);
    until("it was", || publisher.delivered_up_to() == 1);

    publisher.publish(&[1; LARGE]).unwrap();
    assert_eq!(publisher.delivered_up_to(), 1);
    let (opened, told) = hear_fence(&daemon);
    assert!(told && opened.number > granted.number);
    daemon.say(SessionMessage::Fence(granted), &[]);
    // An answer wakes the threads that wait for room, and they ask once more.
    publisher.publish(b"small").unwrap();
    thread::sleep(Duration::from_millis(20));
    assert_eq!(publisher.delivered_up_to(), 1, "that was an answer to something else");
    daemon.say(SessionMessage::Fence(opened), &[]);
    until("both were", || publisher.delivered_up_to() == 3);
    // The daemon knows the memory of this sample by now.
    publisher.publish(&[2; LARGE / 2]).unwrap();
    assert_eq!(publisher.delivered_up_to(), 4);
}

#[test]
fn a_fence_answer_counts_for_samples_before_the_fence_despite_later_samples() {
    let (session, daemon) = session();
    let spec = EndpointSpec::new("/p", "test/Bytes", Qos::keep_all());
    let publisher = session.create_publisher(spec).unwrap();
    let _first = Taker::new().attach(&publisher, None, &daemon);
    publisher.publish(b"x").unwrap();
    assert_eq!(publisher.delivered_up_to(), 0);
    let (asked, _) = hear_fence(&daemon);
    let _second = Taker::new().attach(&publisher, None, &daemon);
    publisher.publish(b"x").unwrap();
    assert_eq!(publisher.delivered_up_to(), 0, "the grant of the second may not have been sent");
    daemon.say(SessionMessage::Fence(asked), &[]);
    until("the first sample was", || publisher.delivered_up_to() == 1);
    let (again, _) = hear_fence(&daemon);
    assert!(again.number > asked.number);
    daemon.say(SessionMessage::Fence(again), &[]);
    until("the second was", || publisher.delivered_up_to() == 2);
    // A daemon that sends the whole graph again may have dropped its answer.
    publisher.publish(&[1; LARGE]).unwrap();
    assert_eq!(publisher.delivered_up_to(), 2);
    hear_fence(&daemon);
    daemon.tell_all(Vec::new());
    until("it is asked once more", || {
        let _ = publisher.delivered_up_to();
        let heard = socket::receive(&daemon.socket, &mut Vec::new());
        heard.is_ok_and(|heard| matches!(heard.message, SessionMessage::Fence(_)))
    });
}

/// A process that only lives until it is killed.
struct Process(std::process::Child);

impl Process {
    fn start() -> Self {
        Self(Command::new("sleep").arg("1000").spawn().unwrap())
    }

    fn descriptor(&self) -> OwnedFd {
        let pid = Pid::from_child(&self.0);
        pidfd_open(pid, PidfdFlags::empty()).unwrap()
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Creates a session's publisher that stands for a publisher of a process without shared memory, as the daemon that is
/// `process` creates it.
fn stands_in(id: SessionId, daemon: &Daemon, process: &Process) -> (Far, Vec<OwnedFd>) {
    let session = SessionSegment::create(id).unwrap();
    let view = PeerSession::map(daemon.id, daemon.handed.try_clone().unwrap()).unwrap();
    let far = Far::with(1, session, RingPeer::Remote(view));
    let mut introduction = far.introduction();
    introduction[2] = process.descriptor();
    (far, introduction)
}

fn grant(far: &Far, introduction: &[OwnedFd], subscription: &Subscription, daemon: &Daemon) {
    daemon.say(SessionMessage::Match(far.pair(subscription)), &[]);
    let granted = Granted { relayed: Some(true), ..far.grant(&daemon.hear_attach()) };
    let introduction: Vec<_> = introduction.iter().map(AsFd::as_fd).collect();
    daemon.say(SessionMessage::Grant(granted), &introduction);
}

#[test]
fn samples_not_handed_over_come_once_through_the_next_daemon() {
    a_daemon_is_killed_whose_memory(false);
}

#[test]
fn memory_that_came_since_it_was_looked_for_is_read_after_the_daemons_death() {
    a_daemon_is_killed_whose_memory(true);
}

/// Kills a daemon. `comes` says whether the memory of the last samples arrives before. If so, they are confirmed, and
/// do not come again.
fn a_daemon_is_killed_whose_memory(comes: bool) {
    let (session, daemon) = session();
    let subscription = subscription(&session);
    let (id, first) = (SessionId::random(), Process::start());
    let (far, introduction) = stands_in(id, &daemon, &first);
    grant(&far, &introduction, &subscription, &daemon);
    assert!(subscription.wait_matched(1, EVER));
    far.publish(1, b"x");
    assert_eq!(take(&subscription), Some(1));
    far.publish(2, &[2; LARGE]);
    far.publish(3, b"x");
    assert_eq!(take(&subscription), None, "its memory was not handed over");
    if comes {
        far.hand(1, &daemon);
    }
    drop(first);
    until("it is known to be dead", || subscription.matched().is_empty());

    let second = Process::start();
    let (far, introduction) = stands_in(id, &daemon, &second);
    grant(&far, &introduction, &subscription, &daemon);
    assert!(subscription.wait_matched(1, EVER));
    if !comes {
        far.publish(2, &[2; LARGE]);
        far.publish(3, b"x");
        far.hand(1, &daemon);
    }
    far.publish(4, b"x");
    let mut taken = Vec::new();
    until("the last", || {
        taken.extend(take(&subscription));
        taken.last() == Some(&4)
    });
    assert_eq!((taken, subscription.lost()), (vec![2, 3, 4], 0));
    // No sample is left that would be given up, and counted, later.
    assert_eq!(subscription.inner.lock().slots().look_again(), None);
}
