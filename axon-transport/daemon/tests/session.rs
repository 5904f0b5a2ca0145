//! A session without a daemon, and its own endpoints.

#[path = "support/alone.rs"]
mod alone;

use std::{
    path::Path,
    sync::{Arc, mpsc},
    thread,
    time::{Duration, Instant},
};

use alone::alone;
use axon_transport::internal::session::{from_unix_nanos, unix_nanos};
use axon_transport::{
    EndpointSpec, Publisher, RecvError, Session, SessionError, SessionOptions, Subscription,
    Waitable,
    config::{Config, DaemonPolicy},
    events::{EventKind, EventStatus},
    graph::EndpointKind,
    qos::Qos,
};

const PATIENCE: Duration = Duration::from_secs(60);

/// Returns the nodes that `session` sees, with the topics that each publishes.
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
    std::iter::from_fn(|| {
        subscription.take(&mut bytes).map(|info| unix_nanos(info.source_timestamp))
    })
    .collect()
}

fn publishers(session: &Session, count: usize, qos: Qos) -> Vec<Publisher> {
    (0..count).map(|_| session.create_publisher(spec(qos)).unwrap()).collect()
}

#[test]
fn an_endpoint_out_of_bounds_is_refused() {
    let session = alone();
    let nameless = EndpointSpec::new("", "test/Bytes", Qos::default());
    let refused = session.create_publisher(nameless).unwrap_err();
    assert!(matches!(refused, SessionError::Endpoint { .. }));
    let bottomless = spec(Qos::default().with_depth(0));
    assert!(session.create_subscription(bottomless).is_err());
}

/// Everything that two sessions could have in common.
#[test]
fn sessions_of_a_process_without_a_daemon_know_nothing_of_each_other() {
    let sessions = [alone(), alone()];
    let ends = sessions.each_ref().map(|session| {
        let node = session.create_node("n", "/", "/").unwrap();
        let subscription = node.create_subscription(spec(Qos::keep_all())).unwrap();
        let publisher = node.create_publisher(spec(Qos::keep_all())).unwrap();
        (node, subscription, publisher)
    });
    let service = || EndpointSpec::new("/s", "S", Qos::default());
    let _server = sessions[0].create_server(service()).unwrap();
    let client = sessions[1].create_client(service()).unwrap();
    for (number, (_, subscription, publisher)) in ends.iter().enumerate() {
        assert!(subscription.wait_matched(1, PATIENCE) && publisher.wait_matched(1, PATIENCE));
        publisher.publish(&[u8::try_from(number).unwrap()]).unwrap();
    }
    let mut bytes = Vec::new();
    for (number, (_, subscription, _)) in ends.iter().enumerate() {
        assert!(subscription.recv(&mut bytes, Some(PATIENCE)).is_ok());
        assert_eq!(bytes.iter().map(|byte| usize::from(*byte)).collect::<Vec<_>>(), [number]);
    }
    // If more endpoints were to appear, they would have by now.
    for (session, (_, subscription, publisher)) in sessions.iter().zip(&ends) {
        let moment = Duration::from_millis(100);
        assert!(!session.wait_graph(moment, |graph| graph.endpoints.len() > 4));
        assert_eq!(nodes(session), [("n".into(), vec!["/t".into()])]);
        assert!(subscription.take(&mut bytes).is_none());
        let matched = (publisher.matched(), subscription.matched());
        assert_eq!(matched, (vec![subscription.gid()], vec![publisher.gid()]));
    }
    assert!(!client.is_available());
}

#[test]
fn a_node_is_in_the_graph_from_its_creation_to_its_end() {
    let session = alone();
    for (name, namespace) in [("", "/"), ("n", &"x".repeat(513)), ("a\0b", "/")] {
        let refused = session.create_node(name, namespace, "/").unwrap_err();
        assert!(matches!(refused, SessionError::Node { .. }), "{refused}");
    }
    for _ in 0..20 {
        let brief = session.create_node("brief", "/", "/").unwrap();
        assert_eq!(nodes(&session), [("brief".into(), Vec::new())], "at once");
        drop(brief);
        let over = session.wait_graph(PATIENCE, |graph| graph.endpoints.is_empty());
        assert!(over, "{:?}", nodes(&session));
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
    // A query by name merges nodes of the same name.
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
fn an_endpoint_is_in_the_graph_from_its_creation_to_its_end() {
    let session = alone();
    let node = session.create_node("n", "/", "/").unwrap();
    for _ in 0..20 {
        let publisher = node.create_publisher(spec(Qos::default())).unwrap();
        assert_eq!(nodes(&session), [("n".into(), vec!["/t".into()])], "at once");
        drop(publisher);
        assert_eq!(nodes(&session), [("n".into(), Vec::new())], "at once");
    }
}

#[test]
fn publishers_are_merged_by_source_timestamp() {
    let session = alone();
    let publishers = publishers(&session, 3, Qos::keep_all());
    let subscription = session.create_subscription(spec(Qos::keep_all())).unwrap();
    assert!(subscription.wait_matched(3, PATIENCE));
    for round in 0..10 {
        for (offset, publisher) in [2, 0, 1].iter().zip(&publishers) {
            publisher.publish_at(from_unix_nanos(round * 3 + offset), b"x").unwrap();
        }
    }
    assert_eq!(drain(&subscription), (0..30).collect::<Vec<_>>());
    assert_eq!((subscription.received(), subscription.lost()), (30, 0));
}

#[test]
fn depth_counts_over_all_publishers_and_skipping_is_not_loss() {
    let session = alone();
    let publishers = publishers(&session, 3, Qos::default());
    let subscription = session.create_subscription(spec(Qos::default().with_depth(4))).unwrap();
    assert!(subscription.wait_matched(3, PATIENCE));
    for time in 0..9 {
        publishers[usize::try_from(time).unwrap() % 3]
            .publish_at(from_unix_nanos(time), b"x")
            .unwrap();
    }
    assert_eq!(drain(&subscription), [5, 6, 7, 8]);
    assert_eq!(subscription.lost(), 0);
}

#[test]
fn samples_of_an_ended_publisher_are_taken() {
    let session = alone();
    let subscription = session.create_subscription(spec(Qos::keep_all())).unwrap();
    let publisher = session.create_publisher(spec(Qos::keep_all())).unwrap();
    assert!(subscription.wait_matched(1, PATIENCE));
    for time in 0..5 {
        publisher.publish_at(from_unix_nanos(time), b"x").unwrap();
    }
    drop(publisher);
    assert!(session.wait_graph(PATIENCE, |graph| graph.endpoints.len() == 1));
    assert!(subscription.matched().is_empty());
    assert_eq!(drain(&subscription), [0, 1, 2, 3, 4]);
}

#[test]
fn profiles_that_do_not_go_together_are_not_matched() {
    let session = alone();
    let publisher = session.create_publisher(spec(Qos::sensor_data())).unwrap();
    let reliable = session.create_subscription(spec(Qos::default())).unwrap();
    let best_effort = session.create_subscription(spec(Qos::sensor_data())).unwrap();
    assert!(best_effort.wait_matched(1, PATIENCE) && publisher.wait_matched(1, PATIENCE));
    assert_eq!(publisher.matched(), [best_effort.gid()]);
    assert!(reliable.matched().is_empty());
}

#[test]
fn a_waiting_reader_is_woken_by_a_sample() {
    let session = alone();
    let subscription = session.create_subscription(spec(Qos::default())).unwrap();
    let publisher = session.create_publisher(spec(Qos::default())).unwrap();
    assert!(subscription.wait_matched(1, PATIENCE));
    thread::scope(|scope| {
        let reader = scope.spawn(|| subscription.recv(&mut Vec::new(), Some(PATIENCE)).unwrap());
        publisher.publish(b"x").unwrap();
        assert_eq!(reader.join().unwrap().publisher, publisher.gid());
    });
    let late = subscription.recv(&mut Vec::new(), Some(Duration::from_millis(1)));
    assert_eq!(late, Err(RecvError::TimedOut));
}

#[test]
fn loans_that_are_expected_are_in_place_from_513_bytes_on() {
    let session = alone();
    for (expected_len, shortest) in [(0, 4097), (512, 4097), (513, 513), (1 << 20, 513)] {
        let spec = spec(Qos::default()).expected_len(expected_len);
        let publisher = session.create_publisher(spec.clone()).unwrap();
        let subscription = session.create_subscription(spec).unwrap();
        assert!(subscription.wait_matched(1, PATIENCE));
        for len in [512, 513, 1000, 4096, 4097] {
            let mut loan = publisher.loan(len).unwrap();
            loan.fill(1);
            loan.publish().unwrap();
            let (_, sample) = subscription.take_sample().unwrap();
            assert_eq!(sample.is_borrowed(), len >= shortest, "{len} where {expected_len}");
            publisher.publish(&vec![2; len]).unwrap();
            let (_, sample) = subscription.take_sample().unwrap();
            assert_eq!(sample.is_borrowed(), len > 4096, "copied in, {len} where {expected_len}");
        }
    }
}

#[test]
fn a_sample_is_kept_beyond_all_that_it_came_from() {
    let session = alone();
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
    let config = Config::builder().daemon(DaemonPolicy::Off).shm_copy(true).build().unwrap();
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
    let session = alone();
    assert_eq!(blocked(here), before, "the mask of the thread that opened it");
    // When the session has reported an event, its control thread has its name.
    let (tells, told) = mpsc::channel();
    session.set_listener(move |event| tells.send(event.clone()).unwrap_or_default());
    let _publisher = session.create_publisher(spec(Qos::default())).unwrap();
    assert!(told.recv_timeout(PATIENCE).is_ok());
    let named = |task: &Path| {
        std::fs::read_to_string(task.join("comm")).is_ok_and(|name| name.trim() == "axon-ctl")
    };
    // Control threads of other tests start and end meanwhile; a thread that ends has no mask any
    // more.
    let deadline = Instant::now() + PATIENCE;
    loop {
        let tasks = std::fs::read_dir("/proc/self/task").unwrap().map(|task| task.unwrap().path());
        let masks: Vec<u64> = tasks.filter(|t| named(t)).filter_map(|t| blocked(&t)).collect();
        if !masks.is_empty() && masks.iter().all(|mask| *mask == all) {
            break;
        }
        assert!(Instant::now() < deadline, "{masks:x?}");
    }
}

#[test]
fn every_call_of_a_forked_child_is_refused_without_waiting() {
    use std::sync::atomic::{AtomicBool, Ordering};
    let session = alone();
    let publisher = session.create_publisher(spec(Qos::keep_all())).unwrap();
    let subscription = session.create_subscription(spec(Qos::keep_all())).unwrap();
    assert!(subscription.wait_matched(1, PATIENCE));
    // An unread sample, of which the child must not be told.
    publisher.publish(b"x").unwrap();
    let service = || EndpointSpec::new("/s", "S", Qos::default());
    let server = session.create_server(service()).unwrap();
    let client = session.create_client(service()).unwrap();
    let number = client.send_request(b"x").unwrap();
    let matched = publisher.event(EventKind::PublicationMatched).unwrap();
    let lost = subscription.event(EventKind::MessageLost).unwrap();
    let guard = session.create_guard_condition();
    let over = AtomicBool::new(false);
    let forked =
        |what: Result<(), SessionError>| what.is_err_and(|e| e.to_string().contains("fork"));
    thread::scope(|scope| {
        // The child finds the locks of these threads taken, and no thread releases them.
        for _ in 0..2 {
            scope.spawn(|| {
                while !over.load(Ordering::Relaxed) {
                    session.graph();
                    publisher.matched();
                    subscription.matched();
                    subscription.lost();
                    matched.is_ready();
                    lost.is_ready();
                    client.is_available();
                    server.has_request();
                }
            });
        }
        for _ in 0..40 {
            // SAFETY: the child makes calls that must work in a forked child, and leaves by _exit.
            let child = unsafe { libc::fork() };
            if child == 0 {
                // SAFETY: the alarm kills the child if it hangs.
                unsafe { libc::alarm(30) };
                let mut bytes = Vec::new();
                let refused = [
                    forked(session.create_publisher(spec(Qos::default())).map(drop)),
                    forked(session.create_subscription(spec(Qos::default())).map(drop)),
                    forked(session.status_json().map(drop)),
                    publisher.publish(b"x").is_err_and(|e| e.to_string().contains("fork")),
                    publisher.loan(5000).is_err_and(|e| e.to_string().contains("fork")),
                    subscription.take(&mut bytes).is_none(),
                    subscription.recv(&mut bytes, Some(Duration::from_millis(1)))
                        == Err(RecvError::Forked),
                    subscription.recv(&mut bytes, None) == Err(RecvError::Forked),
                    !subscription.has_data() && subscription.matched().is_empty(),
                    publisher.matched().is_empty() && !publisher.wait_matched(1, PATIENCE),
                    session.daemon().is_none() && session.graph().endpoints.is_empty(),
                    !session.wait_graph(PATIENCE, |graph| !graph.endpoints.is_empty()),
                    forked(session.create_server(service()).map(drop)),
                    forked(session.create_client(service()).map(drop)),
                    forked(session.create_node("n", "/", "/").map(drop)),
                    forked(
                        session.wait_for(&[Waitable::Subscription(&subscription)], None).map(drop),
                    ),
                    forked(subscription.set_on_new_sample(Some(Arc::new(|_| {})))),
                    forked(server.set_on_new_request(None)),
                    client.send_request(b"x").is_err_and(|e| e.to_string().contains("fork")),
                    server
                        .send_response(client.gid(), number, b"x")
                        .is_err_and(|e| e.to_string().contains("fork")),
                    server.take_request(&mut bytes).is_none() && !server.has_request(),
                    client.recv_response(&mut bytes, None) == Err(RecvError::Forked)
                        && !client.is_available(),
                    !matched.is_ready() && !lost.is_ready(),
                    matches!(matched.take(), EventStatus::Matched(status) if status.total == 0),
                    publisher.assert_liveliness().is_err_and(|e| e.to_string().contains("fork")),
                    {
                        guard.trigger();
                        matched.set_callback(Some(Arc::new(|_| {})));
                        true
                    },
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
    assert!(subscription.recv(&mut Vec::new(), Some(PATIENCE)).is_ok());
    assert!(server.recv_request(&mut Vec::new(), Some(PATIENCE)).is_ok());
    assert!(matched.is_ready() && !guard.is_triggered());
}

/// Threads that use everything concurrently without coordination.
#[test]
fn threads_create_use_and_end_endpoints_concurrently() {
    let session = alone();
    let guard = session.create_guard_condition();
    thread::scope(|scope| {
        for thread in 0..4_u64 {
            let (session, guard) = (session.clone(), guard.clone());
            scope.spawn(move || {
                let mut random = 0x9e37_79b9_7f4a_7c15_u64.wrapping_mul(thread + 1);
                let mut next = |below: u64| {
                    random ^= random << 13;
                    random ^= random >> 7;
                    random ^= random << 17;
                    random % below
                };
                let spec = |n: u64| EndpointSpec::new(format!("/t{n}"), "T", Qos::default());
                let mut publishers = Vec::new();
                let mut subscriptions: Vec<Subscription> = Vec::new();
                let (mut servers, mut clients, mut events) = (Vec::new(), Vec::new(), Vec::new());
                let mut bytes = Vec::new();
                for _ in 0..400 {
                    match next(12) {
                        0 => publishers.push(session.create_publisher(spec(next(3))).unwrap()),
                        1 => {
                            let new = session.create_subscription(spec(next(3))).unwrap();
                            events.extend(new.event(EventKind::SubscriptionMatched));
                            new.set_on_new_sample(Some(Arc::new(|_| {}))).unwrap();
                            subscriptions.push(new);
                        }
                        2 => servers.push(session.create_server(spec(next(3))).unwrap()),
                        3 => clients.push(session.create_client(spec(next(3))).unwrap()),
                        4 => drop(publishers.pop()),
                        5 if !subscriptions.is_empty() => {
                            subscriptions.swap_remove(next(subscriptions.len() as u64) as usize);
                        }
                        6 => drop(servers.pop()),
                        7 => drop(clients.pop()),
                        8 => {
                            for publisher in &publishers {
                                publisher.publish(&[1; 5000]).unwrap();
                            }
                            for client in &clients {
                                client.send_request(b"x").unwrap();
                            }
                        }
                        9 => {
                            for server in &servers {
                                while let Some(request) = server.take_request(&mut bytes) {
                                    let (client, number) = (request.publisher, request.sequence);
                                    server.send_response(client, number, b"y").unwrap();
                                }
                            }
                        }
                        10 => {
                            guard.trigger();
                            while clients.iter().any(|c| c.take_response(&mut bytes).is_some()) {}
                            while subscriptions.iter().any(|s| s.take(&mut bytes).is_some()) {}
                        }
                        _ => {
                            let mut all = vec![Waitable::GuardCondition(&guard)];
                            all.extend(subscriptions.iter().map(Waitable::Subscription));
                            all.extend(servers.iter().map(Waitable::Server));
                            all.extend(clients.iter().map(Waitable::Client));
                            all.extend(events.iter().map(Waitable::Event));
                            session.wait_for(&all, Some(Duration::from_millis(2))).unwrap();
                        }
                    }
                }
                // The session's handles are dropped before its endpoints.
                drop(session);
            });
        }
    });
    assert!(session.wait_graph(PATIENCE, |graph| graph.endpoints.is_empty()));
    // Nothing stays matched with an endpoint that is gone.
    let publisher =
        session.create_publisher(EndpointSpec::new("/t0", "T", Qos::default())).unwrap();
    assert!(publisher.matched().is_empty());
}

#[test]
fn a_session_may_end_while_its_endpoints_wait() {
    for _ in 0..50 {
        let session = alone();
        let subscription = session.create_subscription(spec(Qos::default())).unwrap();
        let publisher = session.create_publisher(spec(Qos::default())).unwrap();
        drop(session);
        thread::scope(|scope| {
            let waiter = scope.spawn(move || subscription.recv(&mut Vec::new(), Some(PATIENCE)));
            scope.spawn(move || publisher.publish(b"x").unwrap());
            assert!(waiter.join().unwrap().is_ok());
        });
    }
}
