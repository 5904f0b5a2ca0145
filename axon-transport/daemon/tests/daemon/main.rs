//! Sessions and their daemon as real processes.

mod address;
mod foreign;
mod host_rules;
mod hostile;
mod left;
mod life;
mod logging;
#[path = "../support/reluctant.rs"]
mod reluctant;
#[path = "../support/skip.rs"]
mod skip;
#[path = "../support/mod.rs"]
mod support;
mod unmet;

use std::{
    io::Write,
    os::fd::{AsFd, OwnedFd},
    time::Duration,
};

use axon_daemon::{
    DaemonOptions,
    internal::{
        GatewayEntry,
        bridge::{GatewayParts, ToControl},
    },
};
use axon_shm::{PublishError, internal::SessionSegment};
use axon_transport::{
    EndpointSpec, Publisher, Session, SessionError, SessionOptions, Subscription,
    config::{Config, DaemonPolicy, security_settings},
    ids::SessionId,
    internal::{
        session::daemon::{
            address::{Address, AddressError},
            socket,
        },
        wire::session::{
            PROTOCOL, Segment, SegmentOpened, SessionHello, SessionMessage, SessionRole,
        },
    },
    qos::Qos,
    status::Status,
};
use rustix::{
    fs::{MemfdFlags, memfd_create},
    process::{Pid, Signal, WaitId, WaitIdOptions, waitid},
};
use support::{Host, PATIENCE, Player, say, signal, until, wait_for_the_end};

/// Number of samples whose descriptors do not fit in the first segment of a session's memory.
const LEFT: u64 = 5_000;

fn spec(topic: &str) -> EndpointSpec {
    EndpointSpec::new(topic, "test/Bytes", Qos::keep_all())
}

fn publish(publisher: &Publisher, number: u64) {
    loop {
        match publisher.publish(&number.to_le_bytes()) {
            Ok(_) => return,
            // The reader is slow; a KEEP_ALL publisher waits for it.
            Err(PublishError::Blocked { .. }) => {}
            Err(error) => panic!("{error}"),
        }
    }
}

fn receive(subscription: &Subscription) -> u64 {
    let mut bytes = Vec::new();
    let info = subscription.recv(&mut bytes, Some(PATIENCE)).expect("a sample in time");
    let number = u64::from_le_bytes(bytes.as_slice().try_into().unwrap());
    assert_eq!(info.sequence, number, "sequence numbers count what was published");
    number
}

/// The code of the children of the tests. It does nothing in a run of the tests themselves.
#[test]
fn child() {
    let Ok(part) = std::env::var("PLAY") else { return };
    match part.as_str() {
        "foreign" => return foreign::sessions(),
        "nobody to start" => return life::nobody_to_start(),
        "streamless" => life::streamless(),
        "few descriptors" => return life::few_descriptors(),
        "leaves a response" => return left::server(),
        "leaves samples" => return left::publisher(),
        "takes samples" => return left::taker(),
        "ends its publisher" => return unmet::publisher(),
        "ends with its publisher" => return unmet::process(),
        "is killed" => return unmet::killed(),
        "takes what is unmet" => return unmet::taker(),
        _ => {}
    }
    let config = Config::from_env().unwrap();
    let session = match Session::open(&config, SessionOptions::new(&*part)) {
        Ok(session) => session,
        Err(error) => return say(error),
    };
    match part.as_str() {
        "idle" => {
            // The test may kill the daemon as soon as it has seen this session.
            let mut daemon = None;
            until("it has a daemon", || {
                daemon = session.daemon();
                daemon.is_some()
            });
            say(daemon.unwrap());
            wait_for_the_end();
        }
        // Publishes numbers until the test has enough, then reports how many.
        "talker" => {
            let publisher = session.create_publisher(spec("/numbers")).unwrap();
            assert!(publisher.wait_matched(1, PATIENCE));
            say("matched");
            let enough = std::thread::spawn(wait_for_the_end);
            let mut number = 0;
            while !enough.is_finished() {
                number += 1;
                publish(&publisher, number);
                if number % 64 == 0 {
                    std::thread::sleep(Duration::from_millis(1));
                }
            }
            // Marks the end.
            let last = number + 1;
            publish(&publisher, last);
            say(last);
            until("everything was taken", || publisher.matched().is_empty());
        }
        // Publishes more samples than fit in the first segment of its memory, and ends at once.
        "leaver" => {
            let publisher = session.create_publisher(spec("/numbers")).unwrap();
            assert!(publisher.wait_matched(1, PATIENCE));
            say("matched");
            wait_for_the_end();
            (1..=LEFT).for_each(|number| publish(&publisher, number));
        }
        // Takes numbers, which must come without a gap, until the test tells it the last one.
        "listener" => {
            let subscription = session.create_subscription(spec("/numbers")).unwrap();
            let first = receive(&subscription);
            say(first);
            let (tell, told) = std::sync::mpsc::channel();
            std::thread::spawn(move || {
                let mut line = String::new();
                std::io::stdin().read_line(&mut line).unwrap();
                tell.send(line.trim().parse::<u64>().unwrap()).unwrap();
            });
            let (mut number, mut last, mut bytes) = (first, None, Vec::new());
            while last != Some(number) {
                let nap = Some(Duration::from_millis(20));
                if let Ok(info) = subscription.recv(&mut bytes, nap) {
                    assert_eq!(info.sequence, number + 1, "a gap or a repetition");
                    assert_eq!(bytes, info.sequence.to_le_bytes());
                    number += 1;
                } else if last.is_none() {
                    last = told.try_recv().ok();
                }
            }
            assert_eq!(subscription.lost(), 0);
            say("complete");
        }
        _ => unreachable!("no such part: {part}"),
    }
}

fn run_pair(host: &Host, meanwhile: impl FnOnce(&str)) {
    talk(host, [host.play("listener"), host.play("talker")], meanwhile);
}

/// Lets a talker talk to a listener until `meanwhile` returns, which gets the daemon's id.
fn talk(host: &Host, players: [Player; 2], meanwhile: impl FnOnce(&str)) {
    let [mut listener, mut talker] = players;
    assert_eq!(talker.hear(), "matched");
    let first: u64 = listener.hear().parse().unwrap();
    let daemon = host.status().unwrap().daemon;
    meanwhile(&daemon);
    drop(talker.child.0.stdin.take());
    let last = talker.hear();
    writeln!(listener.child.0.stdin.as_ref().unwrap(), "{last}").unwrap();
    assert_eq!(listener.hear(), "complete");
    assert!(last.parse::<u64>().unwrap() > first);
    listener.finish();
    talker.finish();
}

#[test]
fn two_processes_talk_through_a_daemon_that_the_first_one_started() {
    let host = Host::new();
    run_pair(&host, |_| std::thread::sleep(Duration::from_millis(200)));
    let status = host.status().unwrap();
    assert_eq!(status.mode, "classic");
    let environ = std::fs::read(format!("/proc/{}/stat", status.pid)).unwrap();
    let stat = String::from_utf8(environ).unwrap();
    let fields: Vec<&str> = stat.rsplit(") ").next().unwrap().split(' ').collect();
    // It is in a session of its own, and not a child of this process.
    assert_eq!(fields[3], status.pid.to_string(), "setsid");
    assert_ne!(fields[1], std::process::id().to_string(), "our child");
    let limits = std::fs::read_to_string(format!("/proc/{}/limits", status.pid)).unwrap();
    let core = limits.lines().find(|l| l.starts_with("Max core file size")).unwrap();
    assert_eq!(core.split_whitespace().nth(4), Some("0"), "{core}");
    // The kernel gives the files of a process that is not dumpable to root. A test that runs as root cannot tell.
    let own = rustix::process::geteuid().as_raw();
    let files = std::fs::metadata(format!("/proc/{}/stat", status.pid)).unwrap();
    assert!(own == 0 || std::os::unix::fs::MetadataExt::uid(&files) != own, "it is dumpable");
}

#[test]
fn a_daemon_killed_in_the_middle_loses_nothing_and_another_takes_over() {
    let host = Host::new();
    run_pair(&host, |first| {
        for _ in 0..3 {
            let before = host.status().unwrap();
            signal(before.pid, Signal::KILL);
            until("both sessions have another daemon", || {
                host.status().is_ok_and(|now| {
                    now.daemon != before.daemon && now.sessions.len() - gateways(&now) == 2
                })
            });
        }
        assert_ne!(host.status().unwrap().daemon, first);
        // A session that joins late is matched by the new daemon.
        let late = host.session("late").unwrap();
        let subscription = late.create_subscription(spec("/numbers")).unwrap();
        assert!(subscription.wait_matched(1, PATIENCE));
        receive(&subscription);
    });
}

fn gateways(status: &Status) -> usize {
    status.sessions.iter().filter(|s| s.role == "gateway").count()
}

#[test]
fn an_endpoint_that_ends_while_there_is_no_daemon_is_gone_for_its_peers() {
    let host = Host::new();
    let mut daemon = host.daemon();
    let (a, b) = (host.session("a").unwrap(), host.session("b").unwrap());
    let publisher = a.create_publisher(spec("/t")).unwrap();
    let subscription = b.create_subscription(spec("/t")).unwrap();
    let other = b.create_subscription(spec("/t")).unwrap();
    assert!(publisher.wait_matched(2, PATIENCE));
    daemon.0.kill().unwrap();
    daemon.0.wait().unwrap();
    until("the loss is noticed", || a.daemon().is_none() && b.daemon().is_none());
    publisher.publish(b"still").unwrap();
    let gid = subscription.gid();
    drop(subscription);
    let _next = host.daemon();
    assert!(other.wait_matched(1, PATIENCE));
    until("the publisher heard of it", || !publisher.matched().contains(&gid));
    assert_eq!(publisher.matched(), [other.gid()]);
    let mut bytes = Vec::new();
    assert!(other.recv(&mut bytes, Some(PATIENCE)).is_ok());
    assert_eq!(bytes, b"still");
    publisher.publish(b"again").unwrap();
    assert_eq!(other.recv(&mut bytes, Some(PATIENCE)).unwrap().sequence, 2);
    drop(publisher);
    until("the subscription heard of it", || other.matched().is_empty());
}

#[test]
fn of_twenty_that_start_at_once_one_starts_the_daemon() {
    let host = Host::new();
    let mut players: Vec<_> = (0..20).map(|_| host.play("idle")).collect();
    let daemons: Vec<String> = players.iter_mut().map(|p| p.hear()).collect();
    assert!(daemons.iter().all(|d| *d == daemons[0]), "{daemons:?}");
    let status = host.status().unwrap();
    assert_eq!(status.daemon, daemons[0]);
    assert_eq!(status.sessions.len() - gateways(&status), 20);
    players.into_iter().for_each(Player::finish);
}

#[test]
fn other_security_settings_are_refused_by_name() {
    let host = Host::new().with("AXON_QUIC_CIPHER", "aes-256-gcm");
    let _daemon = host.daemon();
    let mut config = host.config();
    config.cipher = axon_transport::config::QuicCipher::ChaCha20Poly1305;
    config.daemon = DaemonPolicy::Require;
    let refused = Session::open(&config, SessionOptions::new("other")).unwrap_err();
    let SessionError::Mismatch { variable, ours, theirs, .. } = &refused else {
        panic!("{refused}")
    };
    assert_eq!(variable, "AXON_QUIC_CIPHER");
    assert_eq!((ours.as_str(), theirs.as_str()), ("chacha20-poly1305", "aes-256-gcm"));
    let status = host.status().unwrap();
    assert!(status.refusals.iter().any(|r| r.what == "AXON_QUIC_CIPHER"), "{:?}", status.refusals);
    // The same error, as a program sees it.
    let other = Host { env: host.env.clone(), dir: tempfile::tempdir().unwrap() }
        .with("AXON_QUIC_CIPHER", "chacha20-poly1305");
    let said = other.play("idle").hear();
    assert!(said.contains("AXON_QUIC_CIPHER"), "{said}");
}

#[test]
fn require_without_a_daemon_fails_and_off_needs_none() {
    let host = Host::new();
    let refused = host.session("alone").unwrap_err();
    assert!(matches!(refused, SessionError::NoDaemon { .. }), "{refused}");
    assert!(matches!(host.status(), Err(SessionError::NoDaemon { .. })));

    let mut config = host.config();
    config.daemon = DaemonPolicy::Off;
    let session = Session::open(&config, SessionOptions::new("off")).unwrap();
    let subscription = session.create_subscription(spec("/t")).unwrap();
    let publisher = session.create_publisher(spec("/t")).unwrap();
    assert!(publisher.wait_matched(1, PATIENCE) && subscription.wait_matched(1, PATIENCE));
    publish(&publisher, 1);
    assert_eq!(receive(&subscription), 1);
    assert!(session.wait_graph(PATIENCE, |g| g.endpoints.len() == 2));
    assert!(matches!(session.status_json(), Err(SessionError::Off)));
    assert!(!host.dir.path().join("run").exists(), "nothing was created");
}

#[test]
fn domains_in_one_runtime_directory_have_separate_daemons() {
    let one = Host::new();
    let run = one.dir.path().join("run").to_str().unwrap().to_owned();
    let other = Host::new().with("AXON_RUNTIME_DIR", &run).with("ROS_DOMAIN_ID", "1");
    let hosts = [one, other];
    let _daemons = hosts.each_ref().map(Host::daemon);
    let sessions = hosts.each_ref().map(|host| host.session("a").unwrap());
    let ends = sessions.each_ref().map(|session| {
        let subscription = session.create_subscription(spec("/t")).unwrap();
        (subscription, session.create_publisher(spec("/t")).unwrap())
    });
    for (number, (subscription, publisher)) in (1..).zip(&ends) {
        assert!(subscription.wait_matched(1, PATIENCE) && publisher.wait_matched(1, PATIENCE));
        // The first pair gets one sample, the second two.
        (1..=number).for_each(|sample| publish(publisher, sample));
    }
    for (number, (subscription, publisher)) in (1..).zip(&ends) {
        assert!((1..=number).all(|sample| receive(subscription) == sample));
        assert!(subscription.take(&mut Vec::new()).is_none());
        let matched = (publisher.matched(), subscription.matched());
        assert_eq!(matched, (vec![subscription.gid()], vec![publisher.gid()]));
    }
    let statuses = hosts.each_ref().map(|host| host.status().unwrap());
    for (status, session) in statuses.iter().zip(&sessions) {
        assert_eq!(session.daemon().map(|daemon| daemon.to_string()), Some(status.daemon.clone()));
        assert_eq!(status.sessions.len() - gateways(status), 1);
        assert_eq!(status.runtime_dir.as_deref(), Some(&*run));
        assert!(!session.wait_graph(Duration::from_millis(100), |g| g.endpoints.len() > 2));
    }
    let [one, other] = &statuses;
    assert!(one.daemon != other.daemon && one.pid != other.pid && one.socket != other.socket);
}

#[test]
fn a_session_killed_takes_its_endpoints_with_it() {
    let host = Host::new();
    let _daemon = host.daemon();
    let session = host.session("witness").unwrap();
    let subscription = session.create_subscription(spec("/numbers")).unwrap();
    let mut talker = host.play("talker");
    assert_eq!(talker.hear(), "matched");
    assert!(subscription.wait_matched(1, PATIENCE));
    let mut taken = receive(&subscription);
    signal(talker.pid(), Signal::KILL);
    assert!(session.wait_graph(PATIENCE, |g| g.endpoints.len() == 1));
    until("the subscription heard of it", || subscription.matched().is_empty());
    // The samples of the dead process can still be taken.
    while subscription.has_data() {
        let next = receive(&subscription);
        assert_eq!(next, taken + 1);
        taken = next;
    }
    assert_eq!(subscription.lost(), 0);
    until("the daemon forgot it", || host.status().unwrap().topics[0].publishers == 0);
}

#[test]
fn a_reader_killed_does_not_hold_its_writer_up() {
    let host = Host::new();
    let _daemon = host.daemon();
    let session = host.session("writer").unwrap();
    let publisher = session.create_publisher(spec("/numbers")).unwrap();
    let listener = host.play("listener");
    assert!(publisher.wait_matched(1, PATIENCE));
    signal(listener.pid(), Signal::STOP);
    let blocked = (1..).find(|n: &u64| {
        matches!(publisher.publish(&n.to_le_bytes()), Err(PublishError::Blocked { .. }))
    });
    signal(listener.pid(), Signal::KILL);
    assert!(blocked.is_some());
    until("the publisher heard of it", || publisher.matched().is_empty());
    publisher.publish(b"on").unwrap();
}

#[test]
fn without_a_usable_runtime_directory_nothing_is_kept_and_everything_works() {
    // The abstract name is unique per user and domain, so the test uses a domain of its own.
    let host = Host::new()
        .without("AXON_RUNTIME_DIR")
        .with("XDG_RUNTIME_DIR", "/proc/no-such-directory")
        .with("ROS_DOMAIN_ID", "170");
    run_pair(&host, |daemon| keeps_nothing(&host, daemon));
}

/// Asserts that this daemon, which a session started, has no directory, and an address that is not a file.
fn keeps_nothing(host: &Host, daemon: &str) {
    let status = host.status().unwrap();
    assert_eq!((&*status.daemon, status.runtime_dir), (daemon, None));
    assert!(status.socket.starts_with('@'), "{}", status.socket);
}

#[test]
fn a_daemon_that_does_not_start_is_an_error_with_its_reason() {
    let host = Host::new().with("AXON_DAEMON_PATH", "/bin/false");
    let said = host.play("idle").hear();
    assert!(said.contains("/bin/false did not start"), "{said}");

    // The daemon is stricter than the session here: other users can write to the directory.
    let host = Host::new();
    let run = host.dir.path().join("run");
    std::fs::create_dir(&run).unwrap();
    let open = std::os::unix::fs::PermissionsExt::from_mode(0o777);
    std::fs::set_permissions(&run, open).unwrap();
    let said = host.play("idle").hear();
    assert!(said.contains("AXON_RUNTIME_DIR") && said.contains("0700"), "{said}");
}

#[test]
fn a_wrong_setting_ends_a_daemon_with_status_2_and_one_line() {
    let host = Host::new().with("AXON_ENCRYPTION_MODE", "none");
    let output = host.command(env!("CARGO_BIN_EXE_axon_daemon")).output().unwrap();
    assert_eq!(output.status.code(), Some(2));
    let text = String::from_utf8(output.stderr).unwrap();
    assert_eq!(text.lines().count(), 1, "{text}");
    assert!(text.contains("AXON_ENCRYPTION_MODE"), "{text}");
    assert!(!host.dir.path().join("run").exists(), "nothing was created");
}

#[test]
fn a_second_daemon_by_hand_says_that_there_is_one() {
    let host = Host::new();
    let _daemon = host.daemon();
    let output = host.command(env!("CARGO_BIN_EXE_axon_daemon")).output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    let text = String::from_utf8(output.stderr).unwrap();
    assert!(text.contains("another daemon"), "{text}");
}

/// A gateway that starts and then panics.
fn failing_gateway(parts: GatewayParts) -> Result<(), String> {
    parts.control.blocking_send(ToControl::Started { port: 1 }).unwrap();
    panic!("as a gateway may")
}

#[test]
fn a_panicked_gateway_is_restarted_without_disturbing_sessions() {
    let host = Host::new();
    let config = host.config();
    let daemon = std::thread::spawn(move || {
        let options = DaemonOptions::default().gateway(failing_gateway);
        axon_daemon::run(config, options)
    });
    until("the daemon answers", || host.status().is_ok());
    let session = host.session("a").unwrap();
    let publisher = session.create_publisher(spec("/t")).unwrap();
    for _ in 0..3 {
        until("it failed", || host.status().unwrap().gateway.contains("panicked"));
        let other = host.session("b").unwrap();
        let subscription = other.create_subscription(spec("/t")).unwrap();
        assert!(subscription.wait_matched(1, PATIENCE) && publisher.wait_matched(1, PATIENCE));
        publisher.publish(b"x").unwrap();
        assert!(subscription.recv(&mut Vec::new(), Some(PATIENCE)).is_ok());
        drop(subscription);
        until("the reader is gone", || publisher.matched().is_empty());
    }
    // It would end when no session needs it; the test need not wait for that.
    assert!(!daemon.is_finished());
}

#[test]
fn a_gateway_that_cannot_start_is_an_error_of_the_daemon() {
    let host = Host::new();
    let gateway: GatewayEntry = |_| Err("AXON_SAE_KEY: no key in it".into());
    let options = DaemonOptions::default().gateway(gateway);
    let error = axon_daemon::run(host.config(), options).unwrap_err();
    assert!(error.to_string().contains("AXON_SAE_KEY"), "{error}");
    assert!(matches!(host.status(), Err(SessionError::NoDaemon { .. })));
}

#[test]
fn a_daemon_in_the_foreground_stays_until_sigterm() {
    let host = with_grace(Host::new(), 0);
    let mut daemon = host.daemon();
    for _ in 0..2 {
        drop(host.session("visitor").unwrap());
        until("the session is gone", || {
            let status = host.status().unwrap();
            status.sessions.iter().all(|session| session.name != "visitor")
        });
    }
    // Without a grace time, a daemon in the background would end at once.
    std::thread::sleep(Duration::from_millis(500));
    assert_eq!(host.status().unwrap().pid, daemon.0.id());
    signal(daemon.0.id(), Signal::TERM);
    assert!(daemon.0.wait().unwrap().success());
    assert!(!host.dir.path().join("run/axon-0.sock").exists());
}

#[test]
fn a_daemon_that_a_session_started_ends_when_no_session_needs_it() {
    let host = with_grace(Host::new(), 1);
    let player = host.play("idle");
    until("it has started one", || host.status().is_ok());
    player.finish();
    until("the daemon ends", || matches!(host.status(), Err(SessionError::NoDaemon { .. })));
}

/// Makes the daemons of the host stay for some seconds after their last session.
fn with_grace(host: Host, seconds: u32) -> Host {
    let toml = host.dir.path().join("axon.toml");
    std::fs::write(&toml, format!("[link]\ngrace_s = {seconds}\n")).unwrap();
    host.with("AXON_CONFIG", toml.to_str().unwrap())
}
