//! Peers that send what no session sends.

use std::process::{Command, Stdio};

use rustix::{
    event::{PollFd, PollFlags, poll},
    process::{Pid, PidfdFlags, WaitId, WaitIdOptions, pidfd_open, waitid},
};

use super::*;

/// The first message of a session whose id consists of nines.
pub(super) fn hello(host: &Host) -> SessionHello {
    hello_of(&host.config())
}

fn hello_of(config: &Config) -> SessionHello {
    SessionHello {
        protocol: PROTOCOL,
        session: SessionId([9; 16]),
        role: SessionRole::Application,
        name: "by hand".into(),
        domain: 0,
        settings: security_settings(config).unwrap(),
        relay: Some("written by hand".into()),
        range: Some(0),
        static_peers: None,
    }
}

pub(crate) fn say_to(socket: &OwnedFd, message: &SessionMessage) {
    let packet = message.encode().unwrap();
    while let Err(SocketError::NotReady) = socket::send(socket, &packet, &[]) {
        thread::sleep(Duration::from_millis(1));
    }
}

/// Returns the next message that `want` accepts; `None` at the end of the connection.
pub(crate) fn hear(
    socket: &OwnedFd,
    want: impl Fn(&SessionMessage) -> bool,
) -> Option<SessionMessage> {
    let deadline = Instant::now() + PATIENCE;
    loop {
        match socket::receive(socket, &mut Vec::new()) {
            Ok(received) if want(&received.message) => return Some(received.message),
            Ok(_) => {}
            Err(SocketError::NotReady) => {
                assert!(Instant::now() < deadline, "nothing is said, and nobody hangs up");
                thread::sleep(Duration::from_millis(1));
            }
            Err(_) => return None,
        }
    }
}

fn refused(host: &Host, hello: SessionHello) -> SessionRefused {
    let socket = Address::of(&host.config()).connect().unwrap();
    say_to(&socket, &SessionMessage::Hello(hello));
    match hear(&socket, |_| true) {
        Some(SessionMessage::Refused(refused)) => refused,
        other => panic!("instead of a refusal: {other:?}"),
    }
}

/// Connects as a relayed session whose messages the test sends.
pub(super) fn by_hand(host: &Host, hello: SessionHello) -> OwnedFd {
    let socket = Address::of(&host.config()).connect().unwrap();
    say_to(&socket, &SessionMessage::Hello(hello));
    assert!(matches!(hear(&socket, |_| true), Some(SessionMessage::Welcome(_))));
    socket
}

fn announce(gid: Gid, kind: EndpointKind, role: EndpointRole) -> SessionMessage {
    let endpoint = Endpoint::new(gid, kind, "/t", "test/Bytes").with_qos(Qos::keep_all());
    let (stands_for, ring, only) = (Vec::new(), None, None);
    SessionMessage::Endpoint(Announce { endpoint, role, stands_for, ring, only })
}

fn piece(publisher: Gid, length: Option<u32>, bytes: usize) -> SessionMessage {
    let head = length.map(|length| SampleHeader {
        length,
        sequence: 1,
        source_timestamp: 0,
        lost: 0,
        published: 0,
    });
    SessionMessage::SampleFragment(SampleFragment {
        publisher,
        head,
        bytes: vec![0; bytes],
        client: None,
    })
}

#[test]
fn sessions_that_may_not_be_relayed_are_refused() {
    let host = host();
    let _daemon = host.daemon();
    let of = |role| SessionHello { role, ..hello(&host) };
    assert!(refused(&host, of(SessionRole::Tool)).text.contains("application"));
    assert!(refused(&host, of(SessionRole::Gateway)).text.contains("gateway"));
    let mut other = hello(&host);
    other.settings[0].1 = "other".into();
    assert_eq!(refused(&host, other).variable, hello(&host).settings[0].0);
    let empty = SessionHello { relay: None, ..hello(&host) };
    assert_eq!(refused(&host, empty).variable, "AXON_SHM", "it may come back to be relayed");

    // The id of another process, an id that differs from it only in its last byte, and one session too many.
    let witness = session(&host, "witness", false);
    let theirs = SessionHello { session: witness.id(), ..hello(&host) };
    let alike = {
        let mut id = witness.id();
        id.0[15] ^= 1;
        id
    };
    assert!(refused(&host, SessionHello { session: alike, ..theirs }).text.contains("id"));
    let many: Vec<OwnedFd> = (1..32)
        .map(|number| {
            by_hand(&host, SessionHello { session: SessionId([number; 16]), ..hello(&host) })
        })
        .collect();
    let more = SessionHello { session: SessionId([77; 16]), ..hello(&host) };
    assert!(refused(&host, more).text.contains("32 sessions"));
    drop(many);
    until("they are gone", || relays(&host.status().unwrap()).len() == 1);
}

pub(crate) fn stop(daemon: &Kept) {
    let pid = daemon.0.id();
    signal(pid, Signal::STOP);
    let id = WaitId::Pid(Pid::from_raw(pid.cast_signed()).unwrap());
    waitid(id, WaitIdOptions::STOPPED).unwrap();
}

/// In a child: connects as a relayed session whose messages the test sends.
fn call() -> OwnedFd {
    let config = Config::from_env().unwrap();
    let socket = Address::of(&config).connect().unwrap();
    say_to(&socket, &SessionMessage::Hello(hello_of(&config)));
    socket
}

/// In a child: connects, and leaves the connection to a process that reads until the other end hangs up.
pub(crate) fn call_and_leave() -> u32 {
    let socket = call();
    rustix::io::ioctl_fionbio(&socket, false).unwrap();
    let holder = Command::new("cat").stdin(socket).stdout(Stdio::null()).spawn();
    holder.expect("cat is there").id()
}

/// In a child: connects, and leaves the connection to a process that sends until the other end hangs up.
pub(crate) fn call_and_have_it_talk() -> u32 {
    let socket = call();
    assert!(matches!(hear(&socket, |_| true), Some(SessionMessage::Welcome(_))));
    rustix::io::ioctl_fionbio(&socket, false).unwrap();
    let holder = Command::new("yes").stdin(Stdio::null()).stdout(socket).spawn();
    holder.expect("yes is there").id()
}

/// The publisher of a peer whose messages the test sends.
pub(super) fn own() -> Gid {
    Gid::new(SessionId([9; 16]), 1)
}

/// Announces the publisher, and waits for its credit. Returns the bytes that it may send.
pub(super) fn announce_and_await_credit(socket: &OwnedFd) -> u64 {
    say_to(socket, &announce(own(), EndpointKind::Publisher, EndpointRole::Application));
    let credit =
        |m: &SessionMessage| matches!(m, SessionMessage::Credit(c) if c.publisher == own());
    match hear(socket, credit) {
        Some(SessionMessage::Credit(credit)) => credit.bytes,
        other => panic!("instead of credit: {other:?}"),
    }
}

const SAID: u64 = 20;

fn say_all(socket: &OwnedFd) {
    for sequence in 1..=SAID {
        let head =
            Some(SampleHeader { length: 10, sequence, source_timestamp: 0, lost: 0, published: 0 });
        let bytes = pattern(sequence, 10);
        say_to(
            socket,
            &SessionMessage::SampleFragment(SampleFragment {
                publisher: own(),
                head,
                bytes,
                client: None,
            }),
        );
    }
}

/// In a child: publishes when the test tells it to.
pub(crate) fn publish_when_told() {
    let socket = call();
    assert!(matches!(hear(&socket, |_| true), Some(SessionMessage::Welcome(_))));
    announce_and_await_credit(&socket);
    say("credited");
    std::io::stdin().read_line(&mut String::new()).unwrap();
    say_all(&socket);
    say("said");
    wait_for_the_end();
}

#[test]
fn messages_sent_before_the_connection_ended_are_processed() {
    let host = host();
    let daemon = host.daemon();
    let listener = session(&host, "listener", true);
    let subscription = listener.create_subscription(spec("/t", Qos::keep_all())).unwrap();
    let socket = by_hand(&host, hello(&host));
    announce_and_await_credit(&socket);
    until("it is received from", || subscription.matched() == [own()]);
    stop(&daemon);
    say_all(&socket);
    drop(socket);
    signal(daemon.0.id(), Signal::CONT);
    assert!(take_until(&subscription, SAID).into_iter().eq(1..=SAID));
    until("it is gone", || subscription.matched().is_empty());
}

#[test]
fn a_sample_that_cannot_be_written_is_given_up() {
    let host = host();
    let _daemon = host.daemon();
    let socket = by_hand(&host, hello(&host));
    announce_and_await_credit(&socket);
    // Further ahead than any publisher may be.
    let sequence = 1 << 60;
    let head =
        Some(SampleHeader { length: 0, sequence, source_timestamp: 0, lost: 0, published: 0 });
    say_to(
        &socket,
        &SessionMessage::SampleFragment(SampleFragment {
            publisher: own(),
            head,
            bytes: vec![],
            client: None,
        }),
    );
    let told =
        hear(&socket, |m| matches!(m, SessionMessage::GivenUp(_) | SessionMessage::Credit(_)));
    let given_up = RelayGivenUp { reader: own(), writer: own(), samples: 1 };
    assert_eq!(told, Some(SessionMessage::GivenUp(given_up)), "before it counts as acknowledged");
    let done =
        |m: &SessionMessage| matches!(m, SessionMessage::Credit(c) if c.done == Some(sequence));
    assert!(hear(&socket, done).is_some());
}

#[test]
fn messages_sent_by_a_process_before_it_was_killed_are_processed() {
    let host = host();
    let daemon = host.daemon();
    let listener = session(&host, "listener", true);
    let subscription = listener.create_subscription(spec("/t", Qos::keep_all())).unwrap();
    let mut publisher = host.play("publisher by hand");
    assert_eq!(publisher.hear(), "credited");
    until("it is received from", || subscription.matched() == [own()]);
    stop(&daemon);
    publisher.go();
    assert_eq!(publisher.hear(), "said");
    // The daemon can see the end of the process and of the connection before it reads any message of them.
    drop(publisher);
    signal(daemon.0.id(), Signal::CONT);
    assert!(take_until(&subscription, SAID).into_iter().eq(1..=SAID));
    until("it is gone", || subscription.matched().is_empty());
}

#[test]
fn a_connection_used_after_its_process_ended_is_closed() {
    let host = host();
    let _daemon = host.daemon();
    let mut caller = host.play("one that has another talk");
    let pid: i32 = caller.hear().parse().unwrap();
    let holder = pidfd_open(Pid::from_raw(pid).unwrap(), PidfdFlags::empty()).unwrap();
    caller.finish();
    let patience = PATIENCE.try_into().unwrap();
    let ended = poll(&mut [PollFd::new(&holder, PollFlags::IN)], Some(&patience)).unwrap();
    let _ = rustix::process::pidfd_send_signal(&holder, Signal::KILL);
    assert_eq!(ended, 1, "the daemon does not hang up");
    until("it is gone", || relays(&host.status().unwrap()).is_empty());
}

#[test]
fn a_process_that_ended_before_it_is_served_is_not_served() {
    let host = host();
    let daemon = host.daemon();
    let mut caller = host.play("leaver");
    assert_eq!(caller.hear(), "there");
    stop(&daemon);
    caller.go();
    let pid: i32 = caller.hear().parse().unwrap();
    let holder = pidfd_open(Pid::from_raw(pid).unwrap(), PidfdFlags::empty()).unwrap();
    // The process is reaped: another process may have its number.
    caller.finish();
    signal(daemon.0.id(), Signal::CONT);
    let patience = PATIENCE.try_into().unwrap();
    let ended = poll(&mut [PollFd::new(&holder, PollFlags::IN)], Some(&patience)).unwrap();
    let _ = rustix::process::pidfd_send_signal(&holder, Signal::KILL);
    assert_eq!(ended, 1, "the daemon does not hang up");
}

#[test]
fn hostile_frames_end_their_own_relay_and_nothing_else() {
    let host = host();
    let daemon = host.daemon();
    let (from, to) = (session(&host, "from", true), session(&host, "to", false));
    let (publisher, subscription) = connect(&from, &to, "/t", Qos::keep_all());
    let own = Gid::new(SessionId([9; 16]), 1);
    let (application, stand_in) = (EndpointRole::Application, EndpointRole::StandIn);
    let kind = EndpointKind::Publisher;
    let credited = || {
        let socket = by_hand(&host, hello(&host));
        say_to(&socket, &announce(own, kind, application));
        let credit =
            |m: &SessionMessage| matches!(m, SessionMessage::Credit(c) if c.publisher == own);
        assert!(hear(&socket, credit).is_some());
        socket
    };
    for message in [
        SessionMessage::Resync,
        announce(publisher.gid(), kind, application),
        announce(own, kind, stand_in),
        announce(Gid([7; 16]), EndpointKind::Subscription, application),
    ] {
        let socket = by_hand(&host, hello(&host));
        say_to(&socket, &message);
        assert!(hear(&socket, |_| false).is_none(), "{message:?}");
    }
    for pieces in [
        &[piece(own, None, 10)][..],
        &[piece(own, Some(10), 11)],
        &[piece(own, Some(u32::MAX), 0)],
        &[piece(own, Some(10), 5), piece(own, Some(10), 5)],
        &[piece(own, Some(100_000), 31_000), piece(own, None, 31_000)],
    ] {
        let socket = credited();
        // The daemon must read them together: after only the first piece of a long sample it would make room for it.
        stop(&daemon);
        let packets = pieces.iter().map(|piece| piece.encode().unwrap());
        packets.for_each(|packet| socket::send(&socket, &packet, &[]).unwrap());
        signal(daemon.0.id(), Signal::CONT);
        assert!(hear(&socket, |_| false).is_none(), "{pieces:?}");
    }
    for packet in [&[][..], &[25], &[25, 0xff, 0xff], &[0xff; 32 * 1024]] {
        let socket = by_hand(&host, hello(&host));
        let _ = socket::send(&socket, packet, &[]);
        // The daemon skips messages that it does not know.
        let _ = socket::send(&socket, &SessionMessage::Resync.encode().unwrap(), &[]);
        assert!(hear(&socket, |_| false).is_none());
    }
    let socket = by_hand(&host, hello(&host));
    let null = std::fs::File::open("/dev/null").unwrap();
    let descriptor = [null.as_fd()];
    socket::send(&socket, &SessionMessage::Resync.encode().unwrap(), &descriptor).unwrap();
    assert!(hear(&socket, |_| false).is_none(), "descriptors");

    // Samples in the name of another session's publisher are dropped.
    let socket = credited();
    say_to(&socket, &piece(publisher.gid(), Some(4), 4));
    // Samples that nobody reads are done with at once, however many they are.
    (0..600).for_each(|_| say_to(&socket, &piece(own, Some(0), 0)));
    publish(&publisher, &pattern(1, 10));
    assert_eq!(take_until(&subscription, 1), [1]);
    assert_eq!(subscription.received(), 1);
    until("all of it is read", || {
        relays(&host.status().unwrap()).iter().any(|relay| relay.samples_in == 600)
    });
}

/// Connects as a server of its own that answers these clients, according to its messages.
fn server_for(host: &Host, own: Gid, others: Vec<Gid>) -> OwnedFd {
    let socket = by_hand(host, hello(host));
    say_to(&socket, &announce(own, EndpointKind::Server, EndpointRole::Application));
    say_to(&socket, &SessionMessage::Matched(RelayMatched { gid: own, others }));
    socket
}

#[test]
fn unrequested_responses_of_a_hostile_server_reach_no_client() {
    let host = host();
    let _daemon = host.daemon();
    let (here, there) = (session(&host, "server", true), session(&host, "client", false));
    let spec = || EndpointSpec::new("/t", "test/Bytes", Qos::keep_all());
    let server = here.create_server(spec()).unwrap();
    let client = there.create_client(spec()).unwrap();
    assert!(client.wait_available(PATIENCE));
    let own = Gid::new(SessionId([9; 16]), 1);
    let answer = |of: Gid, client: Gid, length: u32, bytes: usize| {
        let head =
            Some(SampleHeader { length, sequence: 1, source_timestamp: 0, lost: 0, published: 0 });
        let bytes = vec![7; bytes];
        SessionMessage::SampleFragment(SampleFragment {
            publisher: of,
            head,
            bytes,
            client: Some(client),
        })
    };

    // The endpoint is not its own, or is no server.
    for gid in [server.gid(), client.gid(), Gid([7; 16])] {
        let socket = by_hand(&host, hello(&host));
        say_to(&socket, &SessionMessage::Matched(RelayMatched { gid, others: vec![client.gid()] }));
        assert!(hear(&socket, |_| false).is_none(), "{gid}");
    }
    let socket = by_hand(&host, hello(&host));
    say_to(&socket, &announce(own, EndpointKind::Client, EndpointRole::Application));
    say_to(
        &socket,
        &SessionMessage::Matched(RelayMatched { gid: own, others: vec![server.gid()] }),
    );
    assert!(hear(&socket, |_| false).is_none(), "a client answers nobody");
    // More clients than it may have.
    let many = (0..1025).map(|number| Gid::new(SessionId([8; 16]), number)).collect();
    assert!(hear(&server_for(&host, own, many), |_| false).is_none());
    // More bytes than there is credit for.
    let socket = server_for(&host, own, vec![client.gid()]);
    let credit = |m: &SessionMessage| matches!(m, SessionMessage::Credit(c) if c.publisher == own && c.client == Some(client.gid()));
    assert!(hear(&socket, credit).is_some());
    say_to(&socket, &answer(own, client.gid(), 10, 11));
    assert!(hear(&socket, |_| false).is_none());

    // The daemon drops a response in the name of another server. It drops a response of a server that has not named its
    // clients yet. It also drops a response to a client that is not matched, and gives the credit for it back at once.
    let stranger = Gid([5; 16]);
    let socket = server_for(&host, own, vec![stranger]);
    say_to(&socket, &answer(server.gid(), client.gid(), 4, 4));
    say_to(&socket, &answer(own, client.gid(), 4, 4));
    let opened =
        |m: &SessionMessage| matches!(m, SessionMessage::Credit(c) if c.client == Some(stranger));
    assert!(hear(&socket, opened).is_some());
    for _ in 0..600 {
        say_to(&socket, &answer(own, stranger, 0, 0));
        assert!(hear(&socket, opened).is_some());
    }
    // It cannot assert the liveliness of publishers that are not its own.
    let publishers = vec![server.gid(), own, stranger];
    say_to(&socket, &SessionMessage::Asserted(Asserted { publishers }));
    assert!(client.recv_response(&mut Vec::new(), Some(Duration::from_millis(20))).is_err());
    let number = client.send_request(b"x").unwrap();
    services::answer(&server);
    let info = client.recv_response(&mut Vec::new(), Some(PATIENCE)).unwrap();
    assert_eq!((info.publisher, info.sequence), (server.gid(), number));
    say_to(&socket, &SessionMessage::Resync);
    assert!(hear(&socket, |_| false).is_none(), "it was there until now");
}

#[test]
fn reader_without_credit_does_not_keep_ended_writers() {
    let host = host();
    let _daemon = host.daemon();
    let here = session(&host, "here", true);
    let own = Gid::new(SessionId([9; 16]), 1);
    let socket = by_hand(&host, hello(&host));
    say_to(&socket, &announce(own, EndpointKind::Subscription, EndpointRole::Application));
    let mut others = Vec::new();
    let mut told = |socket: &OwnedFd, wanted: &dyn Fn(&[Gid]) -> bool| {
        while !wanted(&others) {
            let heard = hear(socket, |m| matches!(m, SessionMessage::Matched(m) if m.gid == own));
            let Some(SessionMessage::Matched(matched)) = heard else { panic!("it hangs up") };
            others = matched.others;
        }
    };
    let mut first = None;
    for _ in 0..300 {
        let publisher = here.create_publisher(spec("/t", Qos::keep_all())).unwrap();
        let gid = publisher.gid();
        first.get_or_insert(gid);
        told(&socket, &|others| others.contains(&gid));
        let credit = open_for(gid, u64::MAX);
        say_to(&socket, &SessionMessage::Credit(credit));
        publish(&publisher, b"x");
        let piece = |m: &SessionMessage| matches!(m, SessionMessage::SampleFragment(p) if p.publisher == gid);
        assert!(hear(&socket, piece).is_some());
    }
    let first = first.unwrap();
    told(&socket, &|others| !others.contains(&first));
}
