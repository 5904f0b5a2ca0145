//! At the limits that a system sets, and interrupted where it hurts: an error that says what is
//! short, or a delay, and never somebody's end.

#[path = "support/group.rs"]
mod group;
mod support;

use std::{
    fs,
    io::Write as _,
    os::unix::{fs::MetadataExt as _, net::UnixDatagram, process::CommandExt as _},
    path::{Path, PathBuf},
    process::Stdio,
    thread,
    time::Duration,
};

use axon_transport::{
    qos::{Durability, Qos},
    session::{
        EndpointSpec, Session, SessionEvent,
        address::Address,
        message::{Hello, Message, PROTOCOL, SessionRole},
        socket,
    },
    shm::{
        ConnectError, Context, PublishError, Publisher, PublisherOptions, ShmError, Subscriber,
        SubscriberOptions,
    },
};
use group::Group;
use rustix::process::{Resource, Rlimit, Signal, setrlimit};
use support::{Host, PATIENCE, of_child, say, signal, until, wait_for_the_end};

fn spec(topic: &str) -> EndpointSpec {
    EndpointSpec::new(topic, "test/Bytes", Qos::keep_all())
}

/// What is published before anybody listens is kept.
fn latched(topic: &str) -> EndpointSpec {
    let qos = Qos { durability: Durability::TransientLocal, ..Qos::keep_all() };
    EndpointSpec::new(topic, "test/Bytes", qos)
}

/// One end of a socket between a test and its child; `first` is the test's.
fn meet(name: &str, first: bool) -> UnixDatagram {
    let path = |end: bool| PathBuf::from(format!("{name}.{}", u8::from(end)));
    let socket = UnixDatagram::bind(path(first)).unwrap();
    until("the other end is there", || socket.connect(path(!first)).is_ok());
    socket
}

fn at(host: &Host, name: &str) -> String {
    host.dir.path().join(name).to_str().unwrap().to_owned()
}

/// Says in the test's output why something of it cannot be tried here.
#[allow(clippy::print_stdout)]
fn skip(why: &str) {
    println!("skipped: {why}");
}

/// What the children of the tests do. In a run of the tests themselves it does nothing.
#[test]
fn child() {
    let Ok(part) = std::env::var("PLAY") else { return };
    let place = || std::env::var("PLACE").unwrap();
    match part.as_str() {
        "locked" => {
            // SAFETY: takes plain flags.
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
        // Alone in its process, so that all shared memory is its own.
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
            // The last socket stays open: whoever has not met it yet would wait in vain.
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
            // What is attached goes on.
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
                subscriber.tend();
            }
            drop(all);
            say(subscriber.recv(Some(PATIENCE)).unwrap().map_or(0, |sample| sample.len()));
            wait_for_the_end();
        }
        "many publishers" => {
            let few = Rlimit { current: Some(256), maximum: Some(256) };
            setrlimit(Resource::Nofile, few).unwrap();
            let session = of_child("many");
            // A publisher takes a descriptor with its first large sample.
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
            // What is small needs none.
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
            let all: Vec<_> = (0..100)
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
            // What is small needs no memory of its own.
            all[0].publish(b"small").unwrap();
            wait_for_the_end();
        }
        "confined" => {
            let group = std::env::var("GROUP").unwrap();
            group::join(Path::new(&group)).unwrap();
            let context = Context::new().unwrap();
            let options = PublisherOptions::new(Qos {
                depth: 1000,
                durability: Durability::TransientLocal,
                ..Qos::default()
            });
            let options = options.budget(1 << 30).max_len(128 << 20);
            let publisher = Publisher::new(&context, options).unwrap();
            // Fewer of these are kept than are wanted.
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
            let hello = Message::Hello(Hello {
                protocol: PROTOCOL,
                session: axon_transport::ids::SessionId::random(),
                role: SessionRole::Tool,
                name: "stranger".into(),
                domain: 171,
                settings: Vec::new(),
                relay: None,
            });
            let _ = socket::send(&socket, &hello.encode().unwrap(), &[]);
            let mut buffer = Vec::new();
            until("an answer", || {
                !matches!(socket::receive(&socket, &mut buffer), Err(socket::SocketError::NotReady))
            });
            let end = socket::receive(&socket, &mut buffer);
            say(if matches!(end, Err(socket::SocketError::Closed)) { "put out" } else { "heard" });
        }
        "listener" => {
            let session = of_child("listener");
            let subscription = session.create_subscription(spec("/t")).unwrap();
            let got = subscription.recv(&mut Vec::new(), Some(PATIENCE));
            say(if got.is_some() { "heard" } else { "nothing" });
            wait_for_the_end();
        }
        _ => unreachable!("no such part: {part}"),
    }
}

/// Blocks of shared memory that this process holds descriptors of.
fn blocks() -> u64 {
    let paths = fs::read_dir("/proc/self/fd").unwrap().flatten().map(|entry| entry.path());
    let is_ours = |to: &Path| to.as_os_str().as_encoded_bytes().starts_with(b"/memfd:axon-");
    let memfds = paths.filter(|path| fs::read_link(path).is_ok_and(|to| is_ours(&to)));
    let blocks =
        memfds.filter_map(|path| fs::metadata(path).ok()).map(|found| found.blocks()).sum();
    assert!(blocks > 0, "no shared memory was found");
    blocks
}

#[test]
fn a_reader_that_locks_its_memory_takes_none_of_its_publishers() {
    let host = Host::new();
    let place = at(&host, "m");
    let host = host.with("PLACE", &place);
    let mut reader = host.play("locked");
    let said = reader.hear();
    if said != "locked" {
        return skip(&said);
    }
    let mut owner = host.play("owner");
    for step in ["attached", "taken"] {
        assert_eq!(reader.hear(), step);
        writeln!(owner.child.0.stdin.as_ref().unwrap(), "{step}").unwrap();
        assert_eq!(owner.hear(), "nothing was taken");
    }
    reader.finish();
    owner.finish();
}

#[test]
fn a_process_without_descriptors_left_says_so_and_goes_on() {
    let host = Host::new();
    let place = at(&host, "m");
    let host = host.with("PLACE", &place);
    let mut reader = host.play("few descriptors");
    let mut publishers = Vec::new();
    let said = loop {
        // Each of a context of its own: what makes a peer take descriptors.
        let context = Context::new().unwrap();
        let options = PublisherOptions::new(Qos::keep_all());
        let publisher = Publisher::new(&context, options).unwrap();
        let socket = meet(&format!("{place}-{}", publishers.len()), true);
        match publisher.serve(&socket, Some(Duration::from_secs(5))) {
            Ok(_) => {}
            Err(ConnectError::Timeout | ConnectError::Closed) => {}
            Err(error) => panic!("{error}"),
        }
        publishers.push(publisher);
        let said = reader.hear();
        if said != "attached" {
            break said;
        }
        assert!(publishers.len() < 300, "300 peers fit into 256 descriptors");
    };
    assert!(said.contains("descriptors") || said.contains("open files"), "{said}");
    for publisher in &publishers {
        publisher.publish(b"still").unwrap();
    }
    assert_eq!(reader.hear(), "whole");
    reader.finish();
}

#[test]
fn memory_that_a_subscriber_had_no_descriptor_for_comes_when_it_has_one() {
    let host = Host::new();
    let place = at(&host, "m");
    let host = host.with("PLACE", &place);
    let mut reader = host.play("starved");
    let context = Context::new().unwrap();
    let publisher = Publisher::new(&context, PublisherOptions::new(Qos::keep_all())).unwrap();
    publisher.serve(meet(&place, true), Some(PATIENCE)).unwrap();
    assert_eq!(reader.hear(), "starved");
    publisher.publish(&[1; 100_000]).unwrap();
    reader.go();
    assert_eq!(reader.hear(), "100000");
    reader.finish();
}

#[test]
fn a_session_with_more_memory_than_the_daemon_can_hold_is_told_once_and_stays() {
    let host = Host::new();
    let daemon = host.daemon();
    let few = Rlimit { current: Some(500), maximum: Some(500) };
    let pid = rustix::process::Pid::from_child(&daemon.0);
    rustix::process::prlimit(Some(pid), Resource::Nofile, few).unwrap();
    let session = host.session("witness").unwrap();
    let mut much = host.play("much memory");
    assert_eq!(much.hear(), "published");
    let told = |text: &str| {
        let refusals = host.status().unwrap().refusals;
        refusals.iter().filter(|refusal| refusal.reason.contains(text)).count()
    };
    until("it is told", || told("RLIMIT_NOFILE") > 0);
    let first = session.create_subscription(latched("/t0")).unwrap();
    let mut bytes = Vec::new();
    assert!(first.recv(&mut bytes, Some(PATIENCE)).is_some(), "what the daemon has is seen");
    much.go();
    assert!(first.recv(&mut bytes, Some(PATIENCE)).is_some());
    assert_eq!((&bytes[..], told("RLIMIT_NOFILE")), (&b"small"[..], 1));
    // It was never disconnected.
    much.finish_silently();
}

#[test]
fn a_session_without_descriptors_left_says_so_and_goes_on() {
    let host = Host::new();
    let _daemon = host.daemon();
    let session = host.session("witness").unwrap();
    let subscription = session.create_subscription(spec("/t0")).unwrap();
    let mut many = host.play("many publishers");
    let said = many.hear();
    assert!(said.contains("open files"), "{said}");
    assert_eq!(many.hear(), "published");
    let mut bytes = Vec::new();
    while bytes != b"still" {
        assert!(subscription.recv(&mut bytes, Some(PATIENCE)).is_some());
    }
    many.finish();
}

#[test]
fn a_publisher_at_the_limit_of_its_control_group_is_refused_and_not_killed() {
    let group = match Group::new(64 << 20) {
        Ok(group) => group,
        Err(why) => return skip(&why),
    };
    let host = Host::new().with("GROUP", group.path().to_str().unwrap());
    let mut publisher = host.play("confined");
    let said = publisher.hear();
    assert!(said.contains("control group"), "{said}");
    assert_eq!(publisher.hear(), "alive");
    publisher.finish();
    until("the group is empty", || {
        fs::read_to_string(group.path().join("cgroup.procs")).is_ok_and(|text| text.is_empty())
    });
}

#[test]
fn another_user_is_not_heard() {
    if !rustix::process::geteuid().is_root() {
        return skip("only root can be two users");
    }
    // The abstract name is the user's and the domain's: a domain that no other test has.
    let host = Host::new()
        .without("AXON_RUNTIME_DIR")
        .with("XDG_RUNTIME_DIR", "/proc/no-such-directory")
        .with("ROS_DOMAIN_ID", "171");
    let _daemon = host.daemon();
    let name = Address::of(&host.config()).to_string();
    let name = name.strip_prefix('@').expect("an abstract name");
    // Where another user can run it.
    let program = Path::new("/tmp").join(format!("axon-limits-{}", std::process::id()));
    fs::copy(std::env::current_exe().unwrap(), &program).unwrap();
    let output = host
        .command(&program)
        .args(["child", "--exact", "--nocapture", "--test-threads=1"])
        .env("PLAY", "stranger")
        .env("PLACE", name)
        .uid(65534)
        .gid(65534)
        .stdin(Stdio::null())
        .output();
    fs::remove_file(&program).unwrap();
    let said = String::from_utf8(output.unwrap().stdout).unwrap();
    assert!(said.contains("put out"), "{said}");
    assert!(host.status().unwrap().sessions.iter().all(|s| s.name != "stranger"));
}

#[test]
fn a_reader_stopped_in_the_middle_of_its_attachment_holds_nobody_up() {
    let host = Host::new();
    let _daemon = host.daemon();
    let session = host.session("writer").unwrap();
    let publisher = session.create_publisher(spec("/t")).unwrap();
    let witness = host.session("witness").unwrap();
    let other = witness.create_subscription(spec("/t")).unwrap();
    assert!(other.wait_matched(1, PATIENCE) && publisher.wait_matched(1, PATIENCE));
    let mut published = 0;
    for round in 0..24 {
        let mut reader = host.play("listener");
        thread::sleep(Duration::from_millis(round * 2));
        signal(reader.pid(), Signal::STOP);
        // Whatever it has come to, the others go on.
        for _ in 0..5 {
            match publisher.publish(b"x") {
                Ok(_) => published += 1,
                // It is attached already, and this is what KEEP_ALL means.
                Err(PublishError::Blocked { .. }) => {}
                Err(error) => panic!("{error}"),
            }
        }
        if round % 3 == 0 {
            signal(reader.pid(), Signal::KILL);
            until("it is forgotten", || publisher.matched() == [other.gid()]);
            continue;
        }
        signal(reader.pid(), Signal::CONT);
        until("it is attached", || publisher.matched().len() == 2);
        publisher.publish(b"x").unwrap();
        published += 1;
        assert_eq!(reader.hear(), "heard");
        reader.finish();
        until("it is forgotten", || publisher.matched() == [other.gid()]);
    }
    let mut bytes = Vec::new();
    for _ in 0..published {
        assert!(other.recv(&mut bytes, Some(PATIENCE)).is_some());
    }
    assert_eq!((other.received(), other.lost()), (published, 0));
}

#[test]
fn a_daemon_killed_in_the_middle_of_attachments_is_followed_by_one_that_completes_them() {
    let host = Host::new();
    // The first of them starts the daemon, and so do those that follow.
    let mut idle = host.play("listener");
    until("a daemon is there", || host.status().is_ok());
    for round in 0..12 {
        let (a, b) = (host_session(&host, "a"), host_session(&host, "b"));
        let topic = format!("/round{round}");
        let publisher = a.create_publisher(spec(&topic)).unwrap();
        let subscription = b.create_subscription(spec(&topic)).unwrap();
        thread::sleep(Duration::from_micros(400 * round));
        if let Ok(status) = host.status() {
            signal(status.pid, Signal::KILL);
        }
        assert!(publisher.wait_matched(1, PATIENCE) && subscription.wait_matched(1, PATIENCE));
        publisher.publish(b"x").unwrap();
        assert!(subscription.recv(&mut Vec::new(), Some(PATIENCE)).is_some());
    }
    let publisher = host_session(&host, "c").create_publisher(spec("/t")).unwrap();
    assert!(publisher.wait_matched(1, PATIENCE));
    publisher.publish(b"x").unwrap();
    assert_eq!(idle.hear(), "heard");
    idle.finish();
}

/// A session in this process with a daemon that somebody else starts.
fn host_session(host: &Host, name: &str) -> Session {
    let mut session = None;
    until("a daemon takes it", || {
        session = host.session(name).ok();
        session.is_some()
    });
    session.unwrap()
}

#[test]
fn a_forked_child_can_have_a_context_of_its_own() {
    let context = Context::new().unwrap();
    // SAFETY: the child makes and drops a context, and leaves by _exit.
    let child = unsafe { libc::fork() };
    if child == 0 {
        let refused = matches!(context.event(), Err(ShmError::Forked));
        let own = Context::new().is_ok_and(|own| own.id() != context.id());
        // SAFETY: ends the process without running anything else.
        unsafe { libc::_exit(i32::from(!(refused && own))) };
    }
    let mut status = -1;
    // SAFETY: waits for the child just made; `status` outlives the call.
    assert_eq!(unsafe { libc::waitpid(child, &mut status, 0) }, child);
    assert_eq!(status, 0);
}
