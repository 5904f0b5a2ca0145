//! The address at which sessions and their daemon meet, also if another user has interfered with it.

use std::os::{fd::OwnedFd, unix::fs::PermissionsExt as _};

use rustix::{
    net::{
        AddressFamily, SocketAddrUnix, SocketFlags, SocketType, accept, bind, listen, socket_with,
    },
    process::Uid,
    thread::set_thread_uid,
};

use super::{
    life::{counting, started},
    *,
};

/// A host without a runtime directory: its sessions use an abstract name, in a domain that no other test uses.
fn host(domain: &str) -> Host {
    Host::new().without("AXON_RUNTIME_DIR").with("ROS_DOMAIN_ID", domain)
}

/// Adds the runtime directory of a login to the host.
fn with_login(host: Host) -> Host {
    let login = host.dir.path().join("login");
    std::fs::create_dir_all(&login).unwrap();
    std::fs::set_permissions(&login, std::fs::Permissions::from_mode(0o700)).unwrap();
    host.with("XDG_RUNTIME_DIR", login.to_str().unwrap())
}

/// Binds the abstract name of a host's daemon, but does not listen there.
fn squat(host: &Host) -> OwnedFd {
    bind_name(&Address::of(&host.config()).to_string())
}

fn bind_name(address: &str) -> OwnedFd {
    let name = address.strip_prefix('@').expect("an abstract name");
    let flags = SocketFlags::CLOEXEC;
    let socket = socket_with(AddressFamily::UNIX, SocketType::SEQPACKET, flags, None).unwrap();
    bind(&socket, &SocketAddrUnix::new_abstract_name(name.as_bytes()).unwrap()).unwrap();
    socket
}

#[test]
fn bound_abstract_name_without_a_runtime_directory_is_reported() {
    let host = counting(host("183"));
    let _squatter = squat(&host);
    let said = host.play("idle").hear();
    assert!(said.contains("XDG_RUNTIME_DIR") && said.contains("serves no session"), "{said}");
    // Attempts are half a second apart. A session that kept trying would start one daemon after another for 20 s.
    assert_eq!(started(&host), 5, "a daemon finds the name taken");
}

#[test]
fn abstract_name_of_another_user_is_an_error_with_the_owner() {
    const NOBODY: u32 = 65534;
    if !rustix::process::geteuid().is_root() {
        return skip::skip("only root can be two users");
    }
    let host = host("188");
    // The address contains the id of this user.
    let address = Address::of(&host.config()).to_string();
    // The kernel records the user of the thread that listens.
    let listener = std::thread::scope(|scope| {
        let other_user = scope.spawn(|| {
            set_thread_uid(Uid::from_raw(NOBODY)).unwrap();
            let socket = bind_name(&address);
            rustix::io::ioctl_fionbio(&socket, true).unwrap();
            listen(&socket, 8).unwrap();
            socket
        });
        other_user.join().unwrap()
    });
    let said = host.play("idle").hear();
    assert!(said.contains("belongs to uid 65534") && said.contains("XDG_RUNTIME_DIR"), "{said}");
    let calls = std::iter::from_fn(|| accept(&listener).ok()).count();
    assert_eq!(calls, 1, "another try would meet the same user");
    drop(listener);
    let daemon = host.play("idle").hear();
    assert!(daemon.len() == 32, "{daemon}");
}

#[test]
fn a_bound_name_keeps_no_session_from_the_runtime_directory_of_its_login() {
    let host = host("184");
    let _squatter = squat(&host);
    let host = with_login(host);
    run_pair(&host, |_| {
        let socket = host.status().unwrap().socket;
        assert!(socket.contains("/login/axon/"), "{socket}");
    });
}

#[test]
fn sessions_with_and_without_a_runtime_directory_meet_at_one_daemon() {
    for first_has_one in [true, false] {
        let domain = if first_has_one { "185" } else { "186" };
        let (bare, login) = (host(domain), with_login(host(domain)));
        let mut hosts = [&login, &bare];
        if !first_has_one {
            hosts.reverse();
        }
        let mut players = hosts.map(|host| host.play("idle"));
        let daemons = players.each_mut().map(Player::hear);
        assert_eq!(daemons[0], daemons[1], "one daemon for both");
    }
}

#[test]
fn a_runtime_directory_of_another_user_is_left_alone() {
    if !rustix::process::geteuid().is_root() {
        return skip::skip("only root can be two users");
    }
    let host = with_login(host("187"));
    let login = host.dir.path().join("login");
    std::os::unix::fs::chown(&login, Some(65534), Some(65534)).unwrap();
    std::fs::create_dir(login.join("axon")).unwrap();
    std::os::unix::fs::chown(login.join("axon"), Some(65534), Some(65534)).unwrap();
    let said = host.play("idle").hear();
    assert!(said.len() == 32 && said.bytes().all(|b| b.is_ascii_hexdigit()), "{said}");
    assert_eq!(std::fs::read_dir(login.join("axon")).unwrap().count(), 0);
}

#[test]
fn runtime_directory_of_another_user_is_an_error_with_the_owner() {
    if !rustix::process::geteuid().is_root() {
        return skip::skip("only root can be two users");
    }
    let host = Host::new();
    let named = host.dir.path().join("of_nobody");
    std::fs::create_dir(&named).unwrap();
    std::os::unix::fs::chown(&named, Some(65534), Some(65534)).unwrap();
    let host = host.with("AXON_RUNTIME_DIR", named.to_str().unwrap());
    let said = host.play("idle").hear();
    assert!(said.contains("belongs to uid 65534") && said.contains("of_nobody"), "{said}");
    let left: Vec<_> = std::fs::read_dir(&named).unwrap().map(|e| e.unwrap().path()).collect();
    assert!(left.is_empty(), "{left:?}");
}

#[test]
fn a_session_in_a_pid_namespace_with_the_outer_proc_shares_memory_with_its_daemon() {
    let host = Host::new();
    let own = std::env::current_exe().unwrap();
    let within = |program: &str| {
        let mut unshare = host.command("unshare");
        unshare.args(["--pid", "--fork", "--kill-child", program]);
        unshare
    };
    match within("true").status() {
        Ok(status) if status.success() => {}
        other => return skip::skip(format_args!("no PID namespace here: {other:?}")),
    }
    let mut player = host.play_in(within(own.to_str().unwrap()), "idle");
    let said = player.hear();
    let status = host.status().unwrap();
    assert_eq!(said, status.daemon);
    assert!(status.refusals.is_empty(), "{:?}", status.refusals);
    assert!(status.sessions.iter().all(|s| s.relay.is_none()), "{:?}", status.sessions);
}
