//! Tasks that wait for messages of other processes.

#[allow(dead_code, reason = "not every test needs all of it")]
mod support;

use std::{
    pin::pin,
    task::{Context, Poll, Waker},
    thread,
};

use axon_transport::{CallError, EndpointSpec, qos::Qos};
use support::{Host, PATIENCE, of_child, say, until, wait_for_the_end};

const ROUNDS: u32 = 300;

fn spec(name: &str) -> EndpointSpec {
    EndpointSpec::new(name, "test/Bytes", Qos::keep_all())
}

fn runtime() -> tokio::runtime::Runtime {
    tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap()
}

/// Plays a part in a child process.
#[test]
fn child() {
    let Ok(part) = std::env::var("PLAY") else { return };
    let session = of_child(&part);
    match part.as_str() {
        // Answers each request with its own content, and republishes each sample.
        "echo" => {
            let server = session.create_server(spec("/s")).unwrap();
            let subscription = session.create_subscription(spec("/there")).unwrap();
            let publisher = session.create_publisher(spec("/back")).unwrap();
            say("ready");
            runtime().block_on(async {
                let serve = async {
                    loop {
                        let (info, bytes) = server.recv_request_async().await.unwrap();
                        server.send_response(info.publisher, info.sequence, &bytes).unwrap();
                    }
                };
                let repeat = async {
                    let mut samples = subscription.stream();
                    while let Some(sample) = samples.next().await {
                        publisher.publish(&sample.unwrap().1).unwrap();
                    }
                };
                tokio::select! {
                    () = serve => {}
                    () = repeat => {}
                }
            });
        }
        // Takes requests and answers none.
        "mute" => {
            let server = session.create_server(spec("/s")).unwrap();
            say("ready");
            server.recv_request(&mut Vec::new(), Some(PATIENCE)).unwrap();
            say("asked");
            wait_for_the_end();
        }
        _ => unreachable!("no such part: {part}"),
    }
}

/// Runs in lockstep with a process whose tasks sleep, so that each sample has to wake one on either side.
fn go_to_and_fro(here: &Host, there: &Host) {
    let _daemon = here.daemon();
    let mut other = there.play("echo");
    assert_eq!(other.hear(), "ready");
    let session = here.session("test").unwrap();
    let client = session.create_client(spec("/s")).unwrap();
    let publisher = session.create_publisher(spec("/there")).unwrap();
    let subscription = session.create_subscription(spec("/back")).unwrap();
    assert!(client.wait_available(PATIENCE));
    assert!(publisher.wait_matched(1, PATIENCE) && subscription.wait_matched(1, PATIENCE));
    thread::scope(|scope| {
        scope.spawn(|| {
            runtime().block_on(async {
                for round in 0..ROUNDS {
                    // Some of them are taken in place.
                    let bytes = round.to_le_bytes().repeat(if round % 8 == 0 { 5000 } else { 1 });
                    publisher.publish(&bytes).unwrap();
                    let back = tokio::time::timeout(PATIENCE, subscription.recv_async()).await;
                    assert_eq!(back.expect("a wake-up was lost").unwrap().1, bytes);
                }
            });
        });
        for caller in 0..2 {
            let client = &client;
            scope.spawn(move || {
                for round in 0..ROUNDS {
                    let bytes = (caller << 16 | round).to_le_bytes();
                    assert_eq!(client.call_blocking(&bytes, Some(PATIENCE)).unwrap(), bytes);
                }
            });
        }
    });
}

#[test]
fn tasks_of_two_processes_wake_each_other() {
    let host = Host::new();
    go_to_and_fro(&host, &host);
}

#[test]
fn tasks_of_a_relayed_process_are_woken_too() {
    let host = Host::new();
    let mut relayed = host.env.clone();
    relayed.push(("AXON_SHM".to_owned(), "off".to_owned()));
    let there = Host { env: relayed, dir: tempfile::tempdir().unwrap() };
    go_to_and_fro(&host, &there);
}

#[test]
fn a_call_to_a_process_that_is_killed_fails() {
    let host = Host::new();
    let _daemon = host.daemon();
    let mut server = host.play("mute");
    assert_eq!(server.hear(), "ready");
    let session = host.session("test").unwrap();
    let client = session.create_client(spec("/s")).unwrap();
    assert!(client.wait_available(PATIENCE));
    let mut call = pin!(client.call(b"x"));
    assert!(call.as_mut().poll(&mut Context::from_waker(Waker::noop())).is_pending());
    assert_eq!(server.hear(), "asked");
    drop(server);
    let runtime = runtime();
    let ended = runtime.block_on(async { tokio::time::timeout(PATIENCE, call).await });
    assert!(matches!(ended, Ok(Err(CallError::ServerGone))), "{ended:?}");
    until("nobody is there", || !client.is_available());
    let refused = pin!(client.call(b"x")).poll(&mut Context::from_waker(Waker::noop()));
    assert!(matches!(refused, Poll::Ready(Err(CallError::Unavailable))));
}
