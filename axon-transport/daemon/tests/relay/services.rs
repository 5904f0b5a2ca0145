//! Services whose requests and responses pass through the daemon: which servers and clients see each other, and which
//! client gets each response.

use std::collections::HashSet;

use axon_transport::{Client, Server, Waitable};

use super::*;

const CLIENTS: usize = 20;
pub(crate) const CALLS: u64 = 50;

/// A service that skips no message that nobody has taken.
pub(crate) fn service() -> EndpointSpec {
    EndpointSpec::new("/add", "Add", Qos::keep_all())
}

/// Answers one request with its bytes reversed.
pub(crate) fn answer(server: &Server) -> Gid {
    let mut bytes = Vec::new();
    let request = server.recv_request(&mut bytes, Some(PATIENCE)).expect("a request");
    bytes.reverse();
    respond(server, request.publisher, request.sequence, &bytes);
    request.publisher
}

pub(crate) fn respond(server: &Server, client: Gid, sequence: u64, bytes: &[u8]) {
    patiently(|| server.send_response(client, sequence, bytes));
}

pub(crate) fn call(client: &Client, bytes: &[u8]) {
    let number = client.send_request(bytes).unwrap();
    let mut response = Vec::new();
    let info = client.recv_response(&mut response, Some(PATIENCE)).expect("a response");
    assert_eq!(info.sequence, number, "the response to another request");
    assert!(response.iter().rev().eq(bytes), "the response to something else");
}

pub(crate) fn call_in_thread(client: &Client, server: &Server, bytes: &[u8]) {
    thread::scope(|scope| {
        scope.spawn(|| answer(server));
        call(client, bytes);
    });
}

pub(crate) fn serve(session: &Session) -> Server {
    session.create_server(service()).unwrap()
}

/// Creates a client, and waits until it counts `server`.
pub(crate) fn ask(session: &Session, server: &Server) -> Client {
    let client = session.create_client(service()).unwrap();
    until("the client counts the server", || client.servers().contains(&server.gid()));
    client
}

/// Runs a test with a session that shares memory and with one that does not, together with relayed processes.
fn beside_relayed(name: &str, test: impl Fn(&Session, &Host)) {
    let host = host();
    let _daemon = host.daemon();
    let relaying = relaying(&host);
    for shm in [true, false] {
        test(&session(&host, name, shm), &relaying);
    }
}

pub(crate) fn nothing_more(client: &Client) {
    let mut bytes = Vec::new();
    assert!(client.recv_response(&mut bytes, Some(Duration::from_millis(20))).is_err());
}

#[test]
fn calls_of_all_sizes_cross_whichever_side_shares_memory() {
    with_both_ends(|here, there| {
        let server = serve(here);
        let client = ask(there, &server);
        for (number, len) in (0..).zip([0, 1, 4097, 31 << 10, 64 << 10, 3_000_000, 1]) {
            call_in_thread(&client, &server, &pattern(number, len));
        }
        assert_eq!((server.clients(), client.servers()), (vec![client.gid()], vec![server.gid()]));
    });
}

#[test]
fn a_service_is_available_while_it_is_there_and_to_those_it_goes_with() {
    with_both_ends(|here, there| {
        let node = there.create_node("n", "/", "/").unwrap();
        let changed = [Waitable::GuardCondition(node.graph_changed())];
        let client = there.create_client(service()).unwrap();
        assert!(!client.is_available());
        let other = EndpointSpec::new("/add", "Subtract", Qos::default());
        let _other = here.create_server(other).unwrap();
        let server = serve(here);
        assert!(client.wait_available(PATIENCE));
        assert_eq!(client.servers(), [server.gid()]);
        until("the server counts it", || server.clients() == [client.gid()]);
        drop(server);
        while client.is_available() {
            assert_eq!(there.wait_for(&changed, Some(PATIENCE)).unwrap(), [0]);
        }
        let server = serve(here);
        assert!(client.wait_available(PATIENCE));
        call_in_thread(&client, &server, b"abc");
        drop(client);
        until("the server counts it no more", || server.clients().is_empty());
    });
}

#[test]
fn a_request_reaches_every_server_and_a_response_only_its_client() {
    let host = host();
    let _daemon = host.daemon();
    let sessions = [true, false, false].map(|shm| session(&host, "any", shm));
    // Two of each kind in every process, so that some calls stay in the process and others pass the daemon once or
    // twice.
    let twice = || sessions.iter().chain(&sessions);
    let servers: Vec<Server> = twice().map(serve).collect();
    let clients: Vec<Client> =
        twice().map(|session| session.create_client(service()).unwrap()).collect();
    for client in &clients {
        until("it counts all", || client.servers().len() == servers.len());
    }
    let rounds = 20;
    for round in 1..=rounds {
        for client in &clients {
            assert_eq!(client.send_request(&client.gid().0).unwrap(), round);
        }
    }
    let mut bytes = Vec::new();
    for server in &servers {
        let mut asked = Vec::new();
        for _ in 0..rounds * clients.len() as u64 {
            let request = server.recv_request(&mut bytes, Some(PATIENCE)).expect("a request");
            assert_eq!(bytes, request.publisher.0, "of somebody else");
            asked.push((request.publisher, request.sequence));
        }
        assert!(!server.has_request(), "one came twice");
        assert_eq!(asked.iter().collect::<HashSet<_>>().len(), asked.len());
        for (client, sequence) in asked.into_iter().rev() {
            respond(server, client, sequence, &client.0);
        }
    }
    for client in &clients {
        let mut came: HashMap<Gid, Vec<u64>> = HashMap::new();
        for _ in 0..rounds * servers.len() as u64 {
            let info = client.recv_response(&mut bytes, Some(PATIENCE)).expect("a response");
            assert_eq!(bytes, client.gid().0, "the response to another client");
            came.entry(info.publisher).or_default().push(info.sequence);
        }
        assert!(!client.has_response(), "one came twice");
        assert_eq!(came.len(), servers.len());
        assert!(came.values().all(|numbers| numbers.iter().copied().eq((1..=rounds).rev())));
    }
}

#[test]
fn twenty_clients_in_twenty_relayed_processes_get_each_their_own() {
    beside_relayed("server", |session, relaying| {
        let server = serve(session);
        let mut players: Vec<_> = (0..CLIENTS).map(|_| relaying.play("caller")).collect();
        for _ in 0..CLIENTS as u64 * CALLS {
            answer(&server);
        }
        players.iter_mut().for_each(|player| assert_eq!(player.hear(), "complete"));
        assert_eq!(server.clients().len(), CLIENTS);
        players.into_iter().for_each(support::Player::finish);
        until("all of them are gone", || server.clients().is_empty());
    });
}

#[test]
fn a_relayed_client_killed_with_pending_responses_leaves_the_server_working() {
    beside_relayed("server", |session, relaying| {
        let server = serve(session);
        let mut asker = relaying.play("asker");
        assert_eq!(asker.hear(), "asked");
        let mut bytes = Vec::new();
        // Its requests may still be in flight, and would be lost with it.
        let requests: Vec<_> = (0..CALLS)
            .map(|_| server.recv_request(&mut bytes, Some(PATIENCE)).expect("a request"))
            .collect();
        for (number, request) in (0..).zip(&requests) {
            if number == CALLS / 2 {
                signal(asker.pid(), Signal::KILL);
            }
            respond(&server, request.publisher, request.sequence, &[0; 60_000]);
        }
        until("the server heard of it", || server.clients().is_empty());
        for request in &requests {
            server.send_response(request.publisher, request.sequence, b"late").unwrap();
        }
        let mut caller = relaying.play("caller");
        for _ in 0..CALLS {
            answer(&server);
        }
        assert_eq!(caller.hear(), "complete");
        caller.finish();
    });
}

#[test]
fn a_relayed_server_that_dies_in_a_call_is_not_available_and_another_one_is() {
    beside_relayed("client", |session, relaying| {
        let node = session.create_node("n", "/", "/").unwrap();
        let changed = [Waitable::GuardCondition(node.graph_changed())];
        let client = session.create_client(service()).unwrap();
        let mut server = relaying.play("server");
        assert_eq!(server.hear(), "serves");
        assert!(client.wait_available(PATIENCE));
        call(&client, b"abc");
        client.send_request(b"never answered").unwrap();
        assert_eq!(server.hear(), "took");
        signal(server.pid(), Signal::KILL);
        while client.is_available() {
            assert_eq!(session.wait_for(&changed, Some(PATIENCE)).unwrap(), [0]);
        }
        nothing_more(&client);
        let mut next = relaying.play("server");
        assert_eq!(next.hear(), "serves");
        assert!(client.wait_available(PATIENCE));
        call(&client, b"xyz");
    });
}

#[test]
fn clients_beyond_the_pair_limit_do_not_match_a_relayed_server() {
    let host = host();
    let _daemon = host.daemon();
    let (here, there) = (session(&host, "servers", false), session(&host, "clients", true));
    let servers: Vec<Server> = (0..33).map(|_| serve(&here)).collect();
    let clients: Vec<Client> = (0..32).map(|_| there.create_client(service()).unwrap()).collect();
    // The limit applies to the pairs of servers and clients.
    until("as many as may", || clients.iter().map(|c| c.servers().len()).sum::<usize>() == 1024);
    clients.iter().for_each(|client| assert_eq!(client.send_request(b"x").unwrap(), 1));
    let mut missing: usize = 1024;
    let mut bytes = Vec::new();
    until("all are answered", || {
        for server in &servers {
            while let Some(request) = server.take_request(&mut bytes) {
                respond(server, request.publisher, request.sequence, b"y");
            }
        }
        for client in &clients {
            missing -= std::iter::from_fn(|| client.take_response(&mut bytes)).count();
        }
        missing == 0
    });
    // Others have left, so there is room for the remaining ones.
    drop(clients);
    let client = ask(&there, &servers[0]);
    until("it counts all", || client.servers().len() == servers.len());
}

#[test]
fn calls_go_on_with_the_next_daemon() {
    let host = host();
    let mut daemon = host.daemon();
    let (a, b, c) =
        (session(&host, "a", false), session(&host, "b", false), session(&host, "c", true));
    let servers = [serve(&a), serve(&c)];
    let client = b.create_client(service()).unwrap();
    for round in 0..3 {
        until("it counts both", || client.servers().len() == 2);
        let number = client.send_request(b"to both").unwrap();
        let from: HashSet<Gid> = servers.iter().map(answer).collect();
        assert_eq!(from, HashSet::from([client.gid()]), "round {round}");
        for _ in &servers {
            let info = client.recv_response(&mut Vec::new(), Some(PATIENCE)).unwrap();
            assert_eq!(info.sequence, number);
        }
        client.send_request(b"never answered").unwrap();
        for server in &servers {
            server.recv_request(&mut Vec::new(), Some(PATIENCE)).expect("a request");
        }
        daemon.0.kill().unwrap();
        daemon.0.wait().unwrap();
        until("nobody is there", || !client.is_available());
        daemon = host.daemon();
    }
    until("it counts both", || client.servers().len() == 2);
    nothing_more(&client);
    drop(daemon);
}

#[test]
fn calls_cross_to_another_host_and_from_there() {
    let hosts = two_hosts();
    let _daemons = [hosts[0].daemon(), hosts[1].daemon()];
    between([&hosts[0], &hosts[1]], |here, there| {
        let server = serve(here);
        let clients = [ask(there, &server), ask(there, &server)];
        for (number, len) in (0..).zip([0, 4097, 300_000]) {
            clients.iter().for_each(|one| call_in_thread(one, &server, &pattern(number, len)));
        }
        let [left, gone] = clients;
        drop(gone);
        until("the server counts one", || server.clients() == [left.gid()]);
        left.send_request(b"never answered").unwrap();
        drop(server);
        until("it is not available", || !left.is_available());
        nothing_more(&left);
    });
}
