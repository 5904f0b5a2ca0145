//! Sessions that share no memory, together with sessions that do.

mod backlog;
mod calls_killed;
mod hostile;
mod killed;
mod left;
mod life;
mod refused;
mod services;
mod simulated_daemon;
#[allow(dead_code, reason = "for the tests of daemons too")]
#[path = "../support/mod.rs"]
mod support;
mod talker;
mod time;

use std::{
    collections::HashMap,
    os::fd::{AsFd, OwnedFd},
    sync::atomic::{AtomicBool, AtomicU32, Ordering},
    thread,
    time::{Duration, Instant, SystemTime},
};

use axon_shm::PublishError;
use axon_transport::{
    EndpointSpec, Publisher, Session, SessionOptions, Subscription,
    config::{Config, DaemonPolicy, security_settings},
    graph::{Endpoint, EndpointKind},
    ids::{Gid, SessionId},
    internal::{
        session::daemon::{
            address::Address,
            socket::{self, SocketError},
        },
        wire::session::{
            Announce, Asserted, Credit, EndpointRole, PROTOCOL, RelayGivenUp, RelayMatched,
            SampleFragment, SampleHeader, SessionHello, SessionMessage, SessionRefused,
            SessionRole,
        },
    },
    qos::{Durability, History, Qos, Reliability},
    status::{RelayStatus, Status},
};
use hostile::{say_to, stop};
use rustix::process::Signal;
use support::{Host, Kept, PATIENCE, of_child, say, signal, until, wait_for_the_end};

/// Lengths around each limit at which samples are stored or carried in another way, and an image.
const SIZES: [usize; 10] = [0, 1, 96, 97, 4096, 4097, 31 << 10, 32 << 10, 64 << 10, 25_000_000];

fn spec(topic: &str, qos: Qos) -> EndpointSpec {
    EndpointSpec::new(topic, "test/Bytes", qos)
}

fn best_effort(depth: u32) -> Qos {
    Qos::default().with_reliability(Reliability::BestEffort).with_depth(depth)
}

fn latched(depth: u32) -> Qos {
    Qos::default().with_durability(Durability::TransientLocal).with_depth(depth)
}

/// For both ends of a test: true if the end shares memory with its daemon.
const ENDS: [(bool, bool); 3] = [(false, true), (true, false), (false, false)];

/// A host whose publishers keep little, so that the buffers on the way are soon full.
fn host() -> Host {
    Host::new().with("AXON_RING_BUFFER_SIZE_MB", "4")
}

/// Opens a session that shares memory with the daemon of `host`, or does not.
fn session(host: &Host, name: &str, shm: bool) -> Session {
    let mut config = host.config();
    (config.daemon, config.shm) = (DaemonPolicy::Require, shm);
    Session::open(&config, SessionOptions::new(name)).unwrap()
}

/// Returns a host whose processes are relayed by the daemon of `host`. It must outlive those processes.
fn relaying(host: &Host) -> Host {
    let relaying = Host { env: host.env.clone(), dir: tempfile::tempdir().unwrap() };
    relaying.with("AXON_SHM", "off").with("AXON_DAEMON", "require")
}

/// Runs a test with two sessions, for each choice in [`ENDS`].
fn with_both_ends(test: impl Fn(&Session, &Session)) {
    let host = host();
    let _daemon = host.daemon();
    between([&host, &host], test);
}

/// Like [`with_both_ends`], with the sessions on two hosts.
fn between([here, there]: [&Host; 2], test: impl Fn(&Session, &Session)) {
    for (one, other) in ENDS {
        test(&session(here, "one", one), &session(there, "other", other));
    }
}

fn pattern(sequence: u64, len: usize) -> Vec<u8> {
    (0..len as u64).map(|at| (at ^ sequence) as u8).collect()
}

/// Sends something, and retries as long as it is held back: the reader is slow, and KEEP_ALL waits.
fn patiently<T>(mut send: impl FnMut() -> Result<T, PublishError>) -> T {
    let deadline = Instant::now() + PATIENCE;
    loop {
        match send() {
            Ok(sent) => return sent,
            Err(PublishError::Blocked { .. }) => assert!(Instant::now() < deadline, "for ever"),
            Err(error) => panic!("{error}"),
        }
    }
}

/// Sends numbered messages until one is held back. Returns how many were sent.
fn fill<T>(mut send: impl FnMut(u64) -> Result<T, PublishError>) -> u64 {
    for number in 1..20_000 {
        match send(number) {
            Ok(_) => {}
            Err(PublishError::Blocked { .. }) => return number - 1,
            Err(error) => panic!("{error}"),
        }
    }
    panic!("nothing holds it back");
}

fn publish(publisher: &Publisher, payload: &[u8]) -> u64 {
    patiently(|| publisher.publish(payload))
}

fn connect(from: &Session, to: &Session, topic: &str, qos: Qos) -> (Publisher, Subscription) {
    let publisher = from.create_publisher(spec(topic, qos)).unwrap();
    let subscription = to.create_subscription(spec(topic, qos)).unwrap();
    await_pair(&publisher, &subscription);
    (publisher, subscription)
}

fn await_pair(publisher: &Publisher, subscription: &Subscription) {
    until("the publisher counts the subscription", || {
        publisher.matched().contains(&subscription.gid())
    });
    until("the subscription counts the publisher", || {
        subscription.matched().contains(&publisher.gid())
    });
}

/// Opens the channel of a publisher or client to a peer that has received `heard` MATCHED messages.
fn open_for(publisher: Gid, heard: u64) -> Credit {
    Credit { publisher, bytes: 1000, opens: Some(heard), client: None, done: None }
}

/// Takes samples until `last`, and returns their sequence numbers.
fn take_until(subscription: &Subscription, last: u64) -> Vec<u64> {
    let (mut taken, mut bytes) = (Vec::new(), Vec::new());
    while taken.last() != Some(&last) {
        let info = subscription.recv(&mut bytes, Some(PATIENCE)).expect("a sample in time");
        assert_eq!(bytes, pattern(info.sequence, bytes.len()));
        taken.push(info.sequence);
    }
    taken
}

fn relays(status: &Status) -> Vec<RelayStatus> {
    status.sessions.iter().filter_map(|s| s.relay.clone()).collect()
}

/// The code of the children of the tests. It does nothing in a run of the tests themselves.
#[test]
fn child() {
    let Ok(part) = std::env::var("PLAY") else { return };
    let session = of_child(&part);
    match part.as_str() {
        "talker" => talker::talk(&session),
        // Publishes a little and ends.
        "brief" => {
            let publisher = session.create_publisher(spec("/t", Qos::keep_all())).unwrap();
            assert!(publisher.wait_matched(1, PATIENCE));
            for sequence in 1..=300 {
                publish(&publisher, &pattern(sequence, 10_000));
            }
        }
        // Takes nothing.
        "deaf" => {
            let subscription = session.create_subscription(spec("/t", Qos::keep_all())).unwrap();
            assert!(subscription.wait_matched(1, PATIENCE));
            say("matched");
            wait_for_the_end();
        }
        // Only stays alive.
        "alive" => {
            let publisher = session.create_publisher(spec("/t", time::automatic_lease())).unwrap();
            say("there");
            wait_for_the_end();
            drop(publisher);
        }
        "leaver" => {
            say("there");
            std::io::stdin().read_line(&mut String::new()).unwrap();
            say(hostile::call_and_leave());
        }
        "publisher that ends" => killed::publish_and_end(&session),
        "publisher by hand" => hostile::publish_when_told(),
        "one that has another talk" => say(hostile::call_and_have_it_talk()),
        "caller" => {
            let client = session.create_client(services::service()).unwrap();
            assert!(client.wait_available(PATIENCE));
            for number in 0..services::CALLS {
                services::call(
                    &client,
                    &pattern(number, if number % 7 == 0 { 40_000 } else { 20 }),
                );
            }
            say("complete");
            wait_for_the_end();
        }
        // Sends requests and never takes a response.
        "asker" => {
            let client = session.create_client(services::service()).unwrap();
            assert!(client.wait_available(PATIENCE));
            for _ in 0..services::CALLS {
                client.send_request(b"x").unwrap();
            }
            say("asked");
            wait_for_the_end();
        }
        // Answers one request and is in the middle of the next.
        "server" => {
            let server = session.create_server(services::service()).unwrap();
            say("serves");
            services::answer(&server);
            server.recv_request(&mut Vec::new(), Some(PATIENCE)).unwrap();
            say("took");
            wait_for_the_end();
        }
        _ => unreachable!("no such part: {part}"),
    }
}

#[test]
fn samples_of_all_sizes_cross_whole_and_in_order_whichever_side_shares_memory() {
    with_both_ends(|from, to| {
        let (publisher, subscription) = connect(from, to, "/t", Qos::keep_all());
        let mut bytes = Vec::new();
        for (number, len) in (0..).zip(SIZES.iter().chain(SIZES.iter().rev())) {
            let payload = pattern(number, *len);
            let time = SystemTime::UNIX_EPOCH + Duration::from_nanos(1_000 + number);
            assert_eq!(publisher.publish_at(time, &payload).unwrap(), number + 1);
            let info = subscription.recv(&mut bytes, Some(PATIENCE)).expect("a sample in time");
            assert!(bytes == payload, "{len} bytes");
            let expected = (publisher.gid(), number + 1, time);
            assert_eq!((info.publisher, info.sequence, info.source_timestamp), expected);
        }
        assert_eq!(subscription.lost(), 0);
    });
}

#[test]
fn keep_all_holds_its_publisher_back_and_loses_nothing() {
    with_both_ends(|from, to| {
        let (publisher, subscription) = connect(from, to, "/t", Qos::keep_all());
        let len = 50_000;
        // All buffers on the way are full before the first sample is taken.
        let last = fill(|number| publisher.publish(&pattern(number, len)));
        let more = last + 200;
        thread::scope(|scope| {
            scope.spawn(|| {
                for sequence in last + 1..=more {
                    assert_eq!(publish(&publisher, &pattern(sequence, len)), sequence);
                }
            });
            assert!(take_until(&subscription, more).into_iter().eq(1..=more));
        });
        assert_eq!(subscription.lost(), 0);
    });
}

#[test]
fn a_late_joiner_gets_the_history_once() {
    let host = host();
    let _daemon = host.daemon();
    for (from_shares, to_shares) in ENDS {
        let from = session(&host, "from", from_shares);
        let [one, two] = ["one", "two"].map(|name| session(&host, name, to_shares));
        let publisher = from.create_publisher(spec("/t", latched(3))).unwrap();
        for sequence in 1..=5 {
            publish(&publisher, &pattern(sequence, 5_000));
        }
        let joiner = one.create_subscription(spec("/t", latched(10))).unwrap();
        await_pair(&publisher, &joiner);
        // If the publisher is relayed, its first samples may still be in flight when the subscription joins.
        let history = take_until(&joiner, 5);
        assert!(history.ends_with(&[3, 4, 5]) && history.is_sorted_by(|a, b| a < b), "{history:?}");
        assert!(!from_shares || history.len() == 3, "{history:?}");
        let volatile = two.create_subscription(spec("/t", Qos::keep_all())).unwrap();
        await_pair(&publisher, &volatile);
        publish(&publisher, &pattern(6, 5_000));
        assert_eq!((take_until(&joiner, 6), take_until(&volatile, 6)), (vec![6], vec![6]));
        assert_eq!((joiner.lost(), volatile.lost()), (0, 0));
    }
}

#[test]
fn a_best_effort_publisher_never_blocks_and_losses_are_counted() {
    let host = host();
    let _daemon = host.daemon();
    for (from, to) in ENDS {
        let (from, to) = (session(&host, "from", from), session(&host, "to", to));
        let keeps = best_effort(1).with_history(History::KeepAll);
        let publisher = from.create_publisher(spec("/t", best_effort(4))).unwrap();
        let slow = to.create_subscription(spec("/t", keeps)).unwrap();
        await_pair(&publisher, &slow);
        let published = 400;
        for sequence in 1..=published {
            assert_eq!(publisher.publish(&pattern(sequence, 50_000)).unwrap(), sequence);
            // Before its first sample, a subscription does not know which samples came before.
            if sequence == 1 {
                assert_eq!(take_until(&slow, 1), [1]);
            }
        }
        // The last samples arrive for certain, and with them the count of losses before.
        let taken = 1 + take_until(&slow, published).len() as u64;
        assert!(taken < published, "nothing was lost that could be counted");
        assert_eq!(taken + slow.lost(), published);
        drop((from, to, publisher, slow));
        until("both are gone", || host.status().unwrap().sessions.len() == 1);
    }
}

#[test]
fn a_sample_that_the_daemon_has_not_taken_is_not_acknowledged() {
    let host = host();
    let daemon = host.daemon();
    let (from, to) = (session(&host, "from", false), session(&host, "to", true));
    let (publisher, subscription) = connect(&from, &to, "/t", Qos::default());
    publish(&publisher, &pattern(1, 10));
    assert!(publisher.wait_acknowledged(PATIENCE));
    stop(&daemon);
    publish(&publisher, &pattern(2, 10));
    assert!(!publisher.wait_acknowledged(Duration::from_millis(50)));
    signal(daemon.0.id(), Signal::CONT);
    assert!(publisher.wait_acknowledged(PATIENCE));
    // The sample is where a subscription finds it right now.
    assert!(subscription.has_data());
    assert_eq!(take_until(&subscription, 2), [1, 2]);
}

#[test]
fn a_reader_that_takes_nothing_blocks_no_other_topic() {
    let host = host();
    let _daemon = host.daemon();
    let (from, to) = (session(&host, "from", true), session(&host, "to", false));
    let (stuck, never) = connect(&from, &to, "/stuck", Qos::keep_all());
    fill(|_| stuck.publish(&vec![0; 1_000_000]));
    let (image, slow) = connect(&from, &to, "/image", best_effort(1));
    let (twist, quick) = connect(&from, &to, "/twist", Qos::keep_all());
    for sequence in 1..=100 {
        assert_eq!(image.publish(&pattern(sequence, 2_000_000)).unwrap(), sequence);
        publish(&twist, &pattern(sequence, 52));
        assert_eq!(take_until(&quick, sequence), [sequence]);
    }
    assert_eq!(take_until(&slow, 100).last(), Some(&100));
    let mut bytes = Vec::new();
    assert!(never.recv(&mut bytes, Some(PATIENCE)).is_ok(), "and it may still go on");
}

#[test]
fn local_samples_stay_in_the_process_and_remote_samples_cross_once() {
    let host = host();
    let _daemon = host.daemon();
    let (relayed, other) = (session(&host, "relayed", false), session(&host, "other", true));
    let (publisher, subscription) = connect(&relayed, &relayed, "/inside", Qos::keep_all());
    publish(&publisher, &pattern(1, 10));
    assert_eq!(take_until(&subscription, 1), [1]);
    let count = |of: fn(&RelayStatus) -> u64| relays(&host.status().unwrap()).iter().map(of).sum();
    assert_eq!((count(|r| r.samples_in), count(|r| r.samples_out)), (0, 0));

    // The readers in the same session and in another one get the same samples.
    let outside = other.create_subscription(spec("/inside", Qos::keep_all())).unwrap();
    await_pair(&publisher, &outside);
    publish(&publisher, &pattern(2, 10));
    assert_eq!(take_until(&subscription, 2), [2]);
    assert_eq!(take_until(&outside, 2), [2]);

    let (publisher, first) = connect(&other, &relayed, "/outside", Qos::keep_all());
    let second = relayed.create_subscription(spec("/outside", best_effort(10))).unwrap();
    await_pair(&publisher, &second);
    publish(&publisher, &pattern(1, 10));
    assert_eq!((take_until(&first, 1), take_until(&second, 1)), (vec![1], vec![1]));
    assert_eq!((count(|r| r.samples_in), count(|r| r.samples_out)), (1, 1));
    drop(first);
    until("one is gone", || publisher.matched() == [second.gid()]);
    publish(&publisher, &pattern(2, 10));
    assert_eq!(take_until(&second, 2), [2]);
}

#[test]
fn samples_relayed_for_an_ended_subscription_are_not_lost_for_another() {
    let host = host();
    let _daemon = host.daemon();
    let (from, to) = (session(&host, "from", true), session(&host, "to", false));
    let (publisher, one) = connect(&from, &to, "/t", Qos::keep_all());
    let other = to.create_subscription(spec("/t", Qos::keep_all())).unwrap();
    await_pair(&publisher, &other);
    let last = fill(|number| publisher.publish(&pattern(number, 50_000)));
    // The daemon takes the samples from one of the two; this covers either case.
    let (ends, stays) = if one.gid() < other.gid() { (one, other) } else { (other, one) };
    drop(ends);
    assert!(take_until(&stays, last).into_iter().eq(1..=last));
    assert_eq!(stays.lost(), 0);
}

#[test]
fn a_relay_passes_over_no_more_than_each_publisher_does() {
    let host = host();
    let _daemon = host.daemon();
    let (from, to) = (session(&host, "from", false), session(&host, "to", true));
    let keeps = best_effort(1).with_history(History::KeepAll);
    let subscription = to.create_subscription(spec("/t", keeps)).unwrap();
    let little = from.create_publisher(spec("/t", best_effort(1))).unwrap();
    await_pair(&little, &subscription);
    let much = from.create_publisher(spec("/t", best_effort(500))).unwrap();
    await_pair(&much, &subscription);
    let lost_on_the_way = || relays(&host.status().unwrap()).iter().map(|r| r.lost).sum::<u64>();
    for sequence in 1..=500 {
        assert_eq!(much.publish(&pattern(sequence, 1000)).unwrap(), sequence);
    }
    assert!(take_until(&subscription, 500).into_iter().eq(1..=500));
    assert_eq!((subscription.lost(), lost_on_the_way()), (0, 0));
}

#[test]
fn the_graph_is_the_same_for_all() {
    let host = host();
    let _daemon = host.daemon();
    let relayed = session(&host, "relayed", false);
    let other = session(&host, "other", true);
    let _node = relayed.create_node("inside", "/", "/").unwrap();
    let _other_node = other.create_node("outside", "/", "/").unwrap();
    let publisher = relayed.create_publisher(spec("/p", Qos::default())).unwrap();
    let subscription = other.create_subscription(spec("/s", Qos::default())).unwrap();
    for session in [&relayed, &other] {
        let all = session.wait_graph(PATIENCE, |graph| {
            graph.nodes().len() == 2
                && [publisher.gid(), subscription.gid()]
                    .iter()
                    .all(|gid| graph.endpoints.contains_key(gid))
        });
        assert!(all);
    }
    let (published, subscribed) = (publisher.gid(), subscription.gid());
    drop((publisher, subscription));
    for session in [&relayed, &other] {
        assert!(session.wait_graph(PATIENCE, |graph| {
            ![published, subscribed].iter().any(|gid| graph.endpoints.contains_key(gid))
        }));
    }
    let text = relayed.status_json().unwrap();
    assert!(text.contains("AXON_SHM is off"), "{text}");
}

#[test]
fn the_status_names_relayed_sessions_and_the_reason() {
    let host = host();
    let _daemon = host.daemon();
    let _sharing = session(&host, "sharing", true);
    let _relayed = session(&host, "relayed", false);
    let status = host.status().unwrap();
    let of = |name: &str| status.sessions.iter().find(|s| s.name == name).unwrap();
    assert_eq!(of("sharing").relay, None);
    assert_eq!(of("relayed").pid, std::process::id());
    assert_eq!(of("relayed").relay.as_ref().unwrap().reason, "AXON_SHM is off");
}

/// Creates two hosts that find each other.
fn two_hosts() -> [Host; 2] {
    // Pairs of tests that run at the same time must not find each other.
    static PAIRS: AtomicU32 = AtomicU32::new(1);
    let pair = 2 * PAIRS.fetch_add(1, Ordering::Relaxed);
    let pid = std::process::id();
    let net = 1 + pid % 250;
    [pair, pair + 1].map(|number| {
        host()
            .with("AXON_BIND_ADDRS", &format!("127.98.{net}.{number}"))
            .with("ROS_STATIC_PEERS", &format!("127.98.{net}.{}", number ^ 1))
            .with("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
            .with("ROS_DOMAIN_ID", &(1 + pid % 98).to_string())
    })
}

#[test]
fn another_host_reaches_a_relayed_session_and_is_reached() {
    let hosts = two_hosts();
    let _daemons = [hosts[0].daemon(), hosts[1].daemon()];
    let (here, there) = (session(&hosts[0], "here", false), session(&hosts[1], "there", false));
    for (from, to) in [(&here, &there), (&there, &here)] {
        let topic = format!("/of/{}", from.id());
        let (publisher, subscription) = connect(from, to, &topic, Qos::keep_all());
        for (number, len) in (1..).zip([0, 96, 5_000, 1_000_000]) {
            publish(&publisher, &pattern(number, len));
            assert_eq!(take_until(&subscription, number), [number]);
        }
        assert_eq!(subscription.lost(), 0);
    }
}
