//! What a session does with its own endpoints, without a daemon.

use std::{path::Path, time::Duration};

use axon_transport::{
    config::{Config, DaemonPolicy, OsFiles},
    graph::EndpointKind,
    qos::Qos,
    session::{EndpointSpec, Publisher, Session, SessionError, SessionOptions, Subscription},
};

const PATIENCE: Duration = Duration::from_secs(60);

fn session() -> Session {
    let config = Config::resolve([], None, &OsFiles).unwrap();
    let config = Config { daemon: DaemonPolicy::Off, ..config };
    Session::open(&config, SessionOptions::new("test")).unwrap()
}

/// The nodes that `session` sees, with the topics that each publishes.
fn nodes(session: &Session) -> Vec<(String, Vec<String>)> {
    let graph = session.graph();
    let names = graph.nodes().into_iter().map(|node| {
        let published =
            graph.names_and_types_of(&node.name, &node.namespace, &[EndpointKind::Publisher]);
        (node.name, published.unwrap().into_keys().collect())
    });
    names.collect()
}

fn spec(qos: Qos) -> EndpointSpec {
    EndpointSpec::new("/t", "test/Bytes", qos)
}

fn drain(subscription: &Subscription) -> Vec<i64> {
    let mut bytes = Vec::new();
    std::iter::from_fn(|| subscription.take(&mut bytes).map(|info| info.source_timestamp)).collect()
}

fn publishers(session: &Session, count: usize, qos: Qos) -> Vec<Publisher> {
    (0..count).map(|_| session.create_publisher(spec(qos)).unwrap()).collect()
}

#[test]
fn an_endpoint_out_of_bounds_is_refused() {
    let session = session();
    let nameless = EndpointSpec::new("", "test/Bytes", Qos::default());
    let refused = session.create_publisher(nameless).unwrap_err();
    assert!(matches!(refused, SessionError::Endpoint { .. }));
    let bottomless = spec(Qos { depth: 0, ..Qos::default() });
    assert!(session.create_subscription(bottomless).is_err());
}

#[test]
fn a_node_is_in_the_graph_from_its_creation_to_its_end() {
    let session = session();
    for (name, namespace) in [("", "/"), ("n", &"x".repeat(513)), ("a\0b", "/")] {
        let refused = session.create_node(name, namespace, "/").unwrap_err();
        assert!(matches!(refused, SessionError::Node { .. }), "{refused}");
    }
    let idle = session.create_node("idle", "/", "/").unwrap();
    let twins = [0, 1].map(|_| session.create_node("twin", "/", "/").unwrap());
    let publisher = twins[1].create_publisher(spec(Qos::default())).unwrap();
    let expect = |expected: &[(&str, &[&str])]| {
        let expected: Vec<(String, Vec<String>)> = expected
            .iter()
            .map(|(n, topics)| ((*n).into(), topics.iter().map(|t| (*t).into()).collect()))
            .collect();
        let reached = session.wait_graph(PATIENCE, |_| nodes(&session) == expected);
        assert!(reached, "{:?} instead of {expected:?}", nodes(&session));
    };
    // A query by name unites nodes of one name.
    expect(&[("idle", &[]), ("twin", &["/t"]), ("twin", &["/t"])]);
    let [first, second] = twins;
    drop(first);
    expect(&[("idle", &[]), ("twin", &["/t"])]);
    drop((idle, publisher));
    expect(&[("twin", &[])]);
    drop(second);
    expect(&[]);
}

#[test]
fn publishers_are_merged_by_source_timestamp() {
    let session = session();
    let publishers = publishers(&session, 3, Qos::keep_all());
    let subscription = session.create_subscription(spec(Qos::keep_all())).unwrap();
    assert!(subscription.wait_matched(3, PATIENCE));
    for round in 0..10 {
        for (offset, publisher) in [2, 0, 1].iter().zip(&publishers) {
            publisher.publish_at(round * 3 + offset, b"x").unwrap();
        }
    }
    assert_eq!(drain(&subscription), (0..30).collect::<Vec<_>>());
    assert_eq!((subscription.received(), subscription.lost()), (30, 0));
}

#[test]
fn depth_counts_over_all_publishers_and_skipping_is_not_loss() {
    let session = session();
    let publishers = publishers(&session, 3, Qos::default());
    let subscription =
        session.create_subscription(spec(Qos { depth: 4, ..Qos::default() })).unwrap();
    assert!(subscription.wait_matched(3, PATIENCE));
    for time in 0..9 {
        publishers[usize::try_from(time).unwrap() % 3].publish_at(time, b"x").unwrap();
    }
    assert_eq!(drain(&subscription), [5, 6, 7, 8]);
    assert_eq!(subscription.lost(), 0);
}

#[test]
fn what_a_publisher_left_is_taken_after_its_end() {
    let session = session();
    let subscription = session.create_subscription(spec(Qos::keep_all())).unwrap();
    let publisher = session.create_publisher(spec(Qos::keep_all())).unwrap();
    assert!(subscription.wait_matched(1, PATIENCE));
    for time in 0..5 {
        publisher.publish_at(time, b"x").unwrap();
    }
    drop(publisher);
    assert!(session.wait_graph(PATIENCE, |graph| graph.endpoints.len() == 1));
    assert!(subscription.matched().is_empty());
    assert_eq!(drain(&subscription), [0, 1, 2, 3, 4]);
}

#[test]
fn profiles_that_do_not_go_together_are_not_matched() {
    let session = session();
    let publisher = session.create_publisher(spec(Qos::sensor_data())).unwrap();
    let reliable = session.create_subscription(spec(Qos::default())).unwrap();
    let best_effort = session.create_subscription(spec(Qos::sensor_data())).unwrap();
    assert!(best_effort.wait_matched(1, PATIENCE) && publisher.wait_matched(1, PATIENCE));
    assert_eq!(publisher.matched(), [best_effort.gid()]);
    assert!(reliable.matched().is_empty());
}

#[test]
fn a_waiting_reader_is_woken_by_a_sample() {
    let session = session();
    let subscription = session.create_subscription(spec(Qos::default())).unwrap();
    let publisher = session.create_publisher(spec(Qos::default())).unwrap();
    assert!(subscription.wait_matched(1, PATIENCE));
    std::thread::scope(|scope| {
        let reader = scope.spawn(|| subscription.recv(&mut Vec::new(), Some(PATIENCE)).unwrap());
        publisher.publish(b"x").unwrap();
        assert_eq!(reader.join().unwrap().publisher, publisher.gid());
    });
    assert!(subscription.recv(&mut Vec::new(), Some(Duration::from_millis(1))).is_none());
}

#[test]
fn a_sample_is_kept_beyond_all_that_it_came_from() {
    let session = session();
    let publisher = session.create_publisher(spec(Qos::default())).unwrap();
    let subscription = session.create_subscription(spec(Qos::default())).unwrap();
    assert!(subscription.wait_matched(1, PATIENCE));
    let mut loan = publisher.loan(100_000).unwrap();
    loan.fill(5);
    assert_eq!(loan.publish().unwrap(), 1);
    let (info, sample) = subscription.take_sample().unwrap();
    assert_eq!((info.publisher, info.sequence, sample.len()), (publisher.gid(), 1, 100_000));
    assert!(sample.is_borrowed());
    for number in 2..50 {
        assert_eq!(publisher.publish(&[6; 100_000]).unwrap(), number);
    }
    drop(subscription);
    drop(publisher);
    drop(session);
    let mut bytes = Vec::new();
    sample.copy_to(&mut bytes).unwrap();
    assert!(bytes == [5; 100_000]);
}

#[test]
fn samples_are_copied_where_the_settings_say_so() {
    let config = Config::resolve([], None, &OsFiles).unwrap();
    let config = Config { daemon: DaemonPolicy::Off, shm_copy: true, ..config };
    let session = Session::open(&config, SessionOptions::new("test")).unwrap();
    let publisher = session.create_publisher(spec(Qos::default())).unwrap();
    let subscription = session.create_subscription(spec(Qos::default())).unwrap();
    assert!(subscription.wait_matched(1, PATIENCE));
    publisher.publish(&[1; 10_000]).unwrap();
    let (_, sample) = subscription.take_sample().unwrap();
    assert!(!sample.is_borrowed() && sample.len() == 10_000);
}

#[test]
fn no_signal_is_delivered_to_the_control_thread() {
    // SIGKILL and SIGSTOP cannot be blocked, and the C library keeps 32 and 33.
    let all = !((1u64 << 8) | (1 << 18) | (1 << 31) | (1 << 32));
    let blocked = |task: &Path| {
        let status = std::fs::read_to_string(task.join("status")).ok()?;
        let mask = status.lines().find_map(|line| line.strip_prefix("SigBlk:"))?;
        Some(u64::from_str_radix(mask.trim(), 16).unwrap() & all)
    };
    let here = Path::new("/proc/thread-self");
    let before = blocked(here);
    let session = session();
    assert_eq!(blocked(here), before, "the mask of the thread that opened it");
    // Once it has matched something, its control thread has long had its name.
    let subscription = session.create_subscription(spec(Qos::default())).unwrap();
    let _publisher = session.create_publisher(spec(Qos::default())).unwrap();
    assert!(subscription.wait_matched(1, PATIENCE));
    let tasks = std::fs::read_dir("/proc/self/task").unwrap().map(|task| task.unwrap().path());
    let named = |task: &Path| {
        std::fs::read_to_string(task.join("comm")).is_ok_and(|name| name.trim() == "axon-ctl")
    };
    let masks: Vec<u64> = tasks.filter(|t| named(t)).filter_map(|t| blocked(&t)).collect();
    assert!(!masks.is_empty() && masks.iter().all(|mask| *mask == all), "{masks:x?}");
}

#[test]
fn a_forked_child_is_refused_by_whatever_it_asks_and_never_waits() {
    use std::sync::atomic::{AtomicBool, Ordering};
    let session = session();
    let publisher = session.create_publisher(spec(Qos::keep_all())).unwrap();
    let subscription = session.create_subscription(spec(Qos::keep_all())).unwrap();
    assert!(subscription.wait_matched(1, PATIENCE));
    // One that stands there unread, and that the child must not be told of.
    publisher.publish(b"x").unwrap();
    let over = AtomicBool::new(false);
    let forked =
        |what: Result<(), SessionError>| what.is_err_and(|e| e.to_string().contains("fork"));
    std::thread::scope(|scope| {
        // Whose locks the child finds taken, and nobody to give them back.
        for _ in 0..2 {
            scope.spawn(|| {
                while !over.load(Ordering::Relaxed) {
                    session.graph();
                    publisher.matched();
                    subscription.matched();
                    subscription.lost();
                }
            });
        }
        for _ in 0..40 {
            // SAFETY: the child calls what must work in one, and leaves by _exit.
            let child = unsafe { libc::fork() };
            if child == 0 {
                // SAFETY: has it killed if it hangs.
                unsafe { libc::alarm(30) };
                let mut bytes = Vec::new();
                let refused = [
                    forked(session.create_publisher(spec(Qos::default())).map(drop)),
                    forked(session.create_subscription(spec(Qos::default())).map(drop)),
                    forked(session.status_json().map(drop)),
                    publisher.publish(b"x").is_err_and(|e| e.to_string().contains("fork")),
                    publisher.loan(5000).is_err_and(|e| e.to_string().contains("fork")),
                    subscription.take(&mut bytes).is_none(),
                    subscription.recv(&mut bytes, Some(Duration::from_millis(1))).is_none(),
                    subscription.recv(&mut bytes, None).is_none(),
                    !subscription.has_data() && subscription.matched().is_empty(),
                    publisher.matched().is_empty() && !publisher.wait_matched(1, PATIENCE),
                    session.daemon().is_none() && session.graph().endpoints.is_empty(),
                    !session.wait_graph(PATIENCE, |graph| !graph.endpoints.is_empty()),
                ];
                let code = refused.iter().position(|refused| !refused).map_or(0, |n| n + 1);
                // SAFETY: ends the process without running anything else.
                unsafe { libc::_exit(i32::try_from(code).unwrap()) };
            }
            let mut status = -1;
            // SAFETY: waits for the child just made; `status` outlives the call.
            assert_eq!(unsafe { libc::waitpid(child, &mut status, 0) }, child);
            assert_eq!(status, 0, "the child was refused all of it, and killed by nothing");
        }
        over.store(true, Ordering::Relaxed);
    });
    publisher.publish(b"x").unwrap();
    assert!(subscription.recv(&mut Vec::new(), Some(PATIENCE)).is_some());
}
