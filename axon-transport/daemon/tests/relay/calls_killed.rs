//! Daemons that are killed while calls of relayed sessions pass through them.

use std::{collections::HashSet, sync::mpsc};

use axon_transport::{CallError, Client, Server};

use super::{
    services::{ask, call, nothing_more, respond, serve},
    *,
};

/// Runs a test with a relayed client, and a server that is relayed or shares memory.
fn with_either_server(test: impl Fn(&Host, Kept, &Server, &Client)) {
    for server_shares in [false, true] {
        let host = host();
        let daemon = host.daemon();
        let server_session = session(&host, "server", server_shares);
        let client_session = session(&host, "client", false);
        let server = serve(&server_session);
        let client = ask(&client_session, &server);
        test(&host, daemon, &server, &client);
    }
}

/// Like [`with_either_server`], and also with a client that shares memory and a relayed server.
fn with_any_client(test: impl Fn(&Host, Kept, &Server, &Client)) {
    with_either_server(&test);
    with_sharing_client(test);
}

fn with_sharing_client(test: impl FnOnce(&Host, Kept, &Server, &Client)) {
    let host = host();
    let daemon = host.daemon();
    let server_session = session(&host, "server", false);
    let client_session = session(&host, "client", true);
    let server = serve(&server_session);
    let client = ask(&client_session, &server);
    test(&host, daemon, &server, &client);
}

fn take(server: &Server) -> u64 {
    let mut bytes = Vec::new();
    server.recv_request(&mut bytes, Some(PATIENCE)).expect("a request").sequence
}

fn response(client: &Client) -> u64 {
    client.recv_response(&mut Vec::new(), Some(PATIENCE)).expect("a response").sequence
}

/// Checks that neither end gets anything more, and that calls still work.
fn nothing_is_left(server: &Server, client: &Client) {
    until("the client counts the server", || client.servers().contains(&server.gid()));
    thread::scope(|scope| {
        scope.spawn(|| services::answer(server));
        call(client, b"the next one");
    });
    assert!(!server.has_request(), "a request came twice");
    nothing_more(client);
}

#[test]
fn request_that_a_killed_daemon_had_comes_through_the_next() {
    with_any_client(|host, daemon, server, client| {
        stop(&daemon);
        let number = client.send_request(b"to nobody yet").unwrap();
        // The request may be in the daemon by then, or still in this process.
        thread::sleep(Duration::from_millis(50));
        drop(daemon);
        let _daemon = host.daemon();
        assert_eq!(take(server), number);
        respond(server, client.gid(), number, b"here");
        assert_eq!(response(client), number);
        nothing_is_left(server, client);
    });
}

#[test]
fn response_that_is_given_while_there_is_no_daemon_comes_through_the_next() {
    with_any_client(|host, daemon, server, client| {
        let number = client.send_request(b"taken").unwrap();
        assert_eq!(take(server), number);
        drop(daemon);
        respond(server, client.gid(), number, b"while nobody listens");
        let _daemon = host.daemon();
        assert_eq!(response(client), number);
        nothing_is_left(server, client);
    });
}

#[test]
fn response_that_is_given_after_the_next_daemon_came_is_not_lost() {
    with_any_client(|host, daemon, server, client| {
        let numbers = [(); 3].map(|()| client.send_request(b"taken").unwrap());
        assert_eq!([(); 3].map(|()| take(server)), numbers);
        drop(daemon);
        let _daemon = host.daemon();
        until("the client counts the server", || client.servers().contains(&server.gid()));
        until("the server counts the client", || server.clients().contains(&client.gid()));
        for number in numbers.iter().rev() {
            respond(server, client.gid(), *number, b"late");
            assert_eq!(response(client), *number);
        }
        nothing_is_left(server, client);
    });
}

#[test]
fn responses_that_a_killed_daemon_had_come_through_the_next() {
    with_either_server(|host, daemon, server, client| {
        let numbers: Vec<u64> = (0..8).map(|_| client.send_request(b"taken").unwrap()).collect();
        numbers.iter().for_each(|number| assert_eq!(take(server), *number));
        stop(&daemon);
        // The responses come in another order, and are longer than what is stored in a descriptor.
        for number in numbers.iter().rev() {
            respond(server, client.gid(), *number, &[7; 9000]);
        }
        thread::sleep(Duration::from_millis(50));
        drop(daemon);
        let _daemon = host.daemon();
        let came: Vec<u64> = numbers.iter().map(|_| response(client)).collect();
        assert!(came.iter().eq(numbers.iter().rev()), "{came:?}");
        nothing_is_left(server, client);
    });
}

#[test]
fn many_calls_survive_killed_daemons_and_no_server_sees_one_twice() {
    with_either_server(|host, daemon, server, client| {
        many_calls(host, daemon, server, client, false);
    });
}

#[test]
fn many_calls_of_a_client_that_shares_memory_survive_killed_daemons() {
    // The client may get a response twice.
    with_sharing_client(|host, daemon, server, client| {
        many_calls(host, daemon, server, client, true);
    });
}

fn many_calls(host: &Host, daemon: Kept, server: &Server, client: &Client, twice: bool) {
    const CALLS: u64 = 1500;
    let (tell, done) = mpsc::channel();
    let answered = AtomicU32::new(0);
    thread::scope(|scope| {
        scope.spawn(|| {
            let (mut seen, mut bytes) = (HashSet::new(), Vec::new());
            while seen.len() < CALLS as usize {
                let info = server.recv_request(&mut bytes, Some(PATIENCE)).expect("a request");
                assert!(seen.insert(info.sequence), "{} came twice", info.sequence);
                bytes.reverse();
                respond(server, info.publisher, info.sequence, &bytes);
            }
        });
        scope.spawn(|| {
            let (mut seen, mut bytes) = (HashSet::new(), Vec::new());
            while seen.len() < CALLS as usize {
                let info = client.recv_response(&mut bytes, Some(PATIENCE)).expect("a response");
                let first = seen.insert(info.sequence);
                assert!(first || twice, "{} came twice", info.sequence);
                bytes.reverse();
                assert_eq!(bytes, pattern(info.sequence, len_of(info.sequence)));
                answered.store(seen.len() as u32, Ordering::Relaxed);
            }
            tell.send(()).unwrap();
        });
        scope.spawn(|| {
            for number in 1..=CALLS {
                let bytes = pattern(number, len_of(number));
                assert_eq!(patiently(|| client.send_request(&bytes)), number);
                // Some calls are in flight whenever the daemon is killed.
                until("the others are answered", || {
                    number <= u64::from(answered.load(Ordering::Relaxed)) + 200
                });
            }
        });
        let mut daemon = Some(daemon);
        for kill_at in [300, 700, 1100] {
            until("some are answered", || answered.load(Ordering::Relaxed) >= kill_at);
            drop(daemon.take());
            daemon = Some(host.daemon());
        }
        done.recv_timeout(PATIENCE).unwrap();
    });
    assert!(!server.has_request() && (twice || !client.has_response()));
}

fn len_of(number: u64) -> usize {
    if number.is_multiple_of(50) { 40_000 } else { 90 }
}

#[test]
fn call_that_waits_gets_its_response_through_the_next_daemon() {
    with_any_client(|host, daemon, server, client| {
        thread::scope(|scope| {
            let calling = scope.spawn(|| client.call_blocking(b"abc", Some(PATIENCE)));
            let number = take(server);
            drop(daemon);
            let _daemon = host.daemon();
            respond(server, client.gid(), number, b"cba");
            assert_eq!(calling.join().unwrap().unwrap(), b"cba");
        });
    });
}

#[test]
fn call_fails_once_no_daemon_came_or_its_server_did_not_come_back() {
    for (next, client_shares) in [(false, false), (true, false), (false, true), (true, true)] {
        let host = host();
        let daemon = host.daemon();
        let relaying = relaying(&host);
        let client_session = session(&host, "client", client_shares);
        let mut server = relaying.play("server");
        assert_eq!(server.hear(), "serves");
        let client = client_session.create_client(services::service()).unwrap();
        assert!(client.wait_available(PATIENCE));
        call(&client, b"abc");
        thread::scope(|scope| {
            let calling = scope.spawn(|| client.call_blocking(b"never answered", Some(PATIENCE)));
            assert_eq!(server.hear(), "took");
            drop(daemon);
            signal(server.pid(), Signal::KILL);
            let _daemon = next.then(|| host.daemon());
            assert!(
                matches!(calling.join().unwrap(), Err(CallError::ServerGone)),
                "{next} {client_shares}"
            );
        });
    }
}
