//! Requests whose responses tasks wait for.

use std::{pin::pin, sync::Arc, task::Context, thread, time::Duration};

use axon_transport::{CallError, Client, EndpointSpec, RecvError, Server, Session, qos::Qos};

use crate::support::{Count, PATIENCE, alone, block_on, until};

fn service(session: &Session) -> (Server, Client) {
    let spec = || EndpointSpec::new("/s", "test/Service", Qos::keep_all());
    let server = session.create_server(spec()).unwrap();
    let client = session.create_client(spec()).unwrap();
    assert!(client.wait_available(PATIENCE));
    (server, client)
}

/// Answers each request with itself, until one is `stop`.
async fn echo(server: &Server) {
    let mut requests = server.stream();
    loop {
        let (info, bytes) = requests.next().await.unwrap().unwrap();
        server.send_response(info.publisher, info.sequence, &bytes).unwrap();
        if bytes == b"stop" {
            return;
        }
    }
}

#[test]
fn each_of_many_calls_gets_its_own_response() {
    let session = alone();
    let (server, client) = service(&session);
    let client = Arc::new(client);
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).build().unwrap();
    thread::scope(|scope| {
        scope.spawn(|| block_on(echo(&server)));
        let calls = |of: u64| {
            let client = &client;
            move || {
                for number in 0..300 {
                    let payload = (of << 32 | number).to_le_bytes();
                    assert_eq!(block_on(client.call(&payload)).unwrap(), payload);
                }
            }
        };
        let threads: Vec<_> = (1..=3).map(|of| scope.spawn(calls(of))).collect();
        runtime.block_on(async {
            let tasks: Vec<_> = (0..100u64)
                .map(|number| {
                    let client = client.clone();
                    tokio::spawn(async move {
                        // The payload is longer than 4 KiB, so it is taken in place.
                        let payload = number.to_le_bytes().repeat(1000);
                        assert_eq!(client.call(&payload).await.unwrap(), payload);
                    })
                })
                .collect();
            for task in tasks {
                task.await.unwrap();
            }
        });
        threads.into_iter().for_each(|thread| thread.join().unwrap());
        assert_eq!(client.call_blocking(b"stop", Some(PATIENCE)).unwrap(), b"stop");
    });
    assert!(!client.has_response());
}

#[test]
fn responses_in_any_order_go_where_they_belong() {
    let session = alone();
    let (server, client) = service(&session);
    let ((one, first), (two, second)) = (Count::new(), Count::new());
    let (mut a, mut b) = (pin!(client.call(b"a")), pin!(client.call(b"b")));
    assert!(a.as_mut().poll(&mut Context::from_waker(&first)).is_pending());
    assert!(b.as_mut().poll(&mut Context::from_waker(&second)).is_pending());
    let requests = [(); 2].map(|()| block_on(server.recv_request_async()).unwrap());
    let answer = |(info, bytes): &(axon_transport::MessageInfo, Vec<u8>)| {
        server.send_response(info.publisher, info.sequence, bytes).unwrap();
    };
    answer(&requests[1]);
    until("the second is woken", || two.get() == 1);
    assert_eq!(one.get(), 0, "the other is not");
    assert_eq!(block_on(b).unwrap(), b"b");
    answer(&requests[0]);
    until("the first is woken", || one.get() == 1);
    assert_eq!(block_on(a).unwrap(), b"a");
}

#[test]
fn the_response_to_a_call_that_was_dropped_is_nobodys() {
    let session = alone();
    let (server, client) = service(&session);
    let (count, waker) = Count::new();
    {
        let mut dropped = pin!(client.call(b"dropped"));
        assert!(dropped.as_mut().poll(&mut Context::from_waker(&waker)).is_pending());
    }
    drop(waker);
    assert_eq!(Arc::strong_count(&count), 1, "its waker is let go");
    let late = client.call_blocking(b"late", Some(Duration::from_millis(1)));
    assert!(matches!(late, Err(CallError::Recv(RecvError::TimedOut))), "{late:?}");
    thread::scope(|scope| {
        scope.spawn(|| block_on(echo(&server)));
        assert_eq!(client.call_blocking(b"stop", Some(PATIENCE)).unwrap(), b"stop");
    });
    assert!(!client.has_response());
    until("nobody listens", || session.segment().external_leader().is_ok());
}

#[test]
fn a_call_ends_with_the_last_of_its_servers() {
    let session = alone();
    let (server, client) = service(&session);
    let spec = || EndpointSpec::new("/s", "test/Service", Qos::keep_all());
    let other = session.create_server(spec()).unwrap();
    until("both servers are there", || client.servers().len() == 2);
    let (count, waker) = Count::new();
    let mut call = pin!(client.call(b"x"));
    assert!(call.as_mut().poll(&mut Context::from_waker(&waker)).is_pending());
    drop(other);
    until("one is left", || client.servers().len() == 1);
    assert!(call.as_mut().poll(&mut Context::from_waker(&waker)).is_pending());
    drop(server);
    until("it is woken", || count.get() > 0);
    assert!(matches!(block_on(call), Err(CallError::ServerGone)));
    assert!(matches!(block_on(client.call(b"x")), Err(CallError::Unavailable)));
}

#[test]
fn a_response_of_an_ended_server_completes_the_call() {
    let session = alone();
    let (server, client) = service(&session);
    let mut call = pin!(client.call(b"x"));
    let (_, waker) = Count::new();
    assert!(call.as_mut().poll(&mut Context::from_waker(&waker)).is_pending());
    let (info, bytes) = block_on(server.recv_request_async()).unwrap();
    server.send_response(info.publisher, info.sequence, &bytes).unwrap();
    drop(server);
    assert_eq!(block_on(call).unwrap(), b"x");
}

#[test]
fn a_call_that_does_not_fit_says_so() {
    let session = alone();
    let (_server, client) = service(&session);
    let payload = vec![0; 257 << 20];
    assert!(matches!(block_on(client.call(&payload)), Err(CallError::Send(_))));
}
