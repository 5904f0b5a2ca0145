//! The code of the children of the tests.

use std::{fs, os::unix::process::CommandExt as _, path::Path, process::Command, time::Duration};

use axon_shm::{Context, PublishError, Publisher, PublisherOptions, Subscriber, SubscriberOptions};
use axon_transport::{
    Session, SessionError, SessionEvent, SessionOptions,
    config::Config,
    internal::{
        session::daemon::socket,
        wire::session::{PROTOCOL, SessionHello, SessionMessage, SessionRole},
    },
    qos::{Durability, Qos},
};
use rustix::process::{Resource, Rlimit, setrlimit};

use crate::{
    blocks, descriptors, group, image, latched, meet, spec,
    support::{PATIENCE, of_child, say, until, wait_for_the_end},
};

/// Opens a session, or returns the error.
fn try_session() -> Result<Session, SessionError> {
    let config = Config::from_env().unwrap();
    Session::open(&config, SessionOptions::new("player"))
}

pub(crate) fn play(part: &str) {
    let place = || std::env::var("PLACE").unwrap();
    match part {
        "elevated" => crate::elevated::play(),
        "locked" => {
            // SAFETY: the call takes only flags.
            if unsafe { libc::mlockall(libc::MCL_CURRENT | libc::MCL_FUTURE) } != 0 {
                return say(format!("cannot lock: {}", std::io::Error::last_os_error()));
            }
            say("locked");
            let context = Context::new().unwrap();
            let socket = meet(&place(), false);
            let options = SubscriberOptions::new(Qos::keep_all());
            let mut subscriber =
                Subscriber::connect(&context, &socket, options, Some(PATIENCE)).unwrap();
            say("attached");
            let sample = subscriber.recv(Some(PATIENCE)).unwrap().expect("a sample");
            assert_eq!(sample.len(), 100_000);
            say("taken");
            wait_for_the_end();
        }
        // Runs alone in its process, so that all shared memory there is its own.
        "owner" => {
            let context = Context::new().unwrap();
            let options = PublisherOptions::new(Qos::keep_all()).budget(512 << 20);
            let publisher = Publisher::new(&context, options).unwrap();
            publisher.publish(&[1; 100]).unwrap();
            let mut before = blocks();
            publisher.serve(meet(&place(), true), Some(PATIENCE)).unwrap();
            for step in ["attached", "taken"] {
                let mut line = String::new();
                std::io::stdin().read_line(&mut line).unwrap();
                assert_eq!((line.trim(), blocks()), (step, before));
                publisher.publish(&[2; 100_000]).unwrap();
                before = blocks();
                say("nothing was taken");
            }
            wait_for_the_end();
        }
        "few descriptors" => {
            let few = Rlimit { current: Some(256), maximum: Some(256) };
            setrlimit(Resource::Nofile, few).unwrap();
            let context = Context::new().unwrap();
            let mut subscribers = Vec::new();
            // The last socket stays open: the other process may still be connecting, and would wait
            // in vain.
            let (_socket, error) = loop {
                let socket = meet(&format!("{}-{}", place(), subscribers.len()), false);
                let options = SubscriberOptions::new(Qos::keep_all());
                match Subscriber::connect(&context, &socket, options, Some(PATIENCE)) {
                    Ok(subscriber) => subscribers.push(subscriber),
                    Err(error) => break (socket, error),
                }
                say("attached");
            };
            say(error);
            // The attached subscribers go on.
            for mut subscriber in subscribers {
                assert!(subscriber.recv(Some(PATIENCE)).unwrap().is_some());
            }
            say("whole");
        }
        "starved" => {
            let few = Rlimit { current: Some(256), maximum: Some(256) };
            setrlimit(Resource::Nofile, few).unwrap();
            let context = Context::new().unwrap();
            let socket = meet(&place(), false);
            let options = SubscriberOptions::new(Qos::keep_all());
            let mut subscriber =
                Subscriber::connect(&context, &socket, options, Some(PATIENCE)).unwrap();
            let open = || fs::File::open("/dev/null").ok();
            let all: Vec<_> = std::iter::from_fn(open).collect();
            say("starved");
            let mut line = String::new();
            std::io::stdin().read_line(&mut line).unwrap();
            for _ in 0..3 {
                assert!(subscriber.recv(Some(Duration::from_millis(20))).unwrap().is_none());
                subscriber.reclaim_idle();
            }
            drop(all);
            say(subscriber.recv(Some(PATIENCE)).unwrap().map_or(0, |sample| sample.len()));
            wait_for_the_end();
        }
        "many publishers" => {
            let few = Rlimit { current: Some(256), maximum: Some(256) };
            setrlimit(Resource::Nofile, few).unwrap();
            let session = of_child("many");
            // A publisher opens a descriptor with its first large sample.
            let mut publishers = Vec::new();
            let error = loop {
                let topic = format!("/t{}", publishers.len());
                let publisher = session.create_publisher(latched(&topic)).unwrap();
                match publisher.publish(&[1; 5000]) {
                    Ok(_) => publishers.push(publisher),
                    Err(error) => break error,
                }
            };
            say(error);
            // A publisher of small samples opens no descriptor.
            let small = session.create_publisher(latched("/small")).unwrap();
            small.publish(b"small").unwrap();
            publishers.truncate(50);
            assert!(publishers[0].wait_matched(1, PATIENCE));
            until("there are descriptors again", || publishers[0].publish(b"still").is_ok());
            say("published");
            wait_for_the_end();
        }
        "much memory" => {
            let session = of_child("much");
            session.set_listener(|event| {
                if *event == SessionEvent::DaemonLost {
                    say("disconnected");
                }
            });
            let all: Vec<_> = (0..150)
                .map(|number| {
                    let publisher = session.create_publisher(latched(&format!("/t{number}")));
                    let publisher = publisher.unwrap();
                    publisher.publish(&[1; 5000]).unwrap();
                    publisher
                })
                .collect();
            say("published");
            let mut line = String::new();
            std::io::stdin().read_line(&mut line).unwrap();
            // Small samples need no separate memory.
            all[0].publish(b"small").unwrap();
            wait_for_the_end();
        }
        "confined" => {
            let group = std::env::var("GROUP").unwrap();
            group::join(Path::new(&group)).unwrap();
            let context = Context::new().unwrap();
            let options = PublisherOptions::new(
                Qos::default().with_durability(Durability::TransientLocal).with_depth(1000),
            );
            let options = options.budget(1 << 30).max_len(128 << 20);
            let publisher = Publisher::new(&context, options).unwrap();
            // The memory holds fewer samples of this size than the depth.
            let sample = vec![1; 4 << 20];
            for _ in 0..100 {
                publisher.publish(&sample).unwrap();
            }
            assert!(blocks() * 512 < 64 << 20, "{} blocks", blocks());
            let error = publisher.loan(80 << 20).map(drop).unwrap_err();
            assert!(matches!(error, PublishError::NoMemory { .. }), "{error:?}");
            say(error);
            for _ in 0..100 {
                publisher.publish(b"small").unwrap();
            }
            publisher.publish(&sample).unwrap();
            say("alive");
        }
        "stranger" => {
            let name = rustix::net::SocketAddrUnix::new_abstract_name(place().as_bytes()).unwrap();
            let socket = rustix::net::socket_with(
                rustix::net::AddressFamily::UNIX,
                rustix::net::SocketType::SEQPACKET,
                rustix::net::SocketFlags::CLOEXEC,
                None,
            )
            .unwrap();
            rustix::net::connect(&socket, &name).unwrap();
            let hello = SessionMessage::Hello(SessionHello {
                protocol: PROTOCOL,
                session: axon_transport::ids::SessionId::random(),
                role: SessionRole::Tool,
                name: "stranger".into(),
                domain: 171,
                settings: Vec::new(),
                relay: None,
                range: Some(0),
                static_peers: None,
            });
            let _ = socket::send(&socket, &hello.encode().unwrap(), &[]);
            let mut buffer = Vec::new();
            until("an answer", || {
                !matches!(socket::receive(&socket, &mut buffer), Err(socket::SocketError::NotReady))
            });
            let end = socket::receive(&socket, &mut buffer);
            say(if matches!(end, Err(socket::SocketError::Closed)) { "put out" } else { "heard" });
        }
        "successor" => {
            say(descriptors("self"));
            let session = of_child("former");
            let _publisher = session.create_publisher(spec("/t")).unwrap();
            let subscription = session.create_subscription(image()).unwrap();
            assert!(session.wait(|| subscription.has_data(), Some(PATIENCE)));
            let (_, held) = subscription.take_sample().unwrap();
            assert!(held.is_borrowed());
            say("holds");
            std::io::stdin().read_line(&mut String::new()).unwrap();
            let error = Command::new("sleep").arg("1000").exec();
            panic!("sleep: {error}");
        }
        "listener" => {
            let session = of_child("listener");
            let subscription = session.create_subscription(spec("/t")).unwrap();
            let got = subscription.recv(&mut Vec::new(), Some(PATIENCE));
            say(if got.is_ok() { "heard" } else { "nothing" });
            wait_for_the_end();
        }
        "one session" => {
            let session = match try_session() {
                Ok(session) => session,
                Err(error) => return say(error),
            };
            say("served");
            let publisher = session.create_publisher(spec("/crowd")).unwrap();
            let mut line = String::new();
            std::io::stdin().read_line(&mut line).unwrap();
            if line == "go\n" {
                assert!(session.wait_graph(PATIENCE, |graph| graph.endpoints.len() >= 3));
                say("everybody is there");
                std::io::stdin().read_line(&mut line).unwrap();
                if line == "go\ngo\n" {
                    assert!(publisher.wait_matched(1, PATIENCE));
                    publisher.publish(b"hello").unwrap();
                    wait_for_the_end();
                }
            }
        }
        "many sessions" => {
            let mut sessions = Vec::new();
            let error = loop {
                match try_session() {
                    Ok(session) => sessions.push(session),
                    Err(error) => break error,
                }
            };
            say(error);
            wait_for_the_end();
        }
        "no descriptors" => {
            let few = Rlimit { current: Some(64), maximum: Some(64) };
            setrlimit(Resource::Nofile, few).unwrap();
            let open = || fs::File::open("/dev/null").ok();
            let mut all: Vec<_> = std::iter::from_fn(open).collect();
            // Each descriptor that a session opens is in turn the one that fails.
            loop {
                match try_session() {
                    Ok(session) => {
                        say("served");
                        wait_for_the_end();
                        break drop(session);
                    }
                    Err(error) => {
                        all.pop();
                        say(error);
                    }
                }
            }
        }
        _ => unreachable!("no such part: {part}"),
    }
}
