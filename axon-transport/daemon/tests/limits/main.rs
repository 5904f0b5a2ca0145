//! Limits of the system, and interruptions at critical points: the result is an error that names
//! what is short, or a delay. No other process fails.

mod child;
mod crowded;
mod elevated;
#[path = "../support/group.rs"]
mod group;
mod interrupted;
#[path = "../support/reluctant.rs"]
mod reluctant;
#[path = "../support/skip.rs"]
mod skip;
#[path = "../support/mod.rs"]
mod support;

use std::{
    fs,
    io::Write as _,
    os::unix::{fs::MetadataExt as _, net::UnixDatagram, process::CommandExt as _},
    path::{Path, PathBuf},
    process::Stdio,
    time::Duration,
};

use axon_shm::{ConnectError, Context, Publisher, PublisherOptions, ShmError};
use axon_transport::{
    EndpointSpec,
    internal::session::daemon::address::Address,
    qos::{Durability, Qos},
};
use group::Group;
use rustix::process::{Resource, Rlimit};
use skip::skip;
use support::{Host, PATIENCE, until};

fn spec(topic: &str) -> EndpointSpec {
    EndpointSpec::new(topic, "test/Bytes", Qos::keep_all())
}

/// Keeps samples that are published before a subscription joins.
fn latched(topic: &str) -> EndpointSpec {
    let qos = Qos::keep_all().with_durability(Durability::TransientLocal);
    EndpointSpec::new(topic, "test/Bytes", qos)
}

/// Keeps the newest samples that are read in place for late joiners.
fn image() -> EndpointSpec {
    let qos = Qos::default().with_durability(Durability::TransientLocal);
    EndpointSpec::new("/image", "test/Bytes", qos)
}

/// Lists the targets of a process's descriptors.
fn descriptors(process: &str) -> String {
    let entries = fs::read_dir(format!("/proc/{process}/fd")).unwrap();
    let links = entries.filter_map(|entry| {
        let number = entry.ok()?.path();
        let to = fs::read_link(&number).ok()?;
        // Not the descriptor that reads this directory.
        let other = !to.starts_with("/proc");
        other.then(|| format!("{} {}", number.file_name().unwrap().display(), to.display()))
    });
    let mut links: Vec<String> = links.collect();
    links.sort();
    links.join(", ")
}

/// Creates one end of a socket between a test and its child; `first` is the test's.
fn meet(name: &str, first: bool) -> UnixDatagram {
    let path = |end: bool| PathBuf::from(format!("{name}.{}", u8::from(end)));
    let socket = UnixDatagram::bind(path(first)).unwrap();
    until("the other end is there", || socket.connect(path(!first)).is_ok());
    socket
}

fn at(host: &Host, name: &str) -> String {
    host.dir.path().join(name).to_str().unwrap().to_owned()
}

/// The code of the children of the tests. It does nothing in a run of the tests themselves.
#[test]
fn child() {
    if let Ok(part) = std::env::var("PLAY") {
        child::play(&part);
    }
}

/// Returns the number of blocks of shared memory to which this process has descriptors.
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
        return skip(said);
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
        // Each publisher has its own context, because a context is what makes a peer take
        // descriptors.
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
fn session_with_too_much_memory_is_told_once_and_stays() {
    let host = Host::new();
    let daemon = host.daemon();
    // The session asks for 150, and gets half of what is left.
    let few = Rlimit { current: Some(300), maximum: Some(300) };
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
    assert!(first.recv(&mut bytes, Some(PATIENCE)).is_ok(), "what the daemon has is seen");
    much.go();
    assert!(first.recv(&mut bytes, Some(PATIENCE)).is_ok());
    assert_eq!((&bytes[..], told("RLIMIT_NOFILE")), (&b"small"[..], 1));
    // The session was never disconnected.
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
        assert!(subscription.recv(&mut bytes, Some(PATIENCE)).is_ok());
    }
    many.finish();
}

#[test]
fn a_publisher_at_the_limit_of_its_control_group_is_refused_and_not_killed() {
    let group = match Group::new(64 << 20) {
        Ok(group) => group,
        Err(why) => return skip(why),
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
fn exec_releases_all_but_the_read_samples() {
    let host = Host::new();
    let _daemon = host.daemon();
    let session = host.session("camera").unwrap();
    let publisher = session.create_publisher(image()).unwrap();
    let publish = || {
        let mut loan = publisher.loan(100_000).unwrap();
        loan.fill(7);
        let at = loan.as_ptr().addr();
        loan.publish().unwrap();
        at
    };
    let held = publish();
    // So many samples that each location is used again unless it is held.
    let comes_again = || (0..100).any(|_| publish() == held);
    let mut former = host.play("successor");
    let before = former.hear();
    assert_eq!(former.hear(), "holds");
    assert!(!comes_again(), "a sample was written over while it was read");
    assert!(publisher.wait_matched(1, PATIENCE));
    assert!(session.wait_graph(PATIENCE, |graph| graph.endpoints.len() == 3));
    former.go();

    let pid = former.pid().to_string();
    let name = Path::new("/proc").join(&pid).join("comm");
    until("it is another program", || fs::read(&name).is_ok_and(|name| name == b"sleep\n"));
    until("it has what it had before its session", || descriptors(&pid) == before);
    assert!(session.wait_graph(PATIENCE, |graph| graph.endpoints.len() == 1));
    until("it is no reader", || publisher.matched().is_empty());
    assert!(!comes_again(), "its memory was given back before its process ended");
    drop(former);
    until("the sample's place is free", comes_again);
}

#[test]
fn another_user_is_not_heard() {
    if !rustix::process::geteuid().is_root() {
        return skip("only root can be two users");
    }
    // The abstract name is unique per user and domain, so the test uses a domain of its own.
    let host = Host::new().without("AXON_RUNTIME_DIR").with("ROS_DOMAIN_ID", "171");
    let _daemon = host.daemon();
    let name = Address::of(&host.config()).to_string();
    let name = name.strip_prefix('@').expect("an abstract name");
    // In a folder from which another user can run it.
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
fn a_forked_child_can_have_a_context_of_its_own() {
    let context = Context::new().unwrap();
    // SAFETY: the child only creates and drops a context, and leaves by _exit.
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
