//! Services: each client gets only its own responses; which servers and clients see each other.

#[path = "support/alone.rs"]
mod alone;
mod support;

use std::{
    collections::{HashMap, HashSet},
    sync::Arc,
    thread,
    time::Duration,
};

use alone::alone;
use axon_shm::PublishError;
use axon_transport::{
    Client, EndpointSpec, NewDataCallback, Server, Waitable,
    graph::EndpointKind,
    ids::Gid,
    qos::{History, Qos},
};
use rustix::process::Signal;
use support::{Host, PATIENCE, of_child, say, signal, until, wait_for_the_end};

const CLIENTS: usize = 20;
const CALLS: u64 = 50;

fn spec() -> EndpointSpec {
    EndpointSpec::new("/add", "Add", Qos::default())
}

/// Returns a spec whose endpoint keeps `depth` untaken messages, or all without a depth.
fn keeping(depth: Option<u32>) -> EndpointSpec {
    let qos = match depth {
        Some(depth) => Qos::default().with_history(History::KeepLast).with_depth(depth),
        None => Qos::keep_all(),
    };
    spec().qos(qos)
}

/// Takes all waiting requests, and returns their clients and numbers.
fn requests(server: &Server) -> Vec<(Gid, u64)> {
    let take = || server.take_request(&mut Vec::new());
    std::iter::from_fn(take).map(|info| (info.publisher, info.sequence)).collect()
}

fn responses(client: &Client) -> Vec<u64> {
    std::iter::from_fn(|| client.take_response(&mut Vec::new())).map(|info| info.sequence).collect()
}

/// Answers one request with its bytes reversed.
fn answer(server: &Server) {
    let mut bytes = Vec::new();
    let request = server.recv_request(&mut bytes, Some(PATIENCE)).expect("a request");
    bytes.reverse();
    server.send_response(request.publisher, request.sequence, &bytes).unwrap();
}

fn call(client: &Client, bytes: &[u8]) -> Vec<u8> {
    let number = client.send_request(bytes).unwrap();
    let mut response = Vec::new();
    let info = client.recv_response(&mut response, Some(PATIENCE)).expect("a response");
    assert_eq!(info.sequence, number, "the response to another request");
    response
}

fn text(number: u64) -> Vec<u8> {
    // Some messages are in pinned memory.
    let len = if number.is_multiple_of(7) { 10_000 } else { 20 };
    (0..len).map(|at| (at + number) as u8).collect()
}

/// The code of the children of the tests. It does nothing in a run of the tests themselves.
#[test]
fn child() {
    let Ok(part) = std::env::var("PLAY") else { return };
    let session = of_child(&part);
    match part.as_str() {
        "caller" => {
            let client = session.create_client(spec()).unwrap();
            assert!(client.wait_available(PATIENCE));
            for number in 0..CALLS {
                let bytes = text(number);
                let mut expected = bytes.clone();
                expected.reverse();
                assert_eq!(call(&client, &bytes), expected);
            }
            say("complete");
            wait_for_the_end();
        }
        // Sends requests and never takes a response.
        "asker" => {
            let client = session.create_client(spec()).unwrap();
            assert!(client.wait_available(PATIENCE));
            for _ in 0..CALLS {
                client.send_request(b"x").unwrap();
            }
            say("asked");
            wait_for_the_end();
        }
        "server" => {
            let server = session.create_server(spec()).unwrap();
            say("serves");
            let mut bytes = Vec::new();
            // Answers one request and is in the middle of the next.
            answer(&server);
            server.recv_request(&mut bytes, Some(PATIENCE)).unwrap();
            say("took");
            wait_for_the_end();
        }
        _ => unreachable!("no such part: {part}"),
    }
}

#[test]
fn a_service_is_available_from_when_both_directions_stand_until_it_is_gone() {
    let session = alone();
    let node = session.create_node("n", "/", "/").unwrap();
    let client = session.create_client(spec()).unwrap();
    assert!(!client.is_available());
    client.send_request(b"nobody hears it").unwrap();
    let other = EndpointSpec::new("/add", "Subtract", Qos::default());
    let _other = session.create_server(other).unwrap();
    assert!(!client.is_available(), "of another type");
    let server = session.create_server(spec()).unwrap();
    assert!(client.is_available(), "created means matched");
    assert_eq!((client.servers(), server.clients()), (vec![server.gid()], vec![client.gid()]));
    assert_eq!(call_in_thread(&client, &server), b"cba");
    assert!(session.wait_graph(PATIENCE, |graph| graph.count(EndpointKind::Server, "/add") == 2));
    let changed = [Waitable::GuardCondition(node.graph_changed())];
    drop(server);
    while client.is_available() {
        assert_eq!(session.wait_for(&changed, Some(PATIENCE)).unwrap(), [0]);
    }
}

fn call_in_thread(client: &Client, server: &Server) -> Vec<u8> {
    thread::scope(|scope| {
        scope.spawn(|| answer(server));
        call(client, b"abc")
    })
}

#[test]
fn responses_reach_their_client_in_the_order_sent() {
    let session = alone();
    let server = session.create_server(spec()).unwrap();
    let clients: Vec<Client> = (0..3).map(|_| session.create_client(spec()).unwrap()).collect();
    let mut asked = HashMap::new();
    for (number, client) in clients.iter().enumerate() {
        for _ in 0..10 {
            asked.insert((client.gid(), client.send_request(&[number as u8]).unwrap()), number);
        }
    }
    let mut requests = Vec::new();
    let mut bytes = Vec::new();
    while let Some(request) = server.take_request(&mut bytes) {
        assert_eq!(asked[&(request.publisher, request.sequence)], usize::from(bytes[0]));
        requests.push(request);
    }
    assert_eq!(requests.len(), 30);
    for request in requests.iter().rev() {
        server.send_response(request.publisher, request.sequence, b"answer").unwrap();
    }
    for client in &clients {
        let order: Vec<u64> =
            std::iter::from_fn(|| client.take_response(&mut bytes).map(|info| info.sequence))
                .collect();
        let expected: Vec<u64> = requests
            .iter()
            .rev()
            .filter(|r| r.publisher == client.gid())
            .map(|r| r.sequence)
            .collect();
        assert_eq!(order, expected);
    }
}

#[test]
fn a_response_without_a_waiting_client_is_no_error() {
    let session = alone();
    let server = session.create_server(spec()).unwrap();
    let client = session.create_client(spec()).unwrap();
    let gid = client.gid();
    client.send_request(b"x").unwrap();
    let request = server.take_request(&mut Vec::new()).unwrap();
    drop(client);
    until("the server heard of it", || server.clients().is_empty());
    server.send_response(request.publisher, request.sequence, b"late").unwrap();
    server.send_response(gid, 77, b"to a number that was never given").unwrap();
    server.send_response(Gid([3; 16]), 1, b"to a stranger").unwrap();
}

#[test]
fn profiles_that_go_together_one_way_only_make_no_service() {
    let session = alone();
    let weak = spec().qos(Qos::sensor_data());
    let client = session.create_client(weak.clone()).unwrap();
    let server = session.create_server(spec()).unwrap();
    thread::sleep(Duration::from_millis(50));
    assert!(!client.is_available() && server.clients().is_empty());
    let _weak = session.create_server(weak).unwrap();
    assert!(client.is_available());
}

#[test]
fn a_waiting_end_is_woken_and_told() {
    let session = alone();
    let server = session.create_server(spec()).unwrap();
    let client = session.create_client(spec()).unwrap();
    let both = [Waitable::Server(&server), Waitable::Client(&client)];
    client.send_request(b"x").unwrap();
    assert_eq!(session.wait_for(&both, None).unwrap(), [0]);
    let (sender, told) = std::sync::mpsc::channel();
    let tell = |sender: &std::sync::mpsc::Sender<u64>| -> NewDataCallback {
        let sender = sender.clone();
        Arc::new(move |new| {
            let _ = sender.send(new);
        })
    };
    server.set_on_new_request(Some(tell(&sender))).unwrap();
    assert_eq!(told.recv_timeout(PATIENCE), Ok(1));
    answer(&server);
    assert_eq!(session.wait_for(&both, None).unwrap(), [1]);
    client.set_on_new_response(Some(tell(&sender))).unwrap();
    assert_eq!(told.recv_timeout(PATIENCE), Ok(1));
}

#[test]
fn twenty_clients_in_twenty_processes_get_each_their_own() {
    let host = Host::new();
    let _daemon = host.daemon();
    let session = host.session("server").unwrap();
    let server = session.create_server(spec()).unwrap();
    let mut players: Vec<_> = (0..CLIENTS).map(|_| host.play("caller")).collect();
    for _ in 0..CLIENTS as u64 * CALLS {
        answer(&server);
    }
    players.iter_mut().for_each(|player| assert_eq!(player.hear(), "complete"));
    assert_eq!(server.clients().len(), CLIENTS);
    players.into_iter().for_each(support::Player::finish);
    until("all of them are gone", || server.clients().is_empty());
}

#[test]
fn a_client_killed_with_pending_responses_leaves_the_server_working() {
    let host = Host::new();
    let _daemon = host.daemon();
    let session = host.session("server").unwrap();
    let server = session.create_server(keeping(None)).unwrap();
    let mut asker = host.play("asker");
    assert_eq!(asker.hear(), "asked");
    let mut bytes = Vec::new();
    let mut requests = Vec::new();
    for number in 0..CALLS {
        requests.push(server.recv_request(&mut bytes, Some(PATIENCE)).unwrap());
        if number == CALLS / 2 {
            signal(asker.pid(), Signal::KILL);
        }
        let request = &requests[requests.len() - 1];
        server.send_response(request.publisher, request.sequence, &[0; 9000]).unwrap();
    }
    until("the server heard of it", || server.clients().is_empty());
    for request in &requests {
        server.send_response(request.publisher, request.sequence, b"late").unwrap();
    }
    let mut caller = host.play("caller");
    (0..CALLS).for_each(|_| answer(&server));
    assert_eq!(caller.hear(), "complete");
    caller.finish();
}

#[test]
fn a_client_that_takes_nothing_is_waited_for_briefly_and_loses_nothing() {
    let host = Host::new();
    let _daemon = host.daemon();
    let (here, there) = (host.session("server").unwrap(), host.session("client").unwrap());
    let server = here.create_server(spec()).unwrap();
    let client = there.create_client(keeping(None)).unwrap();
    assert!(client.wait_available(PATIENCE));
    until("both ends know it", || !server.clients().is_empty());
    let mut sent = 0;
    let refused = loop {
        match server.send_response(client.gid(), sent + 1, &sent.to_le_bytes()) {
            Ok(()) => sent += 1,
            Err(error) => break error,
        }
    };
    assert!(matches!(refused, PublishError::Blocked { .. }), "{refused}");
    let mut bytes = Vec::new();
    for number in 0..sent {
        let info = client.take_response(&mut bytes).expect("none of them is lost");
        assert_eq!((info.sequence, &bytes[..]), (number + 1, &number.to_le_bytes()[..]));
    }
}

#[test]
fn a_server_keeps_of_each_client_the_newest_requests_up_to_its_depth() {
    let session = alone();
    let servers = [Some(1), Some(3), None].map(|d| session.create_server(keeping(d)).unwrap());
    let clients = [spec(), spec()].map(|spec| session.create_client(spec).unwrap());
    assert!(clients.iter().all(|client| client.servers().len() == 3));
    for number in 1..=40 {
        clients.iter().for_each(|client| assert_eq!(client.send_request(b"x").unwrap(), number));
    }
    for (server, depth) in servers.iter().zip([1, 3, 40]) {
        let newest = 41 - depth..=40;
        let expected = newest.flat_map(|number| clients.each_ref().map(|c| (c.gid(), number)));
        assert_eq!(requests(server), expected.collect::<Vec<_>>());
    }
}

#[test]
fn a_client_keeps_of_each_server_the_newest_responses_up_to_its_depth() {
    let session = alone();
    let servers = [spec(), spec()].map(|spec| session.create_server(spec).unwrap());
    let clients = [Some(1), Some(3), None].map(|d| session.create_client(keeping(d)).unwrap());
    for client in &clients {
        assert_eq!(client.servers().len(), 2);
        for server in &servers {
            for number in 1..=40 {
                server.send_response(client.gid(), number, b"y").unwrap();
            }
        }
    }
    for (client, depth) in clients.iter().zip([1, 3, 40]) {
        let newest = 41 - depth..=40;
        assert_eq!(responses(client), newest.clone().chain(newest).collect::<Vec<_>>());
    }
}

#[test]
fn server_of_depth_one_answers_twenty_clients_at_once() {
    let session = alone();
    let server = session.create_server(keeping(Some(1))).unwrap();
    let clients: Vec<_> = (0..CLIENTS).map(|_| session.create_client(spec()).unwrap()).collect();
    clients.iter().for_each(|client| assert_eq!(client.send_request(b"x").unwrap(), 1));
    (0..CLIENTS).for_each(|_| answer(&server));
    clients.iter().for_each(|client| assert_eq!(responses(client), [1]));
}

#[test]
fn a_late_callback_is_told_the_number_of_takeable_requests() {
    let session = alone();
    let server = session.create_server(keeping(Some(2))).unwrap();
    let clients = [spec(), spec()].map(|spec| session.create_client(spec).unwrap());
    for client in clients.iter().flat_map(|client| [client; 5]) {
        client.send_request(b"x").unwrap();
    }
    let (sender, told) = std::sync::mpsc::channel();
    let tell: NewDataCallback = Arc::new(move |new| {
        let _ = sender.send(new);
    });
    server.set_on_new_request(Some(tell)).unwrap();
    assert_eq!(told.recv_timeout(PATIENCE), Ok(4));
}

/// Sends more than fits in any ring to an endpoint that takes nothing meanwhile.
#[test]
fn a_keep_last_service_never_blocks() {
    const MANY: u64 = 20_000;
    let host = Host::new();
    let _daemon = host.daemon();
    let (here, there) = (host.session("server").unwrap(), host.session("client").unwrap());
    let server = here.create_server(keeping(Some(3))).unwrap();
    let client = there.create_client(keeping(Some(2))).unwrap();
    assert!(client.wait_available(PATIENCE));
    until("both ends know it", || server.clients() == [client.gid()]);
    for number in 1..=MANY {
        assert_eq!(client.send_request(b"x").unwrap(), number);
    }
    assert_eq!(requests(&server), [MANY - 2, MANY - 1, MANY].map(|n| (client.gid(), n)));
    for number in 1..=MANY {
        server.send_response(client.gid(), number, b"y").unwrap();
    }
    assert_eq!(responses(&client), [MANY - 1, MANY]);
}

/// Messages within the depth are not dropped for lack of space either.
#[test]
fn a_depth_that_there_is_no_room_for_is_waited_for() {
    static LARGE: [u8; 300_000] = [7; 300_000];
    let host = Host::new().with("AXON_RING_BUFFER_SIZE_MB", "1");
    let _daemon = host.daemon();
    let (here, there) = (host.session("server").unwrap(), host.session("client").unwrap());
    let server = here.create_server(keeping(Some(100))).unwrap();
    let client = there.create_client(spec()).unwrap();
    assert!(client.wait_available(PATIENCE));
    let mut sent = 0;
    let refused = loop {
        match client.send_request(&LARGE) {
            Ok(number) => sent = number,
            Err(error) => break error,
        }
        assert!(sent < 100, "nothing holds it back");
    };
    assert!(matches!(refused, PublishError::Blocked { .. }), "{refused}");
    assert!(requests(&server).into_iter().map(|(_, number)| number).eq(1..=sent));
    client.send_request(&LARGE).unwrap();
}

#[test]
fn a_server_that_dies_in_a_call_is_not_available_and_another_one_is() {
    let host = Host::new();
    let _daemon = host.daemon();
    let session = host.session("client").unwrap();
    let node = session.create_node("n", "/", "/").unwrap();
    let client = session.create_client(spec()).unwrap();
    let mut server = host.play("server");
    assert_eq!(server.hear(), "serves");
    assert!(client.wait_available(PATIENCE));
    assert_eq!(call(&client, b"abc"), b"cba");
    client.send_request(b"never answered").unwrap();
    assert_eq!(server.hear(), "took");
    signal(server.pid(), Signal::KILL);
    let changed = [Waitable::GuardCondition(node.graph_changed())];
    while client.is_available() {
        assert_eq!(session.wait_for(&changed, Some(PATIENCE)).unwrap(), [0]);
    }
    assert!(client.recv_response(&mut Vec::new(), Some(Duration::from_millis(20))).is_err());
    let mut next = host.play("server");
    assert_eq!(next.hear(), "serves");
    assert!(client.wait_available(PATIENCE));
    assert_eq!(call(&client, b"xyz"), b"zyx");
}

#[test]
fn calls_go_on_while_the_daemon_is_replaced() {
    let host = Host::new();
    let mut daemon = host.daemon();
    let (here, there) = (host.session("server").unwrap(), host.session("client").unwrap());
    let server = here.create_server(spec()).unwrap();
    let client = there.create_client(spec()).unwrap();
    assert!(client.wait_available(PATIENCE));
    let mut numbers = HashSet::new();
    for round in 0..3 {
        assert_eq!(call_in_thread(&client, &server), b"cba");
        let before = there.daemon();
        daemon.0.kill().unwrap();
        daemon.0.wait().unwrap();
        assert_eq!(call_in_thread(&client, &server), b"cba", "without a daemon");
        daemon = host.daemon();
        until("another daemon", || there.daemon().is_some_and(|now| Some(now) != before));
        assert!(client.wait_available(PATIENCE));
        assert!(numbers.insert(client.send_request(b"last").unwrap()), "round {round}");
        answer(&server);
        assert!(client.recv_response(&mut Vec::new(), Some(PATIENCE)).is_ok());
    }
}
