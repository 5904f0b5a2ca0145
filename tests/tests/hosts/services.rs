//! A service on A, clients on A and B: each gets its own responses, and each end knows exactly when the
//! other is there.

use std::{
    collections::BTreeMap,
    fs,
    sync::atomic::{AtomicBool, Ordering},
    thread,
    time::Duration,
};

use axon_tests::{Sizes, payload};
use axon_transport::{Client, EndpointSpec, MessageInfo, Server, Session, qos::Qos};
use rustix::process::Signal;

use super::{
    cut::wired,
    mode::{Kmes, Settings, classic},
    pair::{Host, Plan, kill, signal},
    process::{PATIENCE, until},
};

const CLIENTS: u64 = 20;
const CALLS: u64 = 20;
const SERVICE: &str = "/echo";

/// Returns the specification of a KEEP_ALL service, which passes over no message that was not taken.
fn spec() -> EndpointSpec {
    EndpointSpec::new(SERVICE, "test/Echo", Qos::keep_all())
}

fn server(session: &Session) -> Server {
    session.create_server(spec()).unwrap()
}

fn client(session: &Session) -> Client {
    session.create_client(spec()).unwrap()
}

fn take(server: &Server, bytes: &mut Vec<u8>) -> MessageInfo {
    server.recv_request(bytes, Some(PATIENCE)).expect("a request")
}

/// Answers one request with its bytes reversed.
fn answer(server: &Server) {
    let mut bytes = Vec::new();
    let request = take(server, &mut bytes);
    bytes.reverse();
    server.send_response(request.publisher, request.sequence, &bytes).unwrap();
}

fn call(client: &Client, bytes: &[u8]) {
    let number = client.send_request(bytes).unwrap();
    receive(client, number, bytes);
}

fn receive(client: &Client, number: u64, asked: &[u8]) {
    let mut response = Vec::new();
    let info = client.recv_response(&mut response, Some(PATIENCE)).expect("a response");
    assert_eq!(info.sequence, number, "the response to another request");
    response.reverse();
    assert!(response == asked, "another's response, or a broken one");
}

/// Runs the test for each way in which two hosts may be set up.
fn in_all(test: impl Fn([Host; 2])) {
    test(Plan::new([classic(&[]), classic(&[])]).start());
    for key_mode in ["session", "messages10"] {
        let kmes = Kmes::start();
        let more = [("AXON_QKD_KEY_MODE", key_mode)];
        let settings: [Settings; 2] = [0, 1].map(|host| kmes.settings(host, &more));
        test(Plan::new(settings).start());
    }
}

#[test]
fn twenty_clients_get_each_their_own() {
    in_all(|[a, b]| {
        let session = a.session("server");
        let server = server(&session);
        thread::scope(|scope| {
            for number in 0..CLIENTS {
                let host = if number % 10 == 0 { &a } else { &b };
                scope.spawn(move || {
                    let session = host.session("client");
                    let client = client(&session);
                    assert!(client.wait_available(PATIENCE));
                    let mut bytes = Vec::new();
                    for call_number in 0..CALLS {
                        payload(Sizes::Mixed, number * CALLS + call_number, &mut bytes);
                        call(&client, &bytes);
                    }
                });
            }
            (0..CLIENTS * CALLS).for_each(|_| answer(&server));
        });
        until("all clients are gone", || server.clients().is_empty());
    });
}

#[test]
fn available_servers_are_reached_and_gone_servers_are_unavailable() {
    in_all(|[a, b]| {
        let (here, there) = (a.session("server"), b.session("client"));
        let first = client(&there);
        assert!(!first.is_available());
        for _ in 0..3 {
            let server = server(&here);
            assert!(first.wait_available(PATIENCE));
            let number = first.send_request(b"at once").unwrap();
            // Another client meets a service that is there already.
            let second = client(&there);
            assert!(second.wait_available(PATIENCE));
            let other = second.send_request(b"too").unwrap();
            answer(&server);
            answer(&server);
            receive(&first, number, b"at once");
            receive(&second, other, b"too");
            let both = [first.gid(), second.gid()];
            until("both are known", || both.iter().all(|gid| server.clients().contains(gid)));
            assert_eq!(
                (first.servers(), second.servers()),
                (vec![server.gid()], vec![server.gid()])
            );
            drop(second);
            until("one is gone", || server.clients() == [first.gid()]);
            drop(server);
            until("the server is gone", || !first.is_available());
        }
    });
}

#[test]
fn a_request_goes_to_all_servers_there_are_and_each_answers() {
    let [a, b] = Plan::new([classic(&[]), classic(&[])]).start();
    let (here, there) = (a.session("servers"), b.session("client"));
    let servers = [server(&here), server(&here), server(&there)];
    let client = client(&there);
    until("all are available", || client.servers().len() == 3);
    for _ in 0..10 {
        let number = client.send_request(b"abc").unwrap();
        servers.iter().for_each(answer);
        (0..3).for_each(|_| receive(&client, number, b"abc"));
    }
    thread::sleep(Duration::from_millis(50));
    assert!(servers.iter().all(|server| !server.has_request()) && !client.has_response());
}

#[test]
fn a_client_killed_with_pending_responses_leaves_the_server_working() {
    in_all(|[a, b]| {
        let session = a.session("server");
        let server = server(&session);
        let mut asker = b.node(&["ask", SERVICE, &CALLS.to_string()]);
        asker.wait_ready();
        let mut bytes = Vec::new();
        let mut requests: Vec<MessageInfo> = Vec::new();
        for number in 0..CALLS {
            requests.push(take(&server, &mut bytes));
            if number == CALLS / 2 {
                asker.wait_sent();
                kill(asker.pid());
            }
            let request = &requests[requests.len() - 1];
            server.send_response(request.publisher, request.sequence, &[0; 9000]).unwrap();
        }
        until("the server heard of it", || server.clients().is_empty());
        for request in &requests {
            server.send_response(request.publisher, request.sequence, b"late").unwrap();
        }
        let there = b.session("client");
        let client = client(&there);
        assert!(client.wait_available(PATIENCE));
        let number = client.send_request(b"abc").unwrap();
        answer(&server);
        receive(&client, number, b"abc");
    });
}

#[test]
fn a_server_that_dies_in_a_call_is_not_available_and_another_one_is() {
    in_all(|[a, b]| {
        let session = b.session("client");
        let client = client(&session);
        let mut server = a.node(&["serve", SERVICE, "1"]);
        server.wait_ready();
        assert!(client.wait_available(PATIENCE));
        call(&client, b"abc");
        client.send_request(b"never answered").unwrap();
        server.wait_sent();
        kill(server.pid());
        until("it is not available", || !client.is_available());
        assert!(client.recv_response(&mut Vec::new(), Some(Duration::from_millis(20))).is_err());
        let mut next = a.node(&["serve", SERVICE, "1"]);
        next.wait_ready();
        assert!(client.wait_available(PATIENCE));
        call(&client, b"xyz");
    });
}

#[test]
fn calls_go_on_when_the_link_is_back() {
    in_all(|[a, b]| {
        let (here, there) = (a.session("server"), b.session("client"));
        let (server, client) = (server(&here), client(&there));
        assert!(client.wait_available(PATIENCE));
        let daemon = b.status().pid;
        for _ in 0..2 {
            signal(daemon, Signal::STOP);
            until("it stands still", || stands_still(daemon));
            let number = client.send_request(b"before").unwrap();
            assert!(
                server.recv_request(&mut Vec::new(), Some(Duration::from_millis(300))).is_err()
            );
            signal(daemon, Signal::CONT);
            answer(&server);
            receive(&client, number, b"before");
        }
    });
}

fn stands_still(pid: u32) -> bool {
    let tasks = fs::read_dir(format!("/proc/{pid}/task")).unwrap();
    let mut stats =
        tasks.map(|task| fs::read_to_string(task.unwrap().path().join("stat")).unwrap());
    stats.all(|stat| stat.contains(") T "))
}

#[test]
fn a_service_is_back_with_the_daemon_of_its_host_or_of_its_clients() {
    for victim in [0, 1] {
        let mut hosts = Plan::new([classic(&[]), classic(&[])]).start();
        let (here, there) = (hosts[0].session("server"), hosts[1].session("client"));
        let (server, client) = (server(&here), client(&there));
        assert!(client.wait_available(PATIENCE));
        let number = client.send_request(b"first").unwrap();
        answer(&server);
        receive(&client, number, b"first");
        let killed = hosts[victim].kill_daemon();
        hosts[victim].start();
        let next = hosts[victim].status();
        assert_ne!(next.daemon, killed.daemon);
        until("a link to the new daemon, and none to the old one", || {
            let links = hosts[1 - victim].status().links;
            links.len() == 1 && links[0].peer == next.daemon
        });
        until("a call is answered", || {
            let Ok(number) = client.send_request(b"again") else { return false };
            let mut bytes = Vec::new();
            while let Ok(request) = server.recv_request(&mut bytes, Some(Duration::from_secs(2))) {
                let answered = bytes.iter().rev().copied().collect::<Vec<_>>();
                server.send_response(request.publisher, request.sequence, &answered).unwrap();
                if request.sequence == number {
                    break;
                }
            }
            // Answers to calls that were given up may come first.
            let answer = || client.recv_response(&mut bytes, Some(Duration::from_secs(2))).ok();
            std::iter::from_fn(answer).any(|info| info.sequence == number)
        });
        assert_eq!((client.servers(), server.clients()), (vec![server.gid()], vec![client.gid()]));
    }
}

/// Requests that a server saw, or responses that a client got: how often, by client or server, and number.
type Calls = BTreeMap<(String, u64), u32>;

/// Takes the responses to a client until none has come for some seconds: the link may have to be replaced first.
fn responses(client: &Client) -> Calls {
    let mut got = Calls::new();
    let mut bytes = Vec::new();
    while let Ok(info) = client.recv_response(&mut bytes, Some(Duration::from_secs(5))) {
        *got.entry((info.publisher.to_string(), info.sequence)).or_default() += 1;
    }
    got
}

/// Answers requests until `over`, two at a time and the newer one first.
fn serve(server: &Server, over: &AtomicBool) -> Calls {
    let mut seen = Calls::new();
    let mut held = Vec::new();
    let mut bytes = Vec::new();
    loop {
        let request = server.recv_request(&mut bytes, Some(Duration::from_millis(200))).ok();
        let waits = request.is_none();
        if let Some(request) = request {
            *seen.entry((request.publisher.to_string(), request.sequence)).or_default() += 1;
            held.push((request, bytes.iter().rev().copied().collect::<Vec<_>>()));
        }
        if held.len() > 1 || waits {
            for (request, answer) in held.drain(..).rev() {
                server.send_response(request.publisher, request.sequence, &answer).unwrap();
            }
        }
        if waits && over.load(Ordering::Relaxed) {
            return seen;
        }
    }
}

/// Tests services while the link breaks. Two servers on each host answer a client on the other one. The wire is cut for
/// some seconds, and then works only for new connections. Each server must see each request once, and each client must
/// get each response once.
fn calls_outlive_a_link(settings: [Settings; 2]) {
    let (hosts, wire) = wired(settings);
    let sessions = hosts.each_ref().map(|host| host.session("calls"));
    let name = |host: usize| EndpointSpec::new(["/a", "/b"][host], "test/Echo", Qos::keep_all());
    let servers: Vec<_> = [0, 0, 1, 1].map(|h| sessions[h].create_server(name(h)).unwrap()).into();
    let clients = [0, 1].map(|host| sessions[host].create_client(name(1 - host)).unwrap());
    until("all are available", || clients.iter().all(|client| client.servers().len() == 2));
    let over = AtomicBool::new(false);
    thread::scope(|scope| {
        let serving = servers.iter().map(|server| scope.spawn(|| serve(server, &over)));
        let serving: Vec<_> = serving.collect();
        let mut sent = [0; 2];
        let mut send = |number: usize, pause: Duration| {
            for _ in 0..number {
                for (client, sent) in clients.iter().zip(&mut sent) {
                    *sent = client.send_request(b"over a link that breaks").unwrap();
                }
                thread::sleep(pause);
            }
        };
        send(300, Duration::from_millis(2));
        wire.cut();
        send(400, Duration::from_millis(20));
        wire.mend_for_newcomers();
        send(300, Duration::from_millis(5));
        let got = clients.each_ref().map(responses);
        over.store(true, Ordering::Relaxed);
        let seen: Vec<_> = serving.into_iter().map(|serving| serving.join().unwrap()).collect();
        let whole = |seen: &Calls| (seen.len() as u64, seen.values().filter(|n| **n != 1).count());
        let counts: Vec<_> = got.iter().chain(&seen).map(whole).collect();
        // Two servers answer each request.
        let [a, b] = sent;
        let expected = [2 * a, 2 * b, b, b, a, a].map(|all| (all, 0));
        assert_eq!(counts, expected, "responses to each client, and requests that each server saw");
    });
    // The link that broke was replaced.
    assert!(hosts.iter().all(|host| host.status().links.len() == 1));
}

#[test]
fn in_classic_calls_outlive_a_link() {
    calls_outlive_a_link([classic(&[]), classic(&[])]);
}

#[test]
fn in_messages10_calls_outlive_a_link() {
    let kmes = Kmes::start();
    calls_outlive_a_link([0, 1].map(|h| kmes.settings(h, &[("AXON_QKD_KEY_MODE", "messages10")])));
}
