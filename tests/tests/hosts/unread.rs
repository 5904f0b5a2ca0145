//! A peer that asked for a topic and does not read it.

use std::{
    thread,
    time::{Duration, Instant},
};

use axon_daemon::internal::link::{
    GraphUpdate, LinkMessage, ReceivedOf, ReceivedUpTo, RouteSubscriber, Subscribe, Unsubscribe,
};
use axon_envelope::inner::{Header, RequestId};
use axon_shm::PublishError;
use axon_tests::Sizes;
use axon_tls::identity::{Auth, SigningKey};
use axon_transport::{
    EndpointSpec, Session,
    graph::{Endpoint, EndpointKind},
    ids::{DaemonId, Gid},
    qos::Qos,
};
use rustix::process::Signal;

use super::{
    mode::classic,
    pair::{Host, Plan, signal},
    process::{PATIENCE, until},
    stranger::{Claim, Met, Stranger},
};

const TOPIC: &str = "/unread";
const SERVICE: &str = "/unanswered";
/// The kinds of a service's routes in SUBSCRIBE.
const REQUESTS: u8 = 1;
const RESPONSES: u8 = 2;
const TYPE: &str = "test/Bytes";
/// The peer's subscription of the topic.
pub(super) const SUBSCRIPTION: Gid = Gid([7; 16]);

/// Subscribes to a topic, KEEP_ALL.
pub(super) fn subscribe(stranger: &Stranger, met: &mut Met, topic: &str) {
    let subscription = Endpoint::new(SUBSCRIPTION, EndpointKind::Subscription, topic, TYPE)
        .with_qos(Qos::keep_all())
        .with_node("idle", "/");
    let graph = GraphUpdate { version: 1, added: vec![subscription], ..GraphUpdate::default() };
    stranger.say(met, &LinkMessage::Graph(graph));
    let subscribe = Subscribe {
        route: 1,
        topic: topic.into(),
        type_name: TYPE.into(),
        kind: 0,
        subscribers: vec![RouteSubscriber { gid: SUBSCRIPTION, qos: Qos::keep_all() }],
        last: vec![],
        acknowledges: Some(true),
        short_headers: None,
    };
    stranger.say(met, &LinkMessage::Subscribe(subscribe));
}

fn refused(message: &LinkMessage) -> bool {
    matches!(message, LinkMessage::RouteRefused(refused) if refused.route == 1)
}

fn retry(message: LinkMessage) -> u32 {
    let LinkMessage::RouteRefused(refused) = message else { panic!("{message:?}") };
    refused.retry_s.expect("it may ask again")
}

#[test]
fn peer_that_reads_nothing_is_cut_from_the_topic() {
    let [host, _other] = Plan { stalled_s: 3, ..Plan::new([classic(&[]), classic(&[])]) }.start();
    let session = host.session("publisher");
    let spec = || EndpointSpec::new(TOPIC, TYPE, Qos::keep_all());
    let publisher = session.create_publisher(spec()).unwrap();
    let local = host.session("reader").create_subscription(spec()).unwrap();
    assert!(publisher.wait_matched(1, PATIENCE));

    let (stranger, auth) = (Stranger::new(), Auth::None(SigningKey::generate().unwrap()));
    let claim = Claim { host: "idle", daemon: DaemonId([0xff; 16]), auth: 0 };
    let mut met = stranger.dial(&host, &auth, &claim).expect("a link");
    subscribe(&stranger, &mut met, TOPIC);
    until("it is served", || publisher.matched().len() == 2);
    let reader = thread::spawn(move || {
        let mut bytes = Vec::new();
        while let Ok(info) = local.recv(&mut bytes, Some(PATIENCE)) {
            if bytes.is_empty() {
                return info.sequence;
            }
        }
        panic!("no last sample")
    });
    let sample = vec![0x5a; 1 << 20];
    let mut published = 0;
    loop {
        match publisher.publish(&sample) {
            Ok(sequence) => published = sequence,
            Err(PublishError::Blocked { .. }) => break,
            Err(error) => panic!("{error}"),
        }
    }
    let told = stranger.hear(&mut met, refused).expect("it is told");
    assert!(retry(told) > 0);
    until("the publisher goes on", || publisher.publish(&[]).is_ok());
    assert_eq!(reader.join().unwrap(), published + 1, "the reader here has it all");
    until("what the peer did not read is given up", || publisher.given_up() > 0);
    assert!(!publisher.wait_acknowledged(Duration::ZERO));
    host.wait_refusal("it is shown", |text| text.contains(TOPIC) && text.contains("stalled_s"));
    let topics = host.status().topics;
    let stalled = topics.iter().filter_map(|topic| topic.dropped.get("stalled")).sum::<u64>();
    assert_eq!(stalled, publisher.given_up());
    assert!(publisher.matched().len() <= 1);
}

#[test]
fn exaggerated_drop_report_of_a_peer_counts_no_loss() {
    let [host, _other] = Plan::new([classic(&[]), classic(&[])]).start();
    claims_to_have_dropped(&host, &host.session("publisher"));
}

#[test]
fn samples_of_a_relayed_session_that_a_peer_dropped_are_given_up() {
    let [host, _other] = Plan::new([classic(&[]), classic(&[])]).start();
    claims_to_have_dropped(&host, &host.relayed_session("publisher"));
}

/// Tests a peer that claims to have dropped more samples of a publisher than it got.
fn claims_to_have_dropped(host: &Host, session: &Session) {
    let publisher =
        session.create_publisher(EndpointSpec::new(TOPIC, TYPE, Qos::keep_all())).unwrap();
    let (stranger, auth) = (Stranger::new(), Auth::None(SigningKey::generate().unwrap()));
    let claim = Claim { host: "liar", daemon: DaemonId([0xff; 16]), auth: 0 };
    let mut met = stranger.dial(host, &auth, &claim).expect("a link");
    subscribe(&stranger, &mut met, TOPIC);
    until("it is served", || publisher.matched().len() == 1);
    let mut say = |sequence, dropped| {
        let flow = ReceivedOf { route: 1, publisher: publisher.gid(), sequence, dropped };
        stranger.say(&mut met, &LinkMessage::Received(ReceivedUpTo { flows: vec![flow] }));
    };
    for given_up in 1..=2 {
        let sequence = publisher.publish(b"sample").unwrap();
        // An acknowledgement before the sample was sent does not count, so the peer repeats it.
        until("it is done with", || {
            say(sequence, u64::MAX);
            publisher.given_up() >= given_up
        });
        assert_eq!(publisher.given_up(), given_up);
        assert!(!publisher.wait_acknowledged(Duration::ZERO), "each loss is told");
    }
    let sequence = publisher.publish(b"the last").unwrap();
    until("it is acknowledged", || {
        say(sequence, 0);
        publisher.wait_acknowledged(Duration::from_millis(50))
    });
    assert_eq!(publisher.given_up(), 2);
}

#[test]
fn a_stopped_reader_behind_an_honest_daemon_is_served_again_once_it_reads() {
    let hosts = Plan { stalled_s: 3, ..Plan::new([classic(&[]), classic(&[])]) }.start();
    let mut there = hosts[1].subscribe(Sizes::Small);
    let mut here = hosts[0].subscribe(Sizes::Small);
    let mut publisher = hosts[0].flood(Sizes::Small, 2);
    there.wait_taken(100);
    signal(there.pid(), Signal::STOP);
    hosts[0].wait_refusal("it is disconnected", |text| text.contains("stalled_s"));
    until("it is shown there", || {
        hosts[1].status().links.iter().any(|link| !link.routes_refused.is_empty())
    });
    let now = publisher.published();
    here.wait_taken(now + 100);
    signal(there.pid(), Signal::CONT);
    // These are other samples than those in flight at the disconnection.
    until("it is served again", || {
        hosts[1].status().links.iter().all(|link| link.routes_refused.is_empty())
    });
    let now = publisher.published();
    there.wait_taken(now + 100);
    let sent = publisher.stop();
    there.wait_taken(sent);
    let tally = there.tally();
    assert_eq!((tally.repeated, tally.corrupt), (0, 0), "{tally:?}");
    for node in [publisher, here, there] {
        node.finish();
    }
}

#[test]
fn a_host_that_falls_silent_holds_up_no_reader_of_another_one_for_long() {
    let hosts = Plan { stalled_s: 10, ..Plan::new([classic(&[]), classic(&[])]) }.start();
    let mut there = hosts[1].subscribe(Sizes::Small);
    let mut here = hosts[0].subscribe(Sizes::Small);
    let mut publisher = hosts[0].flood(Sizes::Small, 2);
    there.wait_taken(100);
    let stopped = hosts[1].stop_daemon();
    // The link stands for much longer.
    hosts[0].wait_refusal("it is disconnected", |text| text.contains("stalled_s"));
    let now = publisher.published();
    here.wait_taken(now + 100);
    let sent = publisher.stop();
    here.wait_taken(sent);
    let tally = here.tally();
    assert_eq!((tally.lost, tally.repeated, tally.corrupt), (0, 0, 0), "{tally:?}");
    drop(stopped);
    for node in [publisher, here, there] {
        node.finish();
    }
}

/// Returns a service, as the sessions of the host use it.
fn service() -> EndpointSpec {
    EndpointSpec::new(SERVICE, TYPE, Qos::keep_all())
}

/// The behaviour of a peer that takes nothing.
#[derive(Clone, Copy, PartialEq)]
enum Idler {
    /// It asks for the route.
    Asks,
    /// It asks for it again every two seconds. Until then one stream of it takes a MiB.
    AsksAgain,
    /// It never asks for it.
    Silent,
}

/// Asks for the messages to this end of the service.
fn ask(stranger: &Stranger, met: &mut Met, kind: EndpointKind) {
    let subscribe = Subscribe {
        route: 1,
        topic: SERVICE.into(),
        type_name: TYPE.into(),
        kind: if kind == EndpointKind::Server { REQUESTS } else { RESPONSES },
        subscribers: vec![RouteSubscriber { gid: SUBSCRIPTION, qos: Qos::keep_all() }],
        last: vec![],
        acknowledges: Some(true),
        short_headers: None,
    };
    stranger.say(met, &LinkMessage::Subscribe(subscribe));
}

/// Links a peer that has this end of the service.
fn at_service(host: &Host, kind: EndpointKind, idler: Idler) -> (Stranger, Met) {
    let (stranger, auth) = (Stranger::new(), Auth::None(SigningKey::generate().unwrap()));
    let claim = Claim { host: "idle", daemon: DaemonId([0xff; 16]), auth: 0 };
    let mut met = stranger.dial(host, &auth, &claim).expect("a link");
    let end = Endpoint::new(SUBSCRIPTION, kind, SERVICE, TYPE)
        .with_qos(Qos::keep_all())
        .with_node("idle", "/");
    let graph = GraphUpdate { version: 1, added: vec![end], ..GraphUpdate::default() };
    stranger.say(&mut met, &LinkMessage::Graph(graph));
    if idler != Idler::Silent {
        ask(&stranger, &mut met, kind);
    }
    (stranger, met)
}

#[test]
fn stalled_server_holds_up_no_client_of_another_server_for_long() {
    let [host, _other] = Plan { stalled_s: 3, ..Plan::new([classic(&[]), classic(&[])]) }.start();
    let client = host.session("client").create_client(service()).unwrap();
    let server = host.session("server").create_server(service()).unwrap();
    assert!(client.wait_available(PATIENCE));
    let (stranger, mut met) = at_service(&host, EndpointKind::Server, Idler::Asks);
    until("it is served", || client.servers().len() == 2);
    let server = thread::spawn(move || {
        let (mut bytes, mut taken) = (Vec::new(), 0);
        while server.recv_request(&mut bytes, Some(PATIENCE)).is_ok() {
            taken += 1;
            if bytes.is_empty() {
                return taken;
            }
        }
        panic!("no last request")
    });
    let request = vec![0x5a; 1 << 20];
    let mut sent = 0;
    loop {
        match client.send_request(&request) {
            Ok(_) => sent += 1,
            Err(PublishError::Blocked { .. }) => break,
            Err(error) => panic!("{error}"),
        }
    }
    // A peer is judged while a client tries in vain.
    until("the client goes on", || client.send_request(&request).is_ok());
    client.send_request(&[]).unwrap();
    let told = stranger.hear(&mut met, refused).expect("it is told");
    assert!(retry(told) > 0);
    assert_eq!(server.join().unwrap(), sent + 2, "the server here has it all");
    host.wait_refusal("it is shown", |text| text.contains(SERVICE) && text.contains("stalled_s"));
    let lost = || {
        let topics = host.status().topics;
        topics.iter().filter_map(|topic| topic.dropped.get("stalled")).sum::<u64>()
    };
    until("what it did not take is counted", || lost() > 0);
    assert!(lost() <= sent, "{} of {sent}", lost());
    assert!(client.servers().len() <= 1);
}

#[test]
fn a_peer_whose_client_takes_no_response_holds_up_no_server_for_long() {
    takes_no_response(Idler::Asks);
}

#[test]
fn a_peer_that_never_asks_for_responses_holds_up_no_server_for_long() {
    takes_no_response(Idler::Silent);
}

#[test]
fn repeated_asking_for_responses_holds_up_no_server_for_long() {
    takes_no_response(Idler::AsksAgain);
}

/// Tests a peer whose client sends requests and takes no response.
fn takes_no_response(idler: Idler) {
    const REQUESTED: u64 = 150;
    let [host, _other] = Plan { stalled_s: 3, ..Plan::new([classic(&[]), classic(&[])]) }.start();
    let server = host.session("server").create_server(service()).unwrap();
    let client = host.session("client").create_client(service()).unwrap();
    assert!(client.wait_available(PATIENCE));
    let (stranger, mut met) = at_service(&host, EndpointKind::Client, idler);
    let is_asked = |m: &LinkMessage| matches!(m, LinkMessage::Subscribe(s) if s.kind == REQUESTS);
    let LinkMessage::Subscribe(asked) = stranger.hear(&mut met, is_asked).expect("it is asked")
    else {
        unreachable!()
    };
    let mut requests = vec![1, 0, 0, 0];
    requests.extend_from_slice(&asked.route.to_be_bytes());
    requests.extend_from_slice(&SUBSCRIPTION.0);
    for number in 1..=REQUESTED {
        let header = Header {
            gid: SUBSCRIPTION.0,
            sequence: number,
            source_timestamp: 0,
            request_id: RequestId { client: SUBSCRIPTION.0, sequence: number as i64 },
            compressed: false,
            age_ms: 0,
            uncompressed_len: 1,
        };
        let header = header.encode();
        requests.extend_from_slice(&(header.len() as u32 + 1).to_be_bytes());
        requests.extend_from_slice(&header);
        requests.push(0x5a);
    }
    let mut stream = stranger.open(&met).expect("a stream");
    assert!(stranger.write_for(&mut stream, &requests, PATIENCE), "a host takes requests");

    // Each is answered with 1 MiB, and once more where there was no room.
    let answer = vec![0xa5; 1 << 20];
    let mut bytes = Vec::new();
    let mut blocked = false;
    let mut asked_at = Instant::now();
    for _ in 0..REQUESTED {
        let request = server.recv_request(&mut bytes, Some(PATIENCE)).expect("a request");
        until("there is room for the response, or nobody to get it", || {
            let sent = server.send_response(request.publisher, request.sequence, &answer);
            blocked |= matches!(sent, Err(PublishError::Blocked { .. }));
            if idler == Idler::AsksAgain && asked_at.elapsed() > Duration::from_secs(2) {
                stranger.say(&mut met, &LinkMessage::Unsubscribe(Unsubscribe { route: 1 }));
                ask(&stranger, &mut met, EndpointKind::Client);
                asked_at = Instant::now();
            }
            sent.is_ok()
        });
    }
    assert!(blocked, "the peer held up the server: else the test shows nothing");
    if idler != Idler::Silent {
        let told = stranger.hear(&mut met, refused).expect("it is told");
        assert!(retry(told) > 0);
    }
    let unasked = |m: &LinkMessage| {
        matches!(m, LinkMessage::RouteUnasked(u) if u.kind == REQUESTS
            && u.reason.as_ref().is_some_and(|reason| reason.contains("stalled_s")))
    };
    stranger.hear(&mut met, unasked).expect("it is told");
    // Another client is answered, and this one is asked again later.
    let number = client.send_request(b"still there?").unwrap();
    let request = server.recv_request(&mut bytes, Some(PATIENCE)).expect("a request");
    server.send_response(request.publisher, request.sequence, b"yes").unwrap();
    let response = client.recv_response(&mut bytes, Some(PATIENCE)).expect("a response");
    assert_eq!((response.sequence, &bytes[..]), (number, &b"yes"[..]));
    if idler != Idler::Silent {
        let of_service = |text: &str| text.contains(SERVICE) && text.contains("stalled_s");
        host.wait_refusal("it is shown", of_service);
    }
    stranger.hear(&mut met, is_asked).expect("it is asked again");
}
