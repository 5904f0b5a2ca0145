//! Messages that nobody has taken yet: the writers that they hold back, and the endpoints that they
//! outlive.

use axon_transport::Waitable;

use super::{services::*, *};

#[test]
fn a_client_that_takes_no_responses_blocks_only_its_own_responses() {
    with_both_ends(|here, there| {
        let server = serve(here);
        let (stuck, other) = (ask(there, &server), ask(there, &server));
        until("both ends know it", || server.clients().len() == 2);
        let sent =
            fill(|number| server.send_response(stuck.gid(), number, &pattern(number, 50_000)));
        (0..20).for_each(|number| call_in_thread(&other, &server, &pattern(number, 5_000)));
        let mut bytes = Vec::new();
        for number in 1..=sent {
            let info = stuck.recv_response(&mut bytes, Some(PATIENCE)).expect("none is lost");
            assert_eq!((info.sequence, &bytes), (number, &pattern(number, 50_000)));
        }
    });
}

#[test]
fn keep_last_services_get_the_newest_messages_and_block_no_peer() {
    const MANY: u64 = 500;
    let newest = Qos::default().with_depth(3);
    with_both_ends(|here, there| {
        let server = here.create_server(service().qos(newest)).unwrap();
        let client = there.create_client(service().qos(newest)).unwrap();
        assert!(client.wait_available(PATIENCE));
        until("the server counts it", || server.clients() == [client.gid()]);
        // The ring of one hop would be full if not all arriving messages were taken or skipped.
        for number in 1..=MANY {
            patiently(|| client.send_request(&pattern(number, 50_000)));
        }
        let mut bytes = Vec::new();
        let (mut last, mut taken) = (0, 0);
        while last < MANY {
            let info = server.recv_request(&mut bytes, Some(PATIENCE)).expect("the newest");
            assert!(info.sequence > last && bytes == pattern(info.sequence, 50_000));
            (last, taken) = (info.sequence, taken + 1);
        }
        assert!(taken < MANY, "nothing was passed over");
        for number in 1..=MANY {
            respond(&server, client.gid(), number, &pattern(number, 50_000));
        }
        let mut last = 0;
        while last < MANY {
            let info = client.recv_response(&mut bytes, Some(PATIENCE)).expect("the newest");
            assert!(info.sequence > last && bytes == pattern(info.sequence, 50_000));
            last = info.sequence;
        }
    });
}

#[test]
fn a_server_that_takes_no_requests_holds_its_clients_back_and_loses_nothing() {
    with_both_ends(|here, there| {
        let server = serve(here);
        let client = ask(there, &server);
        let sent = fill(|number| client.send_request(&pattern(number, 50_000)));
        let mut bytes = Vec::new();
        for number in 1..=sent {
            let info = server.recv_request(&mut bytes, Some(PATIENCE)).expect("none is lost");
            assert_eq!((info.sequence, &bytes), (number, &pattern(number, 50_000)));
        }
        until("the server counts it", || server.clients() == [client.gid()]);
        respond(&server, client.gid(), sent, b"at last");
        assert_eq!(client.recv_response(&mut bytes, Some(PATIENCE)).unwrap().sequence, sent);
    });
}

#[test]
fn a_server_that_has_ended_is_not_counted_though_responses_are_still_to_come() {
    with_both_ends(|here, there| {
        let node = there.create_node("n", "/", "/").unwrap();
        let changed = [Waitable::GuardCondition(node.graph_changed())];
        let server = serve(here);
        let client = ask(there, &server);
        until("the server counts it", || server.clients() == [client.gid()]);
        let len = 50_000;
        let answered =
            fill(|number| server.send_response(client.gid(), number, &pattern(number, len)));
        let gone = server.gid();
        drop(server);
        while client.is_available() || there.graph().endpoints.contains_key(&gone) {
            assert_eq!(there.wait_for(&changed, Some(PATIENCE)).unwrap(), [0]);
        }
        let mut bytes = Vec::new();
        for number in 1..=answered {
            let info = client.recv_response(&mut bytes, Some(PATIENCE)).expect("none is lost");
            assert_eq!((info.publisher, info.sequence), (gone, number));
            assert_eq!(bytes, pattern(number, len));
        }
        nothing_more(&client);

        let server = serve(here);
        assert!(client.wait_available(PATIENCE));
        until("the server counts it", || server.clients() == [client.gid()]);
        let asked = fill(|number| client.send_request(&pattern(number, len)));
        let gone = client.gid();
        drop(client);
        until("the server counts it no more", || {
            server.clients().is_empty() && !here.graph().endpoints.contains_key(&gone)
        });
        for number in 1..=asked {
            let info = server.recv_request(&mut bytes, Some(PATIENCE)).expect("none is lost");
            assert_eq!((info.publisher, &bytes), (gone, &pattern(number, len)));
        }
    });
}

#[test]
fn ended_publisher_with_backlog_is_not_counted() {
    with_both_ends(|here, there| {
        let (publisher, subscription) = connect(here, there, "/t", Qos::keep_all());
        let last = fill(|number| publisher.publish(&pattern(number, 50_000)));
        let gone = publisher.gid();
        drop(publisher);
        until("it is counted no more", || {
            subscription.matched().is_empty() && !there.graph().endpoints.contains_key(&gone)
        });
        assert_eq!(take_until(&subscription, last), (1..=last).collect::<Vec<_>>());
        assert_eq!(subscription.lost(), 0);
    });
}

#[test]
fn the_last_requests_and_responses_arrive_after_their_sender_has_gone() {
    with_both_ends(|here, there| {
        let (server, witness) = (serve(here), serve(here));
        let client = ask(there, &server);
        until("it counts both", || client.servers().len() == 2);
        until("they count it", || server.clients().len() == 1 && witness.clients().len() == 1);
        let (many, len) = (30, 100_000);
        let mut bytes = Vec::new();
        thread::scope(|scope| {
            scope.spawn(|| {
                for number in 1..=many {
                    patiently(|| client.send_request(&pattern(number, len)));
                }
            });
            for number in 1..=many {
                let info = server.recv_request(&mut bytes, Some(PATIENCE)).expect("a request");
                assert_eq!(info.sequence, number);
                respond(&server, info.publisher, number, &bytes);
                if number < many {
                    continue;
                }
                // The other one has taken nothing yet.
                for number in 1..=many {
                    let info = witness.recv_request(&mut bytes, Some(PATIENCE));
                    assert_eq!(info.expect("a request").sequence, number);
                }
            }
        });
        drop(server);
        for number in 1..=many {
            let info = client.recv_response(&mut bytes, Some(PATIENCE)).expect("a response");
            assert_eq!((info.sequence, &bytes), (number, &pattern(number, len)));
        }
        until("only one is left", || client.servers() == [witness.gid()]);
        client.send_request(b"the last word").unwrap();
        drop(client);
        assert!(witness.recv_request(&mut bytes, Some(PATIENCE)).is_ok());
        assert_eq!(bytes, b"the last word");
        until("it is forgotten", || witness.clients().is_empty());
    });
}
