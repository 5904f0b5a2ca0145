//! A daemon without descriptors for another session: the refused session is told why and what to set, existing sessions
//! go on, and no process takes the share of others.

use axon_transport::{
    ids::SessionId,
    internal::{
        session::daemon::address::Address,
        wire::session::{PROTOCOL, SessionHello, SessionMessage, SessionRole},
    },
};
use rustix::process::{Pid, Resource, Rlimit, Signal, WaitId, WaitIdOptions, prlimit, waitid};

use crate::{
    reluctant::{hiding, send_away},
    spec,
    support::{Host, Kept, PATIENCE, Player, signal, until},
};

fn limit(daemon: &Kept, files: u64) {
    let limit = Rlimit { current: Some(files), maximum: Some(1024) };
    prlimit(Some(Pid::from_child(&daemon.0)), Resource::Nofile, limit).unwrap();
}

/// Starts processes with one session each until one is refused. Returns the processes that are served, and the error
/// that the last one got.
fn crowd(host: &Host, most: usize) -> (Vec<Player>, String) {
    let mut served = Vec::new();
    loop {
        let mut player = host.play("one session");
        let said = player.hear();
        if said != "served" {
            return (served, said);
        }
        served.push(player);
        assert!(served.len() < most, "{most} sessions are served");
    }
}

fn host() -> Host {
    Host::new().with("AXON_DAEMON", "require")
}

/// Checks that a refused session is told what it has to know.
fn is_told(said: &str, limit: u64) {
    for part in [&*format!("of its {limit} "), "RLIMIT_NOFILE", "ulimit -n", "LimitNOFILE"] {
        assert!(said.contains(part), "{said} lacks {part:?}");
    }
}

#[test]
fn session_beyond_the_descriptor_limit_is_told_the_numbers_and_the_setting() {
    let host = host();
    let daemon = host.daemon();
    limit(&daemon, 256);
    let (mut served, said) = crowd(&host, 64);
    is_told(&said, 256);
    // Of 256 descriptors, a session takes four; the gateway needs none for it.
    assert!(served.len() >= 32, "{} sessions are served", served.len());

    let status = host.status().expect("a tool is served");
    let descriptors = status.descriptors.expect("they are counted");
    assert_eq!((descriptors.limit, descriptors.sessions_refused), (Some(256), 1));
    assert!(descriptors.open < 256, "{descriptors:?}");
    let refusals = status.refusals.iter().filter(|refusal| refusal.reason == said_here(&said));
    assert_eq!(refusals.count(), 1, "{:?}", status.refusals);
    let log = std::fs::read_to_string(host.log()).unwrap();
    assert!(log.contains("LimitNOFILE"), "the log says it as well");

    // The served sessions see each other, and one that ends makes room.
    served[0].go();
    assert_eq!(served[0].hear(), "everybody is there");
    served.pop().unwrap().finish();
    until("there is room", || {
        let mut player = host.play("one session");
        player.hear() == "served"
    });
}

#[test]
fn daemon_takes_as_many_descriptors_as_its_hard_limit_allows() {
    let host = host();
    let mut shell = host.command("sh");
    shell.args(["-c", "ulimit -S -n 64 && ulimit -H -n 512 && exec \"$0\""]);
    shell.arg(env!("CARGO_BIN_EXE_axon_daemon"));
    let _daemon = host.daemon_by(shell);
    let descriptors = host.status().expect("a tool is served").descriptors;
    assert_eq!(descriptors.expect("they are counted").limit, Some(512));
    // A session takes four descriptors, so the soft limit of 64 would not suffice for these.
    let _served: Vec<Player> = (0..24)
        .map(|_| {
            let mut player = host.play("one session");
            assert_eq!(player.hear(), "served");
            player
        })
        .collect();
}

/// Returns the daemon's words in an error of the session.
fn said_here(said: &str) -> &str {
    said.split_once("refuses the session: ").expect("refused").1
}

#[test]
fn process_with_many_sessions_leaves_the_others_their_share() {
    let host = host();
    let daemon = host.daemon();
    limit(&daemon, 256);
    let mut greedy = host.play("many sessions");
    let said = greedy.hear();
    is_told(&said, 256);
    assert!(said.contains("its process"), "{said}");
    let mut others = [(); 5].map(|()| host.play("one session"));
    others.iter_mut().for_each(|player| assert_eq!(player.hear(), "served"));
    // Another process that wants everything gets less, and a third one is still served.
    let mut second = host.play("many sessions");
    assert!(second.hear().contains("its process"));
    assert_eq!(host.play("one session").hear(), "served");
}

#[test]
fn limit_below_open_descriptors_refuses_new_sessions_and_keeps_existing_sessions() {
    let host = host();
    let daemon = host.daemon();
    let (mut first, second) = (host.play("one session"), host.play("one session"));
    assert_eq!(first.hear(), "served");
    let mut players = [second, host.play("one session")];
    players.iter_mut().for_each(|player| assert_eq!(player.hear(), "served"));
    let here = host.session("witness").unwrap();
    limit(&daemon, 30);
    for _ in 0..3 {
        is_told(&host.play("one session").hear(), 30);
    }
    let status = host.status().expect("a tool is served");
    assert_eq!(status.descriptors.expect("counted").limit, Some(30));
    // Operations that need no descriptor of the daemon go on.
    let subscription = here.create_subscription(spec("/crowd")).unwrap();
    first.go();
    assert_eq!(first.hear(), "everybody is there");
    first.go();
    let mut bytes = Vec::new();
    assert!(subscription.recv(&mut bytes, Some(PATIENCE)).is_ok(), "a new pair is made");
    limit(&daemon, 1024);
    assert_eq!(host.play("one session").hear(), "served");
    players.into_iter().for_each(Player::finish);
    first.finish();
}

/// A refused caller sends descriptors that are slow to close. The descriptors that the daemon reserves for callers stay
/// free.
#[test]
fn descriptors_of_callers_that_are_refused_are_not_received() {
    let host = host();
    let daemon = host.daemon();
    limit(&daemon, 256);
    let (mut served, _) = crowd(&host, 64);
    let hello = SessionMessage::Hello(SessionHello {
        protocol: PROTOCOL,
        session: SessionId([9; 16]),
        role: SessionRole::Application,
        name: "reluctant".into(),
        domain: 0,
        settings: Vec::new(),
        relay: None,
        range: Some(0),
        static_peers: None,
    });
    let (hello, unknown) = (hello.encode().unwrap(), [200, 0xa0]);
    let mut kept = Vec::new();
    // The daemon receives nothing before everything has been sent; otherwise the last close could be this thread's.
    signal(daemon.0.id(), Signal::STOP);
    let pid = Pid::from_child(&daemon.0);
    waitid(WaitId::Pid(pid), WaitIdOptions::STOPPED).unwrap();
    // More than the daemon has closing threads, and more than it reserves for callers.
    for packet in [&hello[..], &unknown].into_iter().cycle().take(100) {
        let Ok(stranger) = Address::of(&host.config()).connect() else { continue };
        let (fd, peer) = hiding();
        send_away(&stranger, packet, 7, fd);
        kept.push((peer, stranger));
    }
    signal(daemon.0.id(), Signal::CONT);
    let served_last = served.pop().unwrap();
    // The served sessions go on meanwhile. A new one has to wait, because closes block.
    served[0].go();
    assert_eq!(served[0].hear(), "everybody is there");
    let open = || std::fs::read_dir(format!("/proc/{}/fd", daemon.0.id())).unwrap().count();
    assert!(open() < 230, "{} are open", open());
    drop(kept);
    until("a tool is served", || host.status().is_ok());
    served_last.finish();
    until("there is room", || host.play("one session").hear() == "served");
    served.into_iter().for_each(Player::finish);
}

#[test]
fn session_whose_own_process_has_no_descriptors_is_told_that_it_is_its_own() {
    let host = host();
    let _daemon = host.daemon();
    let mut poor = host.play("no descriptors");
    loop {
        let said = poor.hear();
        if said == "served" {
            break;
        }
        assert!(said.contains("this process") && said.contains("ulimit -n"), "{said}");
        assert!(!said.contains("no daemon listens") && !said.contains("daemon's limit"), "{said}");
    }
    poor.finish();
    assert!(host.status().unwrap().refusals.is_empty(), "the daemon has room");
}
