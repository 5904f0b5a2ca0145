//! `play` on one host, `echo` on another.

#![forbid(unsafe_code)]

mod common;

use common::{Echoes, Host, LOG, Running, eventually};
use rustix::process::Signal;

/// Messages of the log.
const MESSAGES: u64 = 3 * 1_988;

fn play(host: &Host, rate: &str) -> Running {
    play_with(host, rate, "keep-all")
}

fn play_with(host: &Host, rate: &str, qos: &str) -> Running {
    Running::start(host.axon(&["play", LOG, "--rate", rate, "--wait", "1", "--qos", qos]))
}

/// Starts an `echo` with these policies for each topic of the log, which stays.
fn echo_all(host: &Host, qos: &str) -> [Running; 3] {
    ["/scan", "/odom", "/tf"]
        .map(|topic| Running::start(host.axon(&["echo", topic, "--qos", qos, "--json"])))
}

/// Returns the exit status and the standard error.
fn outcome(play: Running) -> (Option<i32>, String) {
    let output = play.finish();
    (output.status.code(), String::from_utf8(output.stderr).expect("UTF-8"))
}

#[test]
fn play_waits_until_the_other_host_has_every_message() {
    let [a, b] = Host::pair();
    let echoes = Echoes::start(&b);
    let (code, said) = outcome(play(&a, "0"));
    assert_eq!(code, Some(0), "{said}");
    assert!(said.contains("5,964 acknowledged"), "{said}");
    echoes.assert_whole();
}

/// Their depth decides what they get: no promise is broken, and none is claimed to be kept.
#[test]
fn nothing_is_called_acknowledged_where_no_subscription_keeps_all() {
    for (qos, kind) in [
        ("default", "3 subscriptions keep the last messages only (KEEP_LAST)"),
        ("sensor-data", "3 subscriptions are best effort"),
    ] {
        let [a, b] = Host::pair();
        let _echoes = echo_all(&b, qos);
        let (code, said) = outcome(play(&a, "0"));
        assert_eq!(code, Some(0), "{said}");
        assert!(said.contains("; 0 acknowledged"), "{said}");
        assert!(said.contains(&format!("{kind}: messages may be missing there")), "{said}");
    }
}

#[test]
fn play_with_a_lossy_qos_profile_reports_no_acknowledgements() {
    for qos in ["default", "sensor-data"] {
        let [a, b] = Host::pair();
        let _echoes = echo_all(&b, qos);
        let (code, said) = outcome(play_with(&a, "0", qos));
        assert_eq!(code, Some(0), "{said}");
        assert!(said.contains(&format!("--qos {qos} waits for no reader")), "{said}");
        assert!(!said.contains("acknowledged"), "{said}");
        assert!(said.contains("messages may be missing there"), "{said}");
    }
}

/// The subscription that keeps all has every message, whatever the one beside it misses.
#[test]
fn a_subscription_of_another_profile_takes_no_acknowledgement_away() {
    let [a, b] = Host::pair();
    let echoes = Echoes::start(&b);
    let _last = echo_all(&b, "default");
    let play = Running::start(a.axon(&["play", LOG, "--rate", "0", "--wait", "2"]));
    let (code, said) = outcome(play);
    assert_eq!(code, Some(0), "{said}");
    assert!(said.contains("5,964 acknowledged"), "{said}");
    assert!(said.contains("3 subscriptions keep the last messages only"), "{said}");
    echoes.assert_whole();
}

#[test]
fn play_fails_where_the_other_host_takes_nothing_more() {
    let [a, b] = Host::pair();
    let _echoes = Echoes::start(&b);
    let play = play(&a, "60");
    eventually("the middle of the replay", || a.published() > 500);
    let there = b.wait_daemon();
    signal(there, Signal::STOP);
    assert!(a.published() < MESSAGES, "it was stopped after the replay, which shows nothing");
    let (code, said) = outcome(play);
    signal(there, Signal::CONT);
    assert_eq!(code, Some(1), "{said}");
    // The link is given up after 120 s without a sign of life, which may be first.
    let unheard = ["messages were not acknowledged, none of them for 15 s", "were given up"];
    assert!(unheard.iter().any(|why| said.contains(why)), "{said}");
}

/// The next daemon sends the messages of the killed one. Until it runs the publisher has no subscription. `play`
/// reports that, although these messages arrive, too.
#[test]
fn no_message_is_lost_with_the_daemon_of_play() {
    let [a, b] = Host::pair();
    let echoes = Echoes::start(&b);
    let play = play(&a, "60");
    eventually("the middle of the replay", || a.published() > 500);
    let there = b.wait_daemon();
    signal(there, Signal::STOP);
    let stopped = a.published();
    eventually("more is under way", || a.published() > stopped + 100);
    signal(a.wait_daemon(), Signal::KILL);
    signal(there, Signal::CONT);
    let (code, said) = outcome(play);
    assert!(!said.contains("were given up"), "{said}");
    assert_eq!(code, Some(i32::from(said.contains("found fewer subscriptions"))), "{said}");
    echoes.assert_whole();
}

/// No message is in flight when the other host's subscriptions leave, so none is given up.
#[test]
fn play_fails_where_the_subscriptions_that_it_waited_for_leave() {
    let [a, b] = Host::pair();
    let echoes = Echoes::start(&b);
    let play = play(&a, "60");
    eventually("the middle of the replay", || a.published() > 500);
    drop(echoes);
    let (code, said) = outcome(play);
    assert_eq!(code, Some(1), "{said}");
    assert!(said.contains("messages found fewer subscriptions than --wait asks for"), "{said}");
    let count = said.split_once(" acknowledged").and_then(|(before, _)| before.rsplit_once("; "));
    let count: u64 = count.expect("a count").1.replace(',', "").parse().expect("a number");
    assert!((500..MESSAGES).contains(&count), "{said}");
}

fn signal(pid: i32, signal: Signal) {
    let pid = rustix::process::Pid::from_raw(pid).expect("a process id");
    rustix::process::kill_process(pid, signal).expect("it is there");
}
