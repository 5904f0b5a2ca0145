//! Checks that the examples of axon-transport do what they claim.

#[path = "../../tests/support/built_examples.rs"]
mod built_examples;
#[allow(dead_code, reason = "not every test needs all of it")]
mod support;

use std::{
    path::{Path, PathBuf},
    process::{Command, Stdio},
};

use built_examples::built_examples;
use support::{Host, Kept};

const EXAMPLES: [&str; 6] = ["session", "service", "wait_set", "loan", "two_hosts", "tokio"];

/// Returns the program of an example.
fn example(name: &str) -> PathBuf {
    let package = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    built_examples(package, &EXAMPLES, &EXAMPLES).join(name)
}

/// Runs a command, which must succeed, and returns its output.
fn run(command: &mut Command) -> String {
    let output = command.stderr(Stdio::inherit()).output().unwrap();
    let printed = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success(), "{command:?}: {}\n{printed}", output.status);
    printed
}

#[test]
fn examples_of_one_process_need_no_daemon() {
    // On a host where no daemon can be started.
    let host = Host::new().with("AXON_DAEMON_PATH", "/dev/null");
    let printed = |name| run(&mut host.command(example(name)));
    assert_eq!(printed("service"), "17 bytes\n");
    assert_eq!(printed("wait_set"), "speed: 1.5 m/s\nhalt: at once\n");
    assert_eq!(printed("loan"), "image 1: 307200 bytes, mean 120.0\n");
    assert_eq!(printed("tokio"), "POST\nQUANTUM\n");
}

#[test]
fn the_session_uses_the_daemon_of_its_user() {
    let host = Host::new().with("AXON_DAEMON", "require");
    let _daemon = host.daemon();
    let printed = run(&mut host.command(example("session")));
    assert_eq!(printed, "1: greeting 1\n2: greeting 2\n3: greeting 3\n");
}

#[test]
fn the_two_hosts_meet() {
    let pid = std::process::id();
    let address = |host: u32| format!("127.{}.{}.{host}", 230 + pid / 250 % 20, 1 + pid % 250);
    // Below 100: the daemons of other tests are above.
    let domain = (1 + pid % 98).to_string();
    let hosts = [1, 2].map(|host| {
        Host::new()
            .without("ROS_AUTOMATIC_DISCOVERY_RANGE")
            .with("AXON_BIND_ADDRS", &address(host))
            .with("AXON_DAEMON_PEERS", &address(3 - host))
            .with("ROS_DOMAIN_ID", &domain)
            .with("AXON_DAEMON", "require")
    });
    let _daemons = hosts.each_ref().map(Host::daemon);
    let [talker, listener] = hosts.each_ref().map(|host| host.command(example("two_hosts")));
    let mut talking = { talker }.arg("talk").stdout(Stdio::null()).spawn().map(Kept).unwrap();
    assert_eq!(run({ listener }.arg("listen")), "heard hello 1\nheard hello 2\nheard hello 3\n");
    assert!(talking.0.wait().unwrap().success());
}
