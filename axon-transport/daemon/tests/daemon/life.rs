//! The circumstances in which a daemon is started, and those that it survives.

use std::{
    fs,
    os::unix::{fs::PermissionsExt as _, process::CommandExt as _},
    path::Path,
    process::{Command, Stdio},
};

use axon_transport::{
    ids::DaemonId,
    internal::{session::daemon::address::Address, wire::session::Welcome},
};
use rustix::process::{Pid, Signal, kill_process_group};

use super::*;
use crate::{skip::skip, support::Kept};

/// Returns the command of a child that plays `part`. Its output is discarded.
fn command(host: &Host, part: &str) -> Command {
    let mut command = host.command(std::env::current_exe().unwrap());
    command.args(["child", "--exact", "--nocapture", "--test-threads=1"]).env("PLAY", part);
    command.stdin(Stdio::piped()).stdout(Stdio::null());
    command
}

/// Waits until there are `count` sessions of applications, and returns the status.
fn sessions(host: &Host, count: usize) -> Status {
    let mut status = None;
    until("the sessions are there", || {
        status = host.status().ok();
        status.as_ref().is_some_and(|s| s.sessions.len() - gateways(s) == count)
    });
    status.unwrap()
}

/// Settings, the variable that names an unusable file, and the file's name.
type Unusable = (Vec<(&'static str, String)>, &'static str, &'static str);

/// Returns settings that are valid by themselves but name an unusable file in `dir`.
fn unusable_files(dir: &Path) -> [Unusable; 3] {
    let file = |name: &str, text: &str| {
        let path = dir.join(name);
        fs::write(&path, text).unwrap();
        fs::set_permissions(&path, fs::Permissions::from_mode(0o600)).unwrap();
        path.to_str().unwrap().to_owned()
    };
    let good = file("good.key", &axon_tls::identity::SigningKey::generate_pem().unwrap());
    let empty = file("empty-trust", "");
    let classic = |key: &String, trust: &String| {
        vec![("AXON_CLASSIC_KEY", key.clone()), ("AXON_CLASSIC_TRUST", trust.clone())]
    };
    let qkd = vec![
        ("AXON_SECURITY_MODE", "qkd".to_owned()),
        ("AXON_QKD_PEERS", "sae-b".to_owned()),
        ("AXON_SAE_ID", "sae-a".to_owned()),
        ("AXON_KME_URL", "https://127.0.0.1:9".to_owned()),
        ("AXON_KME_CA", file("junk.pem", "junk")),
        ("AXON_SAE_CERT", file("sae.crt", "junk")),
        ("AXON_SAE_KEY", good.clone()),
    ];
    [
        (classic(&file("junk.key", "junk"), &empty), "AXON_CLASSIC_KEY", "junk.key"),
        (classic(&good, &file("junk-trust", "half a line")), "AXON_CLASSIC_TRUST", "junk-trust"),
        (qkd, "AXON_KME_CA", "junk.pem"),
    ]
}

#[test]
fn unusable_file_ends_a_daemon_with_status_2_and_no_traces() {
    let dir = tempfile::tempdir().unwrap();
    for (settings, variable, file) in unusable_files(dir.path()) {
        let host = settings.iter().fold(Host::new(), |host, (name, value)| host.with(name, value));
        let output = host.command(env!("CARGO_BIN_EXE_axon_daemon")).output().unwrap();
        let text = String::from_utf8(output.stderr).unwrap();
        assert_eq!((output.status.code(), text.lines().count()), (Some(2), 1), "{text}");
        assert!(text.contains(variable) && text.contains(file), "{text}");
        assert!(!host.dir.path().join("run").exists(), "something was made: {text}");
        // A session gets the same error from the daemon that it starts.
        let said = host.play("idle").hear();
        assert!(said.contains(variable) && said.contains(file), "{said}");
        let log = host.dir.path().join("run/axon-0.log");
        assert!(!log.exists(), "{:?}", fs::read_to_string(log));
    }
}

#[test]
fn the_terminals_interrupt_ends_an_application_and_not_the_daemon_it_started() {
    let host = Host::new();
    let first = Kept(command(&host, "idle").process_group(0).spawn().unwrap());
    let second = Kept(command(&host, "idle").process_group(0).spawn().unwrap());
    let before = sessions(&host, 2);
    for mut player in [first, second] {
        let group = Pid::from_child(&player.0);
        kill_process_group(group, Signal::INT).unwrap();
        assert!(!player.0.wait().unwrap().success());
    }
    let after = sessions(&host, 0);
    assert_eq!((after.daemon, after.pid), (before.daemon, before.pid));
}

#[test]
fn a_daemon_is_started_by_a_process_without_standard_streams() {
    let host = Host::new();
    let _player = Kept(command(&host, "streamless").spawn().unwrap());
    let status = sessions(&host, 1);
    // The daemon has no streams that were meant for another use.
    let streams = (0..3).map(|fd| fs::read_link(format!("/proc/{}/fd/{fd}", status.pid)));
    let streams: Vec<_> = streams.map(|link| link.unwrap().display().to_string()).collect();
    assert_eq!(streams[..2], ["/dev/null", "/dev/null"]);
    assert!(streams[2].ends_with("run/axon-0.log"), "{streams:?}");
}

/// The child: closes its streams, so that descriptors of the session get their numbers.
pub(crate) fn streamless() {
    for stream in 0..3 {
        // SAFETY: nothing in this process uses the streams from here on. The harness, to which this does not return,
        // does not write to the descriptors that get their numbers.
        unsafe { libc::close(stream) };
    }
    let session = support::of_child("streamless");
    let (subscription, publisher) = (
        session.create_subscription(spec("/t")).unwrap(),
        session.create_publisher(spec("/t")).unwrap(),
    );
    publish(&publisher, 1);
    assert_eq!(receive(&subscription), 1);
    // Runs until the test kills it.
    loop {
        std::thread::park();
    }
}

#[test]
fn missing_daemon_program_is_an_error_with_its_paths_and_remedy() {
    let host = Host::new().without("AXON_DAEMON_PATH");
    let [path, home] = ["bin", "home"].map(|name| host.dir.path().join(name));
    let beside = std::env::current_exe().unwrap().parent().unwrap().to_path_buf();
    let cargo = home.join(".cargo/bin");
    for (path, home, folders) in [
        (Path::new(""), Path::new(""), &[&beside][..]),
        (&*path, &*home, &[&beside, &path, &cargo]),
    ] {
        let mut command = host.command(std::env::current_exe().unwrap());
        command.env("PATH", path).env("HOME", home).env_remove("CARGO_HOME");
        let mut player = host.play_in(command, "nobody to start");
        let (shown, debug) = (player.hear(), player.hear());
        player.finish();
        let folders: Vec<_> = folders.iter().map(|folder| folder.display().to_string()).collect();
        for said in [shown, debug] {
            assert!(said.contains(&format!(" in {};", folders.join(", "))), "{said}");
            assert!(said.contains("cargo install --locked --git https://"), "{said}");
            assert!(said.contains(" axon-cli`, or set AXON_DAEMON_PATH"), "{said}");
        }
    }
}

/// The child: reports the `Display` and `Debug` texts of the error, which a `main` prints.
pub(crate) fn nobody_to_start() {
    let opened = Session::open(&Config::from_env().unwrap(), SessionOptions::new("nobody"));
    let Err(error) = opened else { panic!("there is no daemon, and none to start") };
    say(&error);
    say(format!("{error:?}"));
}

#[test]
fn all_works_where_every_file_system_is_read_only() {
    let host = Host::new()
        .without("AXON_RUNTIME_DIR")
        .with("XDG_RUNTIME_DIR", "/tmp/xdg")
        .with("ROS_DOMAIN_ID", "171");
    let script = "mount --make-rprivate / && mount --bind / / && \
        awk '{ print $2 }' /proc/mounts | tac | while read at; do \
        mount -o remount,ro,bind \"$at\" 2>/dev/null; done; \
        if touch /tmp/.axon-test 2>/dev/null; then rm /tmp/.axon-test; exit 77; fi; exec \"$@\"";
    let within = |program: &str| {
        let mut unshare = host.command("unshare");
        unshare.args(["-m", "sh", "-c", script, "sh", program]);
        unshare
    };
    match within("true").status() {
        Ok(status) if status.success() => {}
        Ok(status) => return skip(format_args!("no mount namespace here: {status}")),
        Err(error) => return skip(format_args!("no unshare: {error}")),
    }
    let own = std::env::current_exe().unwrap();
    let players =
        ["listener", "talker"].map(|part| host.play_in(within(own.to_str().unwrap()), part));
    talk(&host, players, |daemon| keeps_nothing(&host, daemon));
}

#[test]
fn all_works_without_a_runtime_directory() {
    let host = Host::new().without("AXON_RUNTIME_DIR").with("ROS_DOMAIN_ID", "172");
    run_pair(&host, |daemon| keeps_nothing(&host, daemon));
}

#[test]
fn all_works_with_256_descriptors() {
    let host = Host::new();
    let mut players: Vec<_> = (0..8).map(|_| host.play("few descriptors")).collect();
    for player in &mut players {
        assert_eq!(player.hear(), "limited");
    }
    for player in &mut players {
        assert_eq!(player.hear(), "matched");
    }
    players.iter_mut().for_each(Player::go);
    for player in &mut players {
        assert_eq!(player.hear(), "taken");
    }
    // One of the processes started the daemon, which therefore has the same limit.
    let limits = fs::read_to_string(format!("/proc/{}/limits", host.status().unwrap().pid));
    let limits = limits.unwrap();
    let files = limits.lines().find(|line| line.starts_with("Max open files")).unwrap();
    assert_eq!(files.split_whitespace().nth(4), Some("256"));
    players.into_iter().for_each(Player::finish);
}

/// The code of each child.
pub(crate) fn few_descriptors() {
    let few = rustix::process::Rlimit { current: Some(256), maximum: Some(256) };
    rustix::process::setrlimit(rustix::process::Resource::Nofile, few).unwrap();
    say("limited");
    let session = support::of_child("few");
    let topics = || (0..10).map(|topic| spec(&format!("/t{topic}")));
    let subscriptions: Vec<_> =
        topics().map(|spec| session.create_subscription(spec).unwrap()).collect();
    let publishers: Vec<_> = topics().map(|spec| session.create_publisher(spec).unwrap()).collect();
    assert!(subscriptions.iter().all(|s| s.wait_matched(8, PATIENCE)));
    assert!(publishers.iter().all(|p| p.wait_matched(8, PATIENCE)));
    say("matched");
    let mut line = String::new();
    std::io::stdin().read_line(&mut line).unwrap();
    publishers.iter().for_each(|publisher| publish(publisher, 1));
    for subscription in &subscriptions {
        (0..8).for_each(|_| assert_eq!(receive(subscription), 1));
        assert_eq!(subscription.lost(), 0);
    }
    say("taken");
    wait_for_the_end();
}

/// Makes the host count how often its daemon is [started].
pub(crate) fn counting(host: Host) -> Host {
    let script = host.dir.path().join("daemon.sh");
    let text = format!(
        "#!/bin/sh\necho one >> {}\nexec {} \"$@\"\n",
        host.dir.path().join(STARTED).display(),
        env!("CARGO_BIN_EXE_axon_daemon")
    );
    fs::write(&script, text).unwrap();
    fs::set_permissions(&script, fs::Permissions::from_mode(0o755)).unwrap();
    let script = script.to_str().unwrap().to_owned();
    host.with("AXON_DAEMON_PATH", &script)
}

/// Returns how often the daemon of a [counting] host was started.
pub(crate) fn started(host: &Host) -> usize {
    let count = fs::read_to_string(host.dir.path().join(STARTED));
    count.map_or(0, |count| count.lines().count())
}

/// The file in which a [counting] host counts.
const STARTED: &str = "started";

#[test]
fn many_that_lose_their_daemon_do_not_each_start_one() {
    let host = counting(Host::new());
    let players: Vec<_> = (0..20).map(|_| host.play("idle")).collect();
    let first = sessions(&host, 20);
    signal(first.pid, Signal::KILL);
    until("there is another", || host.status().is_ok_and(|next| next.daemon != first.daemon));
    sessions(&host, 20);
    let started = started(&host);
    // Two, unless the machine is so slow that some of them gave up waiting.
    assert!(started < 8, "{started} daemons were started");
    players.into_iter().for_each(Player::finish);
}

#[test]
fn another_version_is_refused_by_both_sides() {
    let host = Host::new();
    let daemon = host.daemon();
    let hello = |protocol| {
        SessionMessage::Hello(SessionHello {
            protocol,
            session: SessionId([9; 16]),
            role: SessionRole::Tool,
            name: "later".into(),
            domain: 0,
            settings: Vec::new(),
            relay: None,
            range: Some(0),
            static_peers: None,
        })
    };
    let stranger = Address::of(&host.config()).connect().unwrap();
    socket::send(&stranger, &hello(PROTOCOL + 1).encode().unwrap(), &[]).unwrap();
    let mut answer = None;
    until("it answers", || {
        answer = socket::receive(&stranger, &mut Vec::new()).ok();
        answer.is_some()
    });
    match answer.unwrap().message {
        SessionMessage::Refused(refused) => {
            assert!(refused.text.contains("protocol"), "{}", refused.text);
        }
        other => panic!("instead of a refusal: {other:?}"),
    }
    drop(daemon);

    // A daemon of another version, at the address of this version's daemon.
    let (listeners, _lock) = Address::of(&host.config()).bind().unwrap().into_parts();
    let later = std::thread::spawn(move || {
        let mut accepted = None;
        until("somebody calls", || {
            accepted = rustix::net::accept(&listeners[0]).ok();
            accepted.is_some()
        });
        let accepted = accepted.unwrap();
        until("HELLO", || {
            let received = socket::receive(&accepted, &mut Vec::new());
            received.is_ok_and(|received| matches!(received.message, SessionMessage::Hello(_)))
        });
        let daemon = DaemonId([7; 16]);
        let welcome = SessionMessage::Welcome(Welcome {
            protocol: PROTOCOL + 1,
            daemon,
            pid: std::process::id(),
            ranges: Some(true),
        });
        socket::send(&accepted, &welcome.encode().unwrap(), &[]).unwrap();
    });
    let refused = host.session("now").unwrap_err();
    assert!(refused.to_string().contains(&format!("protocol {}", PROTOCOL + 1)), "{refused}");
    later.join().unwrap();
}

/// The daemon is stopped meanwhile: it finds at once that the process ended, together with the messages that it sent
/// before.
#[test]
fn all_samples_of_a_publisher_that_ends_are_taken_though_the_daemon_is_slow() {
    for _ in 0..6 {
        let host = Host::new();
        let daemon = host.daemon();
        let session = host.session("reader").unwrap();
        let subscription = session.create_subscription(spec("/numbers")).unwrap();
        let mut leaver = host.play("leaver");
        assert_eq!(leaver.hear(), "matched");
        assert!(subscription.wait_matched(1, PATIENCE));
        signal(daemon.0.id(), Signal::STOP);
        leaver.finish();
        until("the reader heard of it", || subscription.matched().is_empty());
        // The reader finds that memory is missing, and sleeps.
        let (tell, told) = std::sync::mpsc::channel();
        std::thread::scope(|scope| {
            scope.spawn(|| {
                for number in 1..=LEFT {
                    assert_eq!(receive(&subscription), number);
                }
                tell.send(()).unwrap();
            });
            assert!(told.recv_timeout(Duration::from_millis(500)).is_err(), "nothing was missing");
            signal(daemon.0.id(), Signal::CONT);
        });
        assert_eq!(subscription.lost(), 0);
    }
}
