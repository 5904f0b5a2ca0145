//! Logging never ends a daemon and never fills a file system.

use std::{
    fs::{self, File, OpenOptions},
    io::Read as _,
    net::{Ipv4Addr, SocketAddr},
    os::{
        fd::OwnedFd,
        unix::fs::{PermissionsExt as _, symlink},
    },
    path::Path,
    process::{Command, Stdio},
    time::Instant,
};

use axon_tls::{
    Cipher, hybrid,
    identity::{Auth, SigningKey},
    quic::hybrid_client_with,
};
use rustix::net::{AddressFamily, SocketAddrUnix, SocketFlags, SocketType, connect, socket_with};

use super::*;
use crate::{skip::skip, support::Kept};

const NOBODY: libc::uid_t = 65534;

/// Starts a daemon in the foreground with this standard error, which logs everything.
fn foreground(host: &Host, mut command: Command, stderr: impl Into<Stdio>) -> Kept {
    let daemon = Kept(command.stderr(stderr).spawn().unwrap());
    until("the daemon answers", || host.status().is_ok());
    daemon
}

fn program(host: &Host) -> Command {
    host.command(env!("CARGO_BIN_EXE_axon_daemon"))
}

/// Opens and closes sessions, and one connection that the daemon refuses; the daemon logs each of them.
fn cause_log_lines(host: &Host) {
    for _ in 0..3 {
        let session = host.session("short").unwrap();
        session.create_publisher(spec("/t")).unwrap();
        let stranger = Address::of(&host.config()).connect().unwrap();
        let _ = socket::send(&stranger, &SessionMessage::Resync.encode().unwrap(), &[]);
    }
}

/// Makes handshakes in another protocol, which the daemon refuses and logs.
fn refused_handshakes(host: &Host) {
    let last = |status: &Status| status.refusals.iter().map(|refusal| refusal.at).max();
    let status = host.status().unwrap();
    let (before, port) = (last(&status), status.port.expect("a port of QUIC"));
    let daemon = SocketAddr::from((Ipv4Addr::LOCALHOST, port));
    let auth = Auth::None(SigningKey::generate().unwrap());
    let tls = hybrid::client_config(&auth, Cipher::default(), b"other/1").unwrap();
    let client = hybrid_client_with(tls).unwrap();
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        let endpoint = quinn::Endpoint::client((Ipv4Addr::LOCALHOST, 0).into()).unwrap();
        for _ in 0..3 {
            let connecting = endpoint.connect_with(client.clone(), daemon, "axon").unwrap();
            assert!(connecting.await.is_err(), "a protocol that the daemon does not speak");
        }
        endpoint.wait_idle().await;
    });
    until("status shows that they were refused", || {
        host.status().is_ok_and(|status| last(&status) > before)
    });
}

fn assert_it_goes_on(host: &Host, mut daemon: Kept) {
    cause_log_lines(host);
    refused_handshakes(host);
    let status = host.status().expect("the daemon answers");
    assert_eq!(status.pid, daemon.0.id());
    assert!(daemon.0.try_wait().unwrap().is_none(), "the daemon runs");
}

/// Shows that these actions are logged. Without this test, the tests below could pass although nothing is logged.
#[test]
fn the_test_actions_are_logged_to_a_regular_file() {
    let host = Host::new();
    let log = host.dir.path().join("stderr");
    let daemon = foreground(&host, program(&host), File::create(&log).unwrap());
    let lines = || fs::read_to_string(&log).unwrap().lines().count();
    let before = lines();
    cause_log_lines(&host);
    until("sessions and strangers leave lines", || lines() >= before + 6);
    let refused = || {
        let text = fs::read_to_string(&log).unwrap();
        text.lines().filter(|line| line.contains("WARN") && line.contains("127.0.0.1")).count()
    };
    assert_eq!(refused(), 0);
    refused_handshakes(&host);
    until("so do refused handshakes", || refused() > 0);
    assert_it_goes_on(&host, daemon);
}

#[test]
fn a_daemon_outlives_a_full_disk_under_its_log() {
    let host = Host::new();
    let full = OpenOptions::new().write(true).open("/dev/full").unwrap();
    assert_it_goes_on(&host, foreground(&host, program(&host), full));
}

#[test]
fn a_daemon_outlives_the_reader_of_its_standard_error() {
    let host = Host::new();
    let (reader, writer) = std::io::pipe().unwrap();
    let daemon = foreground(&host, program(&host), OwnedFd::from(writer));
    drop(reader);
    assert_it_goes_on(&host, daemon);
}

#[test]
fn a_daemon_outlives_a_limit_on_the_size_of_files() {
    let host = Host::new();
    let log = host.dir.path().join("stderr");
    // Its log file has the maximum length. Shared memory must fit in the limit: a session's takes 17 MiB, mostly
    // sparse.
    let length = 32 << 20;
    let file = File::create(&log).unwrap();
    file.set_len(length).unwrap();
    let full = OpenOptions::new().append(true).open(&log).unwrap();
    assert_it_goes_on(&host, foreground(&host, limited(&host, length / 512), full));
    assert_eq!(fs::metadata(&log).unwrap().len(), length);
}

/// Prepares a runtime directory with a log for a daemon in the background.
fn with_log(host: &Host, log: impl FnOnce(&Path)) {
    let run = host.dir.path().join("run");
    fs::create_dir(&run).unwrap();
    fs::set_permissions(&run, fs::Permissions::from_mode(0o700)).unwrap();
    log(&run.join("axon-0.log"));
}

#[test]
fn a_daemon_in_the_background_starts_though_the_file_system_of_its_log_is_full() {
    let host = Host::new();
    with_log(&host, |log| symlink("/dev/full", log).unwrap());
    let mut player = host.play("idle");
    player.hear();
    let daemon = host.status().expect("a daemon was started").pid;
    let stderr = fs::read_link(format!("/proc/{daemon}/fd/2")).unwrap();
    assert_eq!(stderr, Path::new("/dev/full"), "its log is where nothing can be written");
    cause_log_lines(&host);
    refused_handshakes(&host);
    assert_eq!(host.status().expect("it answers").pid, daemon);
    // After it was killed, the next daemon starts with the same log.
    signal(daemon, Signal::KILL);
    until("it has ended", || !host.status().is_ok_and(|status| status.pid == daemon));
    let mut next = host.play("idle");
    next.hear();
    assert_ne!(host.status().expect("a daemon was started").pid, daemon);
}

#[test]
fn daemon_that_may_not_write_ends_with_an_error_and_not_by_a_signal() {
    let host = Host::new();
    // The limit applies to files, not to pipes.
    let (mut reader, writer) = std::io::pipe().unwrap();
    let mut daemon = Kept(limited(&host, 0).stderr(writer).spawn().unwrap());
    let mut said = String::new();
    reader.read_to_string(&mut said).unwrap();
    let status = daemon.0.wait().unwrap();
    assert!(status.code().is_some_and(|code| code > 0), "{status}: {said}");
    assert!(said.contains("ulimit -f"), "what to change: {said}");
    assert!(!said.contains("panicked"), "{said}");
}

/// Returns the command of a daemon whose files may have at most `blocks` blocks.
fn limited(host: &Host, blocks: u64) -> Command {
    let mut shell = host.command("sh");
    let script = format!("ulimit -f {blocks}; exec \"$0\"");
    shell.args(["-c", &script, env!("CARGO_BIN_EXE_axon_daemon")]);
    shell
}

#[test]
fn a_daemon_in_the_background_begins_a_new_log_file_at_8_mib() {
    let host = Host::new();
    let run = host.dir.path().join("run");
    let [log, before] = ["axon-0.log", "axon-0.log.1"].map(|name| run.join(name));
    with_log(&host, |log| fs::write(log, vec![b'\n'; 8 << 20]).unwrap());
    fs::write(&before, "two files before").unwrap();
    let mut player = host.play("idle");
    player.hear();
    until("the daemon logs into a new file", || {
        fs::read_to_string(&log).is_ok_and(|text| text.len() < 8 << 20 && text.contains("daemon"))
    });
    let kept = fs::read(&before).unwrap();
    assert_eq!(kept.len(), 8 << 20, "what was logged before is kept once");
}

#[test]
fn a_flood_of_one_kind_leaves_few_lines_and_a_count() {
    let host = Host::new();
    let log = host.dir.path().join("stderr");
    let daemon = foreground(&host, program(&host), File::create(&log).unwrap());
    let address = Address::of(&host.config());
    const FLOOD: usize = 500;
    let hello = SessionMessage::Hello(SessionHello {
        protocol: PROTOCOL + 1,
        session: SessionId::random(),
        role: SessionRole::Application,
        name: "\u{202e}flood\u{1b}[2J".into(),
        domain: 0,
        settings: Vec::new(),
        relay: None,
        range: None,
        static_peers: None,
    });
    for _ in 0..FLOOD {
        let stranger = address.connect().unwrap();
        socket::send(&stranger, &hello.encode().unwrap(), &[]).unwrap();
        until("the refusal comes", || socket::receive(&stranger, &mut Vec::new()).is_ok());
    }
    let text = fs::read_to_string(&log).unwrap();
    let refused =
        text.lines().filter(|line| line.contains("PROTOCOL") || line.contains("protocol"));
    assert!((1..FLOOD / 4).contains(&refused.count()), "{text}");
    assert!(
        text.chars().all(|c| c == '\n' || axon_transport::internal::text::is_plain(c)),
        "{text:?}"
    );
    assert_it_goes_on(&host, daemon);
}

#[test]
fn endless_connections_of_another_user_leave_few_log_lines() {
    const CONNECTIONS: u64 = 3_000;
    const CAUSE: &str = "closed the connection of a user who is not in AXON_TRUSTED_UIDS";
    if !rustix::process::geteuid().is_root() {
        return skip("only root can be two users");
    }
    let host = Host::new().with("AXON_LOG", "warn");
    let log = host.dir.path().join("stderr");
    let daemon = foreground(&host, program(&host), File::create(&log).unwrap());
    // A session keeps the daemon from ending.
    let session = host.session("stays").unwrap();
    // Only the daemon itself can keep the other user out.
    let run = host.dir.path().join("run");
    let socket = run.join("axon-0.sock");
    for path in [host.dir.path(), &run, &socket] {
        fs::set_permissions(path, fs::Permissions::from_mode(0o777)).unwrap();
    }
    let address = SocketAddrUnix::new(&socket).unwrap();
    let begin = Instant::now();
    let flood = std::thread::spawn(move || {
        // SAFETY: the call has no effect on memory. The system call changes only the calling thread, unlike the
        // function of the C library, which changes the process. The thread stays the other user until it ends.
        let changed = unsafe { libc::syscall(libc::SYS_setresuid, NOBODY, NOBODY, NOBODY) };
        assert_eq!(changed, 0);
        for _ in 0..CONNECTIONS {
            let (unix, packets) = (AddressFamily::UNIX, SocketType::SEQPACKET);
            let stranger = socket_with(unix, packets, SocketFlags::CLOEXEC, None).unwrap();
            connect(&stranger, &address).unwrap();
            // Until the daemon refuses it.
            while let Ok(_) | Err(socket::SocketError::NotReady) =
                socket::receive(&stranger, &mut Vec::new())
            {
                std::thread::yield_now();
            }
        }
    });
    flood.join().unwrap();
    drop(session);
    let text = fs::read_to_string(&log).unwrap();
    let took = begin.elapsed();
    let lines = text.lines().filter(|line| line.contains(CAUSE)).count() as u64;
    eprintln!(
        "{CONNECTIONS} connections of another user in {took:?}: {lines} lines, {:.0} bytes a second",
        text.len() as f64 / took.as_secs_f64()
    );
    // Ten lines at once, and then one per second.
    assert!((1..=10 + took.as_secs() + 1).contains(&lines), "{lines} lines in {took:?}:\n{text}");
    assert!(lines < CONNECTIONS / 10, "{lines}");
    let others = text.lines().filter(|line| line.contains("WARN") && !line.contains(CAUSE)).count();
    assert!(others <= 2, "and of hardly any other cause:\n{text}");
    assert_it_goes_on(&host, daemon);
}
