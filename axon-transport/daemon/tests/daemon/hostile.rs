//! Peers that send what no session sends, or pass descriptors that must not be read.

use std::sync::atomic::{AtomicBool, Ordering};

use super::*;
use crate::reluctant::{hiding, send_away};

/// The first message of a tool.
fn tool_hello() -> SessionMessage {
    SessionMessage::Hello(SessionHello {
        protocol: PROTOCOL,
        session: SessionId::random(),
        role: SessionRole::Tool,
        name: "tool".into(),
        domain: 0,
        settings: Vec::new(),
        relay: None,
        range: Some(0),
        static_peers: None,
    })
}

#[test]
fn garbage_on_the_control_socket_does_not_disturb_sessions() {
    let host = Host::new();
    let _daemon = host.daemon();
    let session = host.session("witness").unwrap();
    let publisher = session.create_publisher(spec("/t")).unwrap();
    let address = Address::of(&host.config());
    let hello = |name: &str, settings| {
        SessionMessage::Hello(SessionHello {
            protocol: PROTOCOL,
            session: SessionId::random(),
            role: SessionRole::Application,
            name: name.into(),
            domain: 0,
            settings,
            relay: None,
            range: Some(0),
            static_peers: None,
        })
        .encode()
        .unwrap()
    };
    let packets: Vec<Vec<u8>> = vec![
        vec![1],
        vec![0xff; 32 * 1024],
        vec![0xff; 40 * 1024],
        SessionMessage::Resync.encode().unwrap(),
        hello("without settings", vec![]),
        hello(&"n".repeat(20_000), vec![]),
        vec![],
    ];
    for packet in &packets {
        let stranger = address.connect().unwrap();
        let _ = socket::send(&stranger, packet, &[]);
        until("the stranger is put out", || {
            !matches!(
                socket::receive(&stranger, &mut Vec::new()),
                Ok(_) | Err(socket::SocketError::NotReady)
            )
        });
    }
    // Many connections that send nothing.
    let crowd: Vec<OwnedFd> = (0..300).filter_map(|_| address.connect().ok()).collect();
    drop(crowd);
    // A tool that sends a message it may not send.
    let tool = address.connect().unwrap();
    socket::send(&tool, &tool_hello().encode().unwrap(), &[]).unwrap();
    socket::send(&tool, &SessionMessage::Resync.encode().unwrap(), &[]).unwrap();
    until("the tool is put out", || {
        matches!(socket::receive(&tool, &mut Vec::new()), Err(socket::SocketError::Closed))
    });
    // The daemon still serves sessions.
    let subscription = host.session("b").unwrap().create_subscription(spec("/t")).unwrap();
    assert!(subscription.wait_matched(1, PATIENCE) && publisher.wait_matched(1, PATIENCE));
    publish(&publisher, 1);
    assert_eq!(receive(&subscription), 1);
}

/// The daemon's status shows counters that it reads from the memory that sessions pass to it.
#[test]
fn the_daemon_is_handed_nothing_that_a_read_could_wait_for() {
    let host = Host::new();
    let _daemon = host.daemon();
    let settings = security_settings(&host.config()).unwrap();
    let flags = MemfdFlags::CLOEXEC | MemfdFlags::ALLOW_SEALING;
    let memory = memfd_create("test", flags).unwrap();
    let (pipe, _held) = rustix::pipe::pipe().unwrap();
    for (name, descriptor) in [("memory", &memory), ("pipe", &pipe)] {
        let segment = SessionSegment::create(SessionId::random()).unwrap();
        let session = segment.id();
        let hello = SessionMessage::Hello(SessionHello {
            protocol: PROTOCOL,
            session,
            role: SessionRole::Application,
            name: name.into(),
            domain: 0,
            settings: settings.clone(),
            relay: None,
            range: Some(0),
            static_peers: None,
        });
        let socket = Address::of(&host.config()).connect().unwrap();
        let handed = segment.descriptors().unwrap();
        let handed = [&handed.segment, &handed.doorbell, &handed.pidfd].map(AsFd::as_fd);
        socket::send(&socket, &hello.encode().unwrap(), &handed).unwrap();
        let opened = SegmentOpened { session, segment: Segment { number: 1, publisher: None } };
        let packet = SessionMessage::Segment(opened).encode().unwrap();
        socket::send(&socket, &packet, &[descriptor.as_fd()]).unwrap();
        let over = || loop {
            match socket::receive(&socket, &mut Vec::new()) {
                Ok(_) => {}
                Err(socket::SocketError::Closed) => return true,
                Err(_) => return false,
            }
        };
        if name == "pipe" {
            until("it is put out", over);
        } else {
            until("it is taken", || host.status().unwrap().sessions.iter().any(|s| s.name == name));
            assert!(!over());
        }
    }
    host.status().unwrap();
}

#[test]
fn descriptors_that_are_slow_to_close_do_not_stop_the_daemon() {
    let host = Host::new();
    let daemon = host.daemon();
    let address = Address::of(&host.config());
    let tool = tool_hello();
    // The daemon receives nothing before everything has been sent. If it had closed a copy of a descriptor already, the
    // last close would be this thread's.
    signal(daemon.0.id(), Signal::STOP);
    let pid = Pid::from_raw(i32::try_from(daemon.0.id()).unwrap()).unwrap();
    waitid(WaitId::Pid(pid), WaitIdOptions::STOPPED).unwrap();
    let (tool, unknown, garbage) = (tool.encode().unwrap(), [200, 0xa0], [1]);
    // (first message, the message that carries the descriptor, the number of descriptors before it)
    type Way<'a> = (Option<&'a [u8]>, &'a [u8], usize);
    let ways: [Way<'_>; 5] = [
        (None, &unknown, 0),
        // More descriptors than belong in any packet.
        (None, &unknown, 7),
        (None, &tool, 0),
        (Some(&tool), &unknown, 0),
        // The connection ends before the packet is read.
        (Some(&garbage), &unknown, 0),
    ];
    let mut peers = Vec::new();
    // More than the daemon has closing threads.
    for (first, carrier, before) in ways.into_iter().cycle().take(45) {
        let stranger = address.connect().unwrap();
        if let Some(first) = first {
            socket::send(&stranger, first, &[]).unwrap();
        }
        let (fd, peer) = hiding();
        send_away(&stranger, carrier, before, fd);
        peers.push((peer, stranger));
    }
    signal(daemon.0.id(), Signal::CONT);
    // A refused peer sees the end of its connection.
    let other = address.connect().unwrap();
    socket::send(&other, &garbage, &[]).unwrap();
    until("the connection is over", || {
        matches!(socket::receive(&other, &mut Vec::new()), Err(socket::SocketError::Closed))
    });
    let session = host.session("witness").unwrap();
    let publisher = session.create_publisher(spec("/t")).unwrap();
    let subscription = host.session("b").unwrap().create_subscription(spec("/t")).unwrap();
    assert!(subscription.wait_matched(1, PATIENCE) && publisher.wait_matched(1, PATIENCE));
}

#[test]
fn key_packets_without_a_key_end_connections_and_hold_up_no_client() {
    let host = Host::new();
    let _daemon = host.daemon();
    let address = Address::of(&host.config());
    // Several threads repeatedly send the packet of a session's key without the key.
    let over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        for _ in 0..3 {
            scope.spawn(|| {
                // Relaxed: the flag orders nothing else.
                while !over.load(Ordering::Relaxed) {
                    let socket = match address.connect() {
                        Ok(socket) => socket,
                        // The queue of connections that the daemon has not accepted is full.
                        Err(AddressError::Busy) => continue,
                        Err(error) => panic!("{error}"),
                    };
                    while socket::send(&socket, &[32], &[]).is_ok() {}
                }
            });
        }
        for _ in 0..100 {
            host.status().expect("the status");
        }
        over.store(true, Ordering::Relaxed);
    });
    let socket = address.connect().unwrap();
    socket::send(&socket, &[32], &[]).unwrap();
    until("it is over", || {
        matches!(socket::receive(&socket, &mut Vec::new()), Err(socket::SocketError::Closed))
    });
}
