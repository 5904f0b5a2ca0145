//! Processes and daemons that end, and sessions that find out that they have to be relayed.

use rustix::{io::Errno, net::RecvFlags};

use super::*;

#[test]
fn a_process_that_is_killed_leaves_whole_samples_and_nothing_else() {
    let host = host();
    let _daemon = host.daemon();
    let (relaying, listener) = (relaying(&host), session(&host, "listener", true));
    let subscription = listener.create_subscription(spec("/t", Qos::keep_all())).unwrap();
    let talker = relaying.play("talker");
    assert_eq!(take_until(&subscription, 100).len(), 100);
    signal(talker.pid(), Signal::KILL);
    until("it is gone", || subscription.matched().is_empty());
    talker::take_rest_of_talker(&host, &subscription);
    drop(talker);

    let publisher = listener.create_publisher(spec("/t", Qos::keep_all())).unwrap();
    drop(subscription);
    let mut deaf = relaying.play("deaf");
    assert_eq!(deaf.hear(), "matched");
    fill(|_| publisher.publish(&vec![0; 1_000_000]));
    signal(deaf.pid(), Signal::KILL);
    patiently(|| publisher.publish(&vec![0; 1_000_000]));
    until("nobody is relayed any more", || relays(&host.status().unwrap()).is_empty());
}

#[test]
fn samples_of_a_killed_process_for_a_stalled_reader_are_eventually_discarded() {
    let host = host();
    let _daemon = host.daemon();
    let (relaying, listener) = (relaying(&host), session(&host, "listener", true));
    let subscription = listener.create_subscription(spec("/t", Qos::keep_all())).unwrap();
    let talker = relaying.play("talker");
    let crossed = || relays(&host.status().unwrap()).iter().map(|r| r.samples_in).sum::<u64>();
    let mut before = 0;
    until("it is held back", || {
        let now = crossed();
        now > 0 && std::mem::replace(&mut before, now) == now
    });
    drop(talker);
    until("nobody is relayed any more", || relays(&host.status().unwrap()).is_empty());
    until("it is not counted", || subscription.matched().is_empty());
    let mut bytes = Vec::new();
    let numbers = std::iter::from_fn(|| Some(subscription.take(&mut bytes)?.sequence));
    let numbers: Vec<u64> = numbers.collect();
    assert!(numbers.len() as u64 >= before && numbers.iter().copied().eq(1..=numbers.len() as u64));
}

#[test]
fn the_last_samples_of_an_ending_process_arrive() {
    let host = host();
    let _daemon = host.daemon();
    let (relaying, listener) = (relaying(&host), session(&host, "listener", true));
    let subscription = listener.create_subscription(spec("/t", Qos::keep_all())).unwrap();
    let brief = relaying.play("brief");
    brief.finish();
    assert!(take_until(&subscription, 300).into_iter().eq(1..=300));
    assert_eq!(subscription.lost(), 0);
}

#[test]
fn another_daemon_takes_over() {
    let host = host();
    let daemon = host.daemon();
    let (a, b, c) =
        (session(&host, "a", false), session(&host, "b", false), session(&host, "c", true));
    let publisher = a.create_publisher(spec("/t", latched(2))).unwrap();
    let readers = [&b, &c].map(|s| s.create_subscription(spec("/t", latched(2))).unwrap());
    readers.iter().for_each(|reader| await_pair(&publisher, reader));
    for sequence in 1..=2 {
        publish(&publisher, &pattern(sequence, 100));
    }
    readers.iter().for_each(|reader| assert_eq!(take_until(reader, 2), [1, 2]));
    let before = a.daemon();
    drop(daemon);
    until("it is noticed", || a.daemon() != before);
    until("the path is gone", || publisher.matched().is_empty());
    publish(&publisher, &pattern(3, 100));

    let _daemon = host.daemon();
    readers.iter().for_each(|reader| await_pair(&publisher, reader));
    publish(&publisher, &pattern(4, 100));
    for reader in &readers {
        assert_eq!(take_until(reader, 4), [3, 4], "nothing is repeated");
        assert_eq!(reader.lost(), 0);
    }
}

#[test]
fn without_a_daemon_to_be_relayed_by_it_is_an_error() {
    let host = host();
    let mut config = host.config();
    (config.daemon, config.shm) = (DaemonPolicy::Require, false);
    assert!(Session::open(&config, SessionOptions::new("alone")).is_err());
    config.daemon = DaemonPolicy::Off;
    let alone = Session::open(&config, SessionOptions::new("alone")).unwrap();
    let (publisher, subscription) = connect(&alone, &alone, "/t", Qos::default());
    publish(&publisher, &pattern(1, 10));
    assert_eq!(take_until(&subscription, 1), [1]);
    assert!(alone.wait_graph(PATIENCE, |graph| graph.endpoints.len() == 2));
}

/// Forwards packets between sessions and their daemon without descriptors.
fn keep_descriptors_back(listener: &OwnedFd, daemon: &Address, end: &AtomicBool) {
    let mut pairs: Vec<[OwnedFd; 2]> = Vec::new();
    while !end.load(Ordering::Relaxed) {
        let flags = rustix::net::SocketFlags::CLOEXEC | rustix::net::SocketFlags::NONBLOCK;
        if let Ok(caller) = rustix::net::accept_with(listener, flags) {
            pairs.push([caller, daemon.connect().unwrap()]);
        }
        pairs.retain(|[a, b]| pass_on(a, b) && pass_on(b, a));
        thread::sleep(Duration::from_millis(1));
    }
}

/// Forwards packets unchanged, including a session's key. Returns whether the connection is still
/// open.
fn pass_on(from: &OwnedFd, to: &OwnedFd) -> bool {
    let mut packet = vec![0; 1 << 20];
    for _ in 0..16 {
        // Without space for descriptors, so that the system closes them.
        match rustix::net::recv(from, &mut packet[..], RecvFlags::DONTWAIT) {
            Ok((0, _)) => return false,
            Ok((length, _)) => {
                while let Err(SocketError::NotReady) = socket::send(to, &packet[..length], &[]) {
                    thread::sleep(Duration::from_millis(1));
                }
            }
            Err(Errno::AGAIN) => return true,
            Err(_) => return false,
        }
    }
    true
}

#[test]
fn where_descriptors_do_not_arrive_a_session_is_relayed_by_itself() {
    let host = host();
    let _daemon = host.daemon();
    let behind = Host { env: host.env.clone(), dir: tempfile::tempdir().unwrap() };
    let run = behind.dir.path().join("run");
    let behind = behind.with("AXON_RUNTIME_DIR", run.to_str().unwrap());
    let (listeners, _lock) = Address::of(&behind.config()).bind().unwrap().into_parts();
    let (daemon, end) = (Address::of(&host.config()), AtomicBool::new(false));
    thread::scope(|scope| {
        scope.spawn(|| keep_descriptors_back(&listeners[0], &daemon, &end));
        let outcome = std::panic::catch_unwind(|| {
            let far = session(&behind, "behind", true);
            let near = session(&host, "near", true);
            let (publisher, subscription) = connect(&far, &near, "/t", Qos::keep_all());
            publish(&publisher, &pattern(1, 100_000));
            assert_eq!(take_until(&subscription, 1), [1]);
            let relayed = relays(&host.status().unwrap());
            assert!(relayed[0].reason.contains("descriptors"), "{relayed:?}");
        });
        end.store(true, Ordering::Relaxed);
        outcome.unwrap();
    });
}
