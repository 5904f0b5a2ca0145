//! A daemon whose messages the tests send.

use axon_transport::{
    ids::DaemonId,
    internal::wire::session::{Gone, GraphItem, SessionGraph, Welcome},
};

use super::{hostile::hear, *};

/// Creates a relayed session, and the connection on which the test plays its daemon.
fn simulated(host: &Host) -> (Session, OwnedFd) {
    let (listeners, lock) = Address::of(&host.config()).bind().unwrap().into_parts();
    let session = thread::scope(|scope| {
        let session = scope.spawn(|| session(host, "session", false));
        let flags = rustix::net::SocketFlags::CLOEXEC | rustix::net::SocketFlags::NONBLOCK;
        let mut socket = None;
        until("it calls", || {
            socket = rustix::net::accept_with(&listeners[0], flags).ok();
            socket.is_some()
        });
        let socket = socket.unwrap();
        assert!(hear(&socket, |message| matches!(message, SessionMessage::Hello(_))).is_some());
        let (daemon, pid) = (DaemonId([1; 16]), std::process::id());
        say_to(
            &socket,
            &SessionMessage::Welcome(Welcome {
                protocol: PROTOCOL,
                daemon,
                pid,
                ranges: Some(true),
            }),
        );
        (session.join().unwrap(), socket)
    });
    drop((listeners, lock));
    session
}

/// Announces an outside endpoint of this kind, with the topic of `own`.
fn show(socket: &OwnedFd, own: &Endpoint, kind: EndpointKind) -> Gid {
    let number = if kind == EndpointKind::Server { 2 } else { 1 };
    show_as(socket, Gid::new(SessionId([9; 16]), number), own, kind)
}

fn show_as(socket: &OwnedFd, gid: Gid, own: &Endpoint, kind: EndpointKind) -> Gid {
    let endpoint = {
        let mut endpoint = own.clone();
        endpoint.gid = gid;
        endpoint.kind = kind;
        endpoint
    };
    let added = vec![GraphItem { endpoint, daemon: None, reach: None }];
    let (removed, ended) = (Vec::new(), None);
    let graph = SessionGraph { version: 1, whole: false, added, removed, more: false, ended };
    say_to(socket, &SessionMessage::Graph(graph));
    gid
}

fn announced(socket: &OwnedFd, gid: Gid) {
    let heard = hear(socket, |m| matches!(m, SessionMessage::Endpoint(a) if a.endpoint.gid == gid));
    assert!(heard.is_some());
}

fn opened(socket: &OwnedFd, writer: Gid, reader: Option<Gid>) {
    let heard = hear(
        socket,
        |m| matches!(m, SessionMessage::Credit(c) if c.publisher == writer && c.client == reader && c.opens.is_some()),
    );
    assert!(heard.is_some());
}

fn matched(socket: &OwnedFd, gid: Gid, others: &[Gid]) {
    say_to(socket, &SessionMessage::Matched(RelayMatched { gid, others: others.to_vec() }));
}

#[test]
fn a_publisher_removed_and_rematched_at_once_is_opened_again() {
    let host = host();
    let (session, socket) = simulated(&host);
    let subscription = session.create_subscription(spec("/t", Qos::default())).unwrap();
    announced(&socket, subscription.gid());
    let outside = show(&socket, subscription.endpoint(), EndpointKind::Publisher);
    matched(&socket, subscription.gid(), &[outside]);
    opened(&socket, outside, None);
    // The daemon has forgotten what it had forwarded from that publisher, and the session must forget it, too.
    for _ in 0..3 {
        matched(&socket, subscription.gid(), &[]);
        matched(&socket, subscription.gid(), &[outside]);
        opened(&socket, outside, None);
    }
}

/// Waits until the session's process has handled all earlier messages about its endpoints: a pair that is requested now
/// is matched after them.
fn settle(session: &Session, socket: &OwnedFd) {
    let own = session.create_subscription(spec("/settled", Qos::default())).unwrap();
    announced(socket, own.gid());
    let gid = Gid::new(SessionId([9; 16]), 99);
    show_as(socket, gid, own.endpoint(), EndpointKind::Publisher);
    matched(socket, own.gid(), &[gid]);
    until("it is received from", || own.matched() == [gid]);
}

#[test]
fn a_match_announced_for_one_publisher_is_not_counted_by_others() {
    let host = host();
    let (session, socket) = simulated(&host);
    let publisher = |qos| {
        let own = session.create_publisher(spec("/t", qos)).unwrap();
        announced(&socket, own.gid());
        own
    };
    let first = publisher(best_effort(1));
    let outside = show(&socket, first.endpoint(), EndpointKind::Subscription);
    matched(&socket, first.gid(), &[outside]);
    until("it counts the one outside", || first.matched() == [outside]);
    let others = [best_effort(1), best_effort(500), Qos::default(), latched(5)].map(publisher);
    settle(&session, &socket);
    for other in others {
        assert_eq!(other.matched(), [], "{:?}", other.endpoint().qos);
        matched(&socket, other.gid(), &[outside]);
        until("it counts the one outside", || other.matched() == [outside]);
        let number = other.publish(b"x").unwrap();
        let credit = open_for(other.gid(), 9);
        say_to(&socket, &SessionMessage::Credit(credit));
        let piece = hear(&socket, |m| matches!(m, SessionMessage::SampleFragment(_)));
        let Some(SessionMessage::SampleFragment(piece)) = piece else { panic!("it hangs up") };
        let SampleHeader { sequence, lost, .. } = piece.head.unwrap();
        assert_eq!((piece.publisher, sequence, lost), (other.gid(), number, 0));
    }
}

#[test]
fn a_sample_is_acknowledged_once_the_daemon_has_it() {
    let soon = Duration::from_millis(20);
    let host = host();
    let (session, socket) = simulated(&host);
    for qos in [Qos::default(), Qos::keep_all(), best_effort(10), latched(10)] {
        let publisher = session.create_publisher(spec("/t", qos)).unwrap();
        announced(&socket, publisher.gid());
        let outside = show(&socket, publisher.endpoint(), EndpointKind::Subscription);
        matched(&socket, publisher.gid(), &[outside]);
        until("it counts the one outside", || publisher.matched() == [outside]);
        assert!(publisher.wait_acknowledged(soon), "nothing was published");
        say_to(&socket, &SessionMessage::Credit(open_for(publisher.gid(), 99)));
        for sequence in 1..=2 {
            assert_eq!(publisher.publish(b"x").unwrap(), sequence);
            assert!(hear(&socket, |m| matches!(m, SessionMessage::SampleFragment(_))).is_some());
        }
        for sequence in 1..=2 {
            assert!(!publisher.wait_acknowledged(soon), "{sequence} is on its way");
            let back = Credit { bytes: 129, opens: None, ..open_for(publisher.gid(), 0) };
            say_to(&socket, &SessionMessage::Credit(Credit { done: Some(sequence), ..back }));
        }
        assert!(publisher.wait_acknowledged(PATIENCE));
    }
}

#[test]
fn samples_that_the_daemon_gave_up_are_not_acknowledged() {
    let host = host();
    let (session, socket) = simulated(&host);
    for qos in [Qos::default(), Qos::keep_all(), best_effort(10), latched(10)] {
        let publisher = session.create_publisher(spec("/t", qos)).unwrap();
        let gid = publisher.gid();
        announced(&socket, gid);
        let outside = show(&socket, publisher.endpoint(), EndpointKind::Subscription);
        matched(&socket, gid, &[outside]);
        until("it counts the one outside", || publisher.matched() == [outside]);
        say_to(&socket, &SessionMessage::Credit(open_for(gid, 99)));
        for _ in 0..3 {
            publisher.publish(b"x").unwrap();
            assert!(hear(&socket, |m| matches!(m, SessionMessage::SampleFragment(_))).is_some());
        }
        say_to(
            &socket,
            &SessionMessage::GivenUp(RelayGivenUp { reader: gid, writer: gid, samples: 2 }),
        );
        let back = Credit { bytes: 3 * 129, opens: None, ..open_for(gid, 0) };
        say_to(&socket, &SessionMessage::Credit(Credit { done: Some(3), ..back }));
        assert!(!publisher.wait_acknowledged(PATIENCE), "two are lost");
        assert_eq!(publisher.given_up(), 2);
        // The loss is reported before the credit that acknowledges all of them.
        until("nothing is on its way", || publisher.unacknowledged() == 0);
        assert!(publisher.wait_acknowledged(PATIENCE), "it was said once");
    }
}

#[test]
fn a_session_ends_despite_samples_left_without_credit() {
    let host = host();
    let (session, socket) = simulated(&host);
    let publisher = session.create_publisher(spec("/t", Qos::keep_all())).unwrap();
    announced(&socket, publisher.gid());
    let outside = show(&socket, publisher.endpoint(), EndpointKind::Subscription);
    matched(&socket, publisher.gid(), &[outside]);
    until("it counts the one outside", || publisher.matched() == [outside]);
    publish(&publisher, b"for which there is no credit");
    drop(publisher);
    let end = thread::spawn(move || drop(session));
    until("it ends", || end.is_finished());
    end.join().unwrap();
}

#[test]
fn the_ends_of_a_service_that_are_gone_and_back_at_once_begin_anew() {
    let host = host();
    let (session, socket) = simulated(&host);
    let own = session.create_server(services::service()).unwrap();
    announced(&socket, own.gid());
    let outside = show(&socket, own.endpoint(), EndpointKind::Client);
    for _ in 0..3 {
        matched(&socket, own.gid(), &[outside]);
        opened(&socket, outside, None);
        matched(&socket, own.gid(), &[]);
    }
    drop(own);

    let own = session.create_client(services::service()).unwrap();
    announced(&socket, own.gid());
    let outside = show(&socket, own.endpoint(), EndpointKind::Server);
    for _ in 0..3 {
        matched(&socket, own.gid(), &[outside]);
        opened(&socket, outside, Some(own.gid()));
        matched(&socket, own.gid(), &[]);
    }
    until("it counts nobody", || !own.is_available());
}

#[test]
fn a_request_is_sent_once_however_many_servers_it_is_for() {
    let host = host();
    let (session, socket) = simulated(&host);
    let own = session.create_client(services::service()).unwrap();
    announced(&socket, own.gid());
    let one = show(&socket, own.endpoint(), EndpointKind::Server);
    matched(&socket, own.gid(), &[one]);
    opened(&socket, one, Some(own.gid()));
    assert!(own.wait_available(PATIENCE));
    let credit = open_for(own.gid(), 1);
    say_to(&socket, &SessionMessage::Credit(credit));
    for number in 1..=3 {
        assert_eq!(own.send_request(b"x").unwrap(), number);
        let piece = hear(&socket, |m| matches!(m, SessionMessage::SampleFragment(_)));
        let Some(SessionMessage::SampleFragment(piece)) = piece else { panic!("no request") };
        assert_eq!((piece.publisher, piece.client), (own.gid(), None));
        assert_eq!(piece.head.unwrap().sequence, number);
    }
    // The server decides which client it answers, and which request; but it cannot answer in the name of another
    // server.
    let other = Gid::new(SessionId([9; 16]), 7);
    let answer = |server, client, sequence| {
        let head =
            Some(SampleHeader { length: 1, sequence, source_timestamp: 0, lost: 0, published: 0 });
        SessionMessage::SampleFragment(SampleFragment {
            publisher: server,
            head,
            bytes: vec![0],
            client,
        })
    };
    say_to(&socket, &answer(other, Some(own.gid()), 1));
    say_to(&socket, &answer(one, Some(other), 1));
    say_to(&socket, &answer(one, Some(own.gid()), 2));
    let info = own.recv_response(&mut Vec::new(), Some(PATIENCE)).unwrap();
    assert_eq!((info.publisher, info.sequence), (one, 2));
    assert!(!own.has_response());
}

#[test]
fn requests_waiting_for_one_server_go_before_requests_for_both() {
    let host = host();
    let (session, socket) = simulated(&host);
    let own = session.create_client(services::service()).unwrap();
    announced(&socket, own.gid());
    let [early, late] = [7, 3].map(|number| Gid::new(SessionId([9; 16]), number));
    show_as(&socket, early, own.endpoint(), EndpointKind::Server);
    matched(&socket, own.gid(), &[early]);
    until("it counts the one", || own.servers() == [early]);
    (1..=4).for_each(|number| assert_eq!(own.send_request(b"x").unwrap(), number));
    show_as(&socket, late, own.endpoint(), EndpointKind::Server);
    matched(&socket, own.gid(), &[late, early]);
    until("it counts both", || own.servers().len() == 2);
    assert_eq!(own.send_request(b"x").unwrap(), 5);
    let credit = open_for(own.gid(), 1);
    say_to(&socket, &SessionMessage::Credit(credit));
    for number in 1..=5 {
        let piece = hear(&socket, |m| matches!(m, SessionMessage::SampleFragment(_)));
        let Some(SessionMessage::SampleFragment(piece)) = piece else { panic!("no request") };
        assert_eq!(piece.head.unwrap().sequence, number);
    }
}

#[test]
fn a_channel_goes_on_when_one_of_its_readers_ends_and_another_is_matched() {
    let host = host();
    let (session, socket) = simulated(&host);
    let [one, other] = [(); 2].map(|()| {
        let own = session.create_subscription(spec("/t", Qos::keep_all())).unwrap();
        announced(&socket, own.gid());
        own
    });
    let outside = show(&socket, one.endpoint(), EndpointKind::Publisher);
    matched(&socket, one.gid(), &[outside]);
    opened(&socket, outside, None);
    until("both receive from it", || other.matched() == [outside]);
    let (gone, bytes) = (one.gid(), pattern(1, 1000));
    let (front, rest) = bytes.split_at(500);
    let head = Some(SampleHeader {
        length: 1000,
        sequence: 1,
        source_timestamp: 0,
        lost: 0,
        published: 0,
    });
    let piece = |head, bytes: &[u8]| {
        let bytes = bytes.to_vec();
        say_to(
            &socket,
            &SessionMessage::SampleFragment(SampleFragment {
                publisher: outside,
                head,
                bytes,
                client: None,
            }),
        );
    };
    piece(head, front);
    drop(one);
    let ended = |m: &SessionMessage| *m == SessionMessage::EndpointGone(Gone { gid: gone });
    assert!(hear(&socket, ended).is_some());
    // Sent before the daemon has received that: for the daemon, the channel had a reader all the time.
    matched(&socket, other.gid(), &[outside]);
    until("it is received from", || other.matched() == [outside]);
    piece(None, rest);
    assert_eq!(take_until(&other, 1), [1]);
    let back =
        |m: &SessionMessage| matches!(m, SessionMessage::Credit(c) if c.publisher == outside);
    let Some(SessionMessage::Credit(credit)) = hear(&socket, back) else { panic!("it hangs up") };
    assert_eq!((credit.bytes, credit.opens), (1128, None), "it does not begin anew");
}
