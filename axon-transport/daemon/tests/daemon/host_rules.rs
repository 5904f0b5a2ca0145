//! The access rules of the host: each daemon obeys them, whichever process started it.

use super::*;
use crate::skip::skip;

const RULES: &str = "[[allow]]\npeer = \"*\"\npublish = \"/allowed\"\n";
const FILE: &str = "/etc/axon/access.toml";

/// Returns a command that runs a program with its own `/etc`, which contains these rules.
fn with_rules(host: &Host, rules: &str, program: &str) -> std::process::Command {
    const SCRIPT: &str = "mount --make-rprivate / && mount -t tmpfs none /etc && mkdir /etc/axon && \
        printf %s \"$RULES\" >/etc/axon/access.toml && exec \"$@\"";
    let mut unshare = host.command("unshare");
    if !rustix::process::geteuid().is_root() {
        unshare.arg("-r");
    }
    unshare.args(["-m", "sh", "-c", SCRIPT, "sh", program]).env("RULES", rules);
    unshare
}

fn can_have_rules(host: &Host) -> bool {
    match with_rules(host, RULES, "true").status() {
        Ok(status) if status.success() => return true,
        Ok(status) => skip(format_args!("no mount namespace here: {status}")),
        Err(error) => skip(format_args!("no unshare: {error}")),
    }
    false
}

/// Starts a session of a process whose environment names no rules.
fn idle(host: &Host, rules: &str) -> Player {
    let own = std::env::current_exe().unwrap();
    host.play_in(with_rules(host, rules, own.to_str().unwrap()), "idle")
}

fn assert_ruled(status: &Status) {
    assert_eq!(status.settings.get("AXON_ACCESS_FILE").map(String::as_str), Some(FILE));
    let rules = axon_transport::access::AccessRules::parse(RULES, "access.toml").unwrap();
    assert_eq!(status.access_digest, rules.digest());
}

#[test]
fn successor_of_a_killed_daemon_has_the_rules_of_the_host() {
    let host = Host::new();
    if !can_have_rules(&host) {
        return;
    }
    let mut player = idle(&host, RULES);
    player.hear();
    let first = host.status().unwrap();
    assert_ruled(&first);
    signal(first.pid, Signal::KILL);
    let mut next = None;
    until("another daemon serves the session", || {
        next = host.status().ok().filter(|status| status.pid != first.pid);
        next.is_some()
    });
    assert_ruled(&next.unwrap());
    player.finish();
}

#[test]
fn a_daemon_of_another_domain_has_the_rules_of_the_host() {
    let host = Host::new();
    if !can_have_rules(&host) {
        return;
    }
    let mut first = idle(&host, RULES);
    first.hear();
    let run = host.dir.path().join("run").display().to_string();
    let other = Host::new().with("AXON_RUNTIME_DIR", &run).with("ROS_DOMAIN_ID", "1");
    let mut second = idle(&other, RULES);
    second.hear();
    let [first_status, second_status] = [&host, &other].map(|host| host.status().unwrap());
    assert_ne!(first_status.pid, second_status.pid);
    [first_status, second_status].iter().for_each(assert_ruled);
    first.finish();
    second.finish();
}

#[test]
fn rules_of_the_host_that_cannot_be_used_let_no_daemon_start() {
    let host = Host::new();
    if !can_have_rules(&host) {
        return;
    }
    let mut player = idle(&host, "[[allow]]\npeer = 7\n");
    let said = player.hear();
    assert!(said.contains(FILE) && said.contains("line 2, column 8"), "{said}");
    player.finish();
    assert!(host.status().is_err());
}
