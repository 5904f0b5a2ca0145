//! The graph is exact: an endpoint that is counted is reached, and an endpoint that is gone is not
//! counted.

mod support;

use std::time::Duration;

use axon_transport::{
    EndpointSpec, Event, Waitable,
    events::{EventKind, EventStatus},
    graph::EndpointKind,
    qos::Qos,
};
use rustix::process::Signal;
use support::{Host, PATIENCE, of_child, say, signal, until, wait_for_the_end};

const ROUNDS: usize = 20;

fn spec(topic: &str) -> EndpointSpec {
    EndpointSpec::new(topic, "T", Qos::default())
}

/// The code of the children of the tests. It does nothing in a run of the tests themselves.
#[test]
fn child() {
    let Ok(part) = std::env::var("PLAY") else { return };
    let session = of_child(&part);
    match part.as_str() {
        // Publishes on /answer each sample that it takes on any of its topics.
        "echo" => {
            let answer = session.create_publisher(spec("/answer")).unwrap();
            assert!(answer.wait_matched(1, PATIENCE));
            for round in 0..ROUNDS {
                let subscription =
                    session.create_subscription(spec(&format!("/t{round}"))).unwrap();
                let mut bytes = Vec::new();
                assert!(subscription.recv(&mut bytes, Some(PATIENCE)).is_ok());
                answer.publish(&bytes).unwrap();
            }
            wait_for_the_end();
        }
        "node" => {
            let node = session.create_node("lonely", "/far", "/enclave").unwrap();
            say(node.gid());
            wait_for_the_end();
        }
        "leased" => {
            let lease = Some(Duration::from_millis(300));
            let qos = Qos::default().with_lease(lease);
            let publisher = session.create_publisher(EndpointSpec::new("/t", "T", qos)).unwrap();
            assert!(publisher.wait_matched(1, PATIENCE));
            say("matched");
            wait_for_the_end();
        }
        "resting" => {
            let publisher = session.create_publisher(spec("/t")).unwrap();
            assert!(publisher.wait_matched(1, PATIENCE));
            // By then all pending work is done.
            std::thread::sleep(Duration::from_millis(500));
            let before = switches();
            std::thread::sleep(Duration::from_millis(1500));
            say(switches() - before);
            wait_for_the_end();
        }
        _ => unreachable!("no such part: {part}"),
    }
}

/// Returns how often the control threads of this process went to sleep.
fn switches() -> u64 {
    let mut switches = 0;
    for task in std::fs::read_dir("/proc/self/task").unwrap() {
        let task = task.unwrap().path();
        let name = std::fs::read_to_string(task.join("comm")).unwrap();
        if name.trim() == "axon-ctl" {
            let status = std::fs::read_to_string(task.join("status")).unwrap();
            let line = status.lines().find(|l| l.starts_with("voluntary_ctxt")).unwrap();
            switches += line.split_whitespace().nth(1).unwrap().parse::<u64>().unwrap();
        }
    }
    switches
}

#[test]
fn own_endpoints_are_in_the_graph_at_once_without_a_daemon() {
    use EndpointKind::{Client, Publisher, Server, Subscription};
    let host = Host::new();
    let mut daemon = host.daemon();
    let session = host.session("own").unwrap();
    let node = session.create_node("n", "/", "/").unwrap();
    for round in 0..ROUNDS {
        if round % 5 == 4 {
            daemon.0.kill().unwrap();
            daemon.0.wait().unwrap();
            daemon = host.daemon();
        }
        let spec = || spec(&format!("/own{round}"));
        let counted = |kind| session.graph().count(kind, &spec().topic);
        let publisher = node.create_publisher(spec()).unwrap();
        assert_eq!(counted(Publisher), 1);
        let subscription = node.create_subscription(spec()).unwrap();
        assert_eq!(counted(Subscription), 1);
        let server = node.create_server(spec()).unwrap();
        assert_eq!(counted(Server), 1);
        let client = node.create_client(spec()).unwrap();
        assert_eq!([Publisher, Subscription, Server, Client].map(counted), [1; 4]);
        drop((publisher, subscription, server, client));
        assert_eq!([Publisher, Subscription, Server, Client].map(counted), [0; 4]);
    }
}

#[test]
fn a_subscription_in_the_graph_gets_the_next_published_sample() {
    let host = Host::new();
    let _daemon = host.daemon();
    let session = host.session("counting").unwrap();
    let answers = session.create_subscription(spec("/answer")).unwrap();
    let node = session.create_node("counting", "/", "/").unwrap();
    let publishers: Vec<_> = (0..ROUNDS)
        .map(|round| session.create_publisher(spec(&format!("/t{round}"))).unwrap())
        .collect();
    let echo = host.play("echo");
    let mut bytes = Vec::new();
    for (round, publisher) in publishers.iter().enumerate() {
        let topic = &publisher.endpoint().topic;
        // The guard condition alone reports that the graph changed.
        while session.graph().count(EndpointKind::Subscription, topic) == 0 {
            let graph = Waitable::GuardCondition(node.graph_changed());
            assert_eq!(session.wait_for(&[graph], Some(PATIENCE)).unwrap(), [0]);
        }
        assert_eq!(publisher.matched().len(), 1);
        publisher.publish(&round.to_le_bytes()).unwrap();
        assert!(answers.recv(&mut bytes, Some(PATIENCE)).is_ok(), "round {round} was lost");
        assert_eq!(bytes, round.to_le_bytes());
    }
    echo.finish();
}

#[test]
fn a_new_publisher_reaches_subscriptions_in_the_graph_at_once() {
    let host = Host::new();
    let _daemon = host.daemon();
    let (here, there) = (host.session("here").unwrap(), host.session("there").unwrap());
    for round in 0..ROUNDS {
        let topic = format!("/t{round}");
        let subscription = there.create_subscription(spec(&topic)).unwrap();
        let counted = |graph: &axon_transport::graph::GraphView| {
            graph.count(EndpointKind::Subscription, &topic) == 1
        };
        assert!(here.wait_graph(PATIENCE, counted));
        let publisher = here.create_publisher(spec(&topic)).unwrap();
        assert_eq!(publisher.matched(), [subscription.gid()], "round {round}");
        publisher.publish(b"x").unwrap();
        assert!(subscription.recv(&mut Vec::new(), Some(PATIENCE)).is_ok());
    }
}

#[test]
fn within_a_session_pairs_come_and_go_without_the_daemon() {
    let host = Host::new();
    let daemon = host.daemon();
    let session = host.session("here").unwrap();
    let matched = |event: &Event| {
        let EventStatus::Matched(status) = event.take() else { unreachable!() };
        (status.current, status.current_change, status.total_change)
    };
    // The daemon is stopped, so it sends nothing from here on.
    signal(daemon.0.id(), Signal::STOP);
    let subscription = session.create_subscription(spec("/t")).unwrap();
    let theirs = subscription.event(EventKind::SubscriptionMatched).unwrap();
    let publisher = session.create_publisher(spec("/t")).unwrap();
    let ours = publisher.event(EventKind::PublicationMatched).unwrap();
    assert_eq!(publisher.matched(), [subscription.gid()]);
    assert_eq!(subscription.matched(), [publisher.gid()]);
    assert_eq!((matched(&ours), matched(&theirs)), ((1, 1, 1), (1, 1, 1)));
    publisher.publish(b"x").unwrap();
    assert!(subscription.take(&mut Vec::new()).is_some());
    // Samples of a dropped publisher can still be taken.
    let brief = session.create_publisher(spec("/t")).unwrap();
    brief.publish(b"y").unwrap();
    drop(brief);
    assert_eq!(subscription.matched(), [publisher.gid()]);
    assert_eq!(matched(&theirs), (1, 0, 1));
    assert!(subscription.take(&mut Vec::new()).is_some());
    drop(session.create_subscription(spec("/t")).unwrap());
    assert_eq!(publisher.matched(), [subscription.gid()]);
    assert_eq!(matched(&ours), (1, 0, 1));

    let client = session.create_client(spec("/s")).unwrap();
    let server = session.create_server(spec("/s")).unwrap();
    assert!(client.is_available());
    client.send_request(b"?").unwrap();
    let request = server.take_request(&mut Vec::new()).expect("the request");
    server.send_response(request.publisher, request.sequence, b"!").unwrap();
    assert!(client.take_response(&mut Vec::new()).is_some());
    drop(server);
    assert!(!client.is_available());

    // The daemon finds the endpoints as they are, and reports no further changes.
    signal(daemon.0.id(), Signal::CONT);
    assert!(session.wait_graph(PATIENCE, |graph| graph.endpoints.len() == 3));
    until("nothing more is to be said", || {
        let status = host.status().unwrap();
        status.sessions.iter().any(|s| s.name == "here" && s.endpoints == 3 && s.queued == 0)
    });
    publisher.publish(b"z").unwrap();
    assert!(subscription.recv(&mut Vec::new(), Some(PATIENCE)).is_ok());
    assert_eq!((matched(&ours), matched(&theirs)), ((1, 0, 0), (1, 0, 0)));
    // An endpoint that is gone is not counted either, whatever the daemon reports.
    signal(daemon.0.id(), Signal::STOP);
    drop(subscription);
    assert!(
        !session
            .graph()
            .endpoints
            .values()
            .any(|e| { e.endpoint.kind == EndpointKind::Subscription })
    );
    assert_eq!(matched(&ours), (0, -1, 0));
    signal(daemon.0.id(), Signal::CONT);
}

#[test]
fn a_node_outlives_its_daemon() {
    let host = Host::new();
    let mut daemon = host.daemon();
    let session = host.session("witness").unwrap();
    let witness = session.create_node("witness", "/", "/").unwrap();
    let mut player = host.play("node");
    let gid = player.hear();
    let there = || {
        session.graph().endpoints.iter().any(|(g, entry)| {
            g.to_string() == gid
                && entry.endpoint.node == "lonely"
                && entry.endpoint.namespace == "/far"
                && entry.endpoint.enclave == "/enclave"
        })
    };
    until("the node is seen", there);
    for _ in 0..3 {
        let before = session.daemon();
        daemon.0.kill().unwrap();
        daemon.0.wait().unwrap();
        daemon = host.daemon();
        until("another daemon", || session.daemon().is_some_and(|now| Some(now) != before));
        until("the nodes are seen again", || {
            there() && session.graph().has_node(witness.name(), "/")
        });
        assert_eq!(session.graph().nodes().len(), 2);
    }
    signal(player.pid(), Signal::KILL);
    until("a dead process's node is gone", || session.graph().nodes().len() == 1);
}

#[test]
fn a_stopped_process_is_not_alive_and_is_again_when_it_goes_on() {
    let host = Host::new();
    let _daemon = host.daemon();
    let session = host.session("witness").unwrap();
    let subscription = session.create_subscription(spec("/t")).unwrap();
    let changed = subscription.event(EventKind::LivelinessChanged).unwrap();
    let mut player = host.play("leased");
    assert_eq!(player.hear(), "matched");
    let becomes = |alive: u64| {
        until(&format!("{alive} alive"), || {
            let all = [Waitable::Event(&changed)];
            session.wait_for(&all, Some(Duration::from_millis(100))).unwrap();
            matches!(changed.take(), EventStatus::LivelinessChanged(now)
                if (now.alive, now.not_alive) == (alive, 1 - alive))
        });
    };
    becomes(1);
    signal(player.pid(), Signal::STOP);
    becomes(0);
    assert_eq!(subscription.matched().len(), 1, "it is there still");
    signal(player.pid(), Signal::CONT);
    becomes(1);
    player.finish();
}

#[test]
fn a_process_without_deadlines_and_leases_is_never_woken() {
    let host = Host::new();
    let _daemon = host.daemon();
    let session = host.session("witness").unwrap();
    let _subscription = session.create_subscription(spec("/t")).unwrap();
    let mut player = host.play("resting");
    assert_eq!(player.hear(), "0");
    player.finish();
}
