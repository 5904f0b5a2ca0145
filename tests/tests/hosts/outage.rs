//! Tests KMEs that fail for a while: what the log and the status report.

use std::{
    net::{SocketAddr, TcpStream},
    os::fd::OwnedFd,
    thread::sleep,
    time::{Duration, Instant},
};

use axon_tests::Sizes;
use etsi_qkd014::sim::{Fault, FaultPlan, Method};
use rustix::net::{AddressFamily, SocketType, bind, getsockname, listen, socket};

use super::{
    mode::{Kmes, SAE},
    pair::{Host, Plan},
    process::until,
};

const SOME: u64 = 300;

fn hosts(kmes: &Kmes, key_mode: &str) -> [Host; 2] {
    let more = [("AXON_QKD_KEY_MODE", key_mode)];
    Plan::new([0, 1].map(|host| kmes.settings(host, &more))).start()
}

/// Checks that both hosts link, and that neither logs a refusal.
fn starts_without_a_refusal(key_mode: &str) {
    let kmes = Kmes::start();
    let hosts = hosts(&kmes, key_mode);
    let mut there = hosts[1].subscribe(Sizes::Small);
    let mut publisher = hosts[0].publish(Sizes::Small, 1, Some(SOME));
    there.wait_taken(publisher.wait_sent());
    for host in &hosts {
        host.link();
        let status = host.status();
        assert!(status.refusals.is_empty(), "{:?}", status.refusals);
        assert_eq!(host.log_lines(&["WARN", "refused"]), 0);
    }
}

#[test]
fn in_session_an_honest_start_records_no_refusal() {
    starts_without_a_refusal("session");
}

#[test]
fn in_messages10_an_honest_start_records_no_refusal() {
    starts_without_a_refusal("messages10");
}

/// Tests that one call fails at the KME of host `failing` until it works again.
fn is_named_once(failing: usize, call: Method, name: &str) {
    let kmes = Kmes::start();
    let hosts = hosts(&kmes, "messages10");
    let mut there = hosts[1].subscribe(Sizes::Small);
    let mut publisher = hosts[0].publish(Sizes::Small, 1, None);
    there.wait_taken(SOME);
    let (url, [own, peer]) = (kmes.url(failing), [SAE[failing], SAE[1 - failing]]);
    let fails = ["WARN", url.as_str(), name, own, peer, "fails", "503"];

    kmes.plan(failing, FaultPlan::new(Fault::Empty).on(call));
    hosts[failing].wait_log(&fails);
    let failures = |host: &Host| host.status().keys["kme"][name]["failures"].as_u64().unwrap();
    until("it fails again and again", || failures(&hosts[failing]) >= 5);
    kmes.clear_faults();
    hosts[failing].wait_log(&["INFO", &url, name, own, peer, "works again"]);
    assert_eq!(hosts[failing].log_lines(&fails), 1, "said once");
    assert_eq!(hosts[1 - failing].log_lines(&["WARN", "fails"]), 0, "and not by the other host");
    let now = publisher.published();
    there.wait_taken(now + SOME);
    let sent = publisher.stop();
    there.wait_taken(sent);
    assert_eq!(there.tally().lost, 0);
}

#[test]
fn a_kme_that_gives_no_new_keys_is_named_once() {
    is_named_once(0, Method::EncKeys, "enc_keys");
}

#[test]
fn a_kme_that_gives_no_keys_by_name_is_named_once() {
    is_named_once(1, Method::DecKeys, "dec_keys");
}

/// Tests that one call of host `failing` to its KME gets no answer. The calls after it bring keys meanwhile.
fn holds_up_no_other(failing: usize, call: Method, name: &str) {
    let kmes = Kmes::start();
    let more = [("AXON_QKD_KEY_MODE", "messages10"), ("AXON_KME_ANSWER_TIMEOUT", "10")];
    let hosts = Plan::new([0, 1].map(|host| kmes.settings(host, &more))).start();
    let mut there = hosts[1].subscribe(Sizes::Small);
    let mut publisher = hosts[0].publish(Sizes::Small, 1, None);
    there.wait_taken(SOME);
    let keys = || [kmes.keys().0, kmes.keys().1][failing];
    kmes.plan(failing, FaultPlan::new(Fault::Silence).on(call).times(1));
    let (calls, before, taken) = (kmes.calls(), keys(), there.tally().taken);
    let begin = Instant::now();
    until("other calls are answered", || kmes.calls() >= calls + 10 && keys() >= before + 50);
    there.wait_taken(taken + 1);
    let url = kmes.url(failing);
    let said = ["WARN", url.as_str(), name, "AXON_KME_ANSWER_TIMEOUT"];
    assert_eq!(hosts[failing].log_lines(&said), 0, "before the one that hangs is given up");
    eprintln!("{name}: {} keys within {:?}", keys() - before, begin.elapsed());
    hosts[failing].wait_log(&said);
    let now = publisher.published();
    there.wait_taken(now + SOME);
    let sent = publisher.stop();
    there.wait_taken(sent);
    assert_eq!(there.tally().lost, 0);
    assert_eq!(hosts[failing].log_lines(&said), 1, "said once");
}

#[test]
fn a_call_for_new_keys_that_hangs_holds_up_no_other() {
    holds_up_no_other(0, Method::EncKeys, "enc_keys");
}

#[test]
fn a_call_for_keys_by_name_that_hangs_holds_up_no_other() {
    holds_up_no_other(1, Method::DecKeys, "dec_keys");
}

/// Tests that no call to the KME of host `failing` is answered within five seconds. Messages go on afterwards.
fn hangs_as_a_whole(failing: usize, call: Method, name: &str) {
    const HANGS: Duration = Duration::from_secs(5);
    let kmes = Kmes::start();
    let hosts = hosts(&kmes, "messages10");
    let mut there = hosts[1].subscribe(Sizes::Small);
    let mut publisher = hosts[0].publish(Sizes::Small, 1, None);
    there.wait_taken(SOME);
    let url = kmes.url(failing);
    let said = ["WARN", url.as_str(), name, "AXON_KME_ANSWER_TIMEOUT"];
    // Keys that both hosts hold: ten messages each, but for the one in use.
    let ready =
        || hosts[0].status().keys["peers"][SAE[1]]["sending"]["ready"].as_u64().unwrap_or_default();
    until("there are keys in stock", || ready() >= 2);
    let before = kmes.calls_of(failing, call);
    let begin = Instant::now();
    kmes.plan(failing, FaultPlan::new(Fault::Latency(HANGS)));
    let (taken, in_stock) = (there.tally().taken, ready());
    let go_on = taken + 10 * in_stock.saturating_sub(1);
    let mut given_up = 0;
    until("a second call", || {
        given_up = hosts[failing].log_lines(&said);
        kmes.calls_of(failing, call) >= before + 2
    });
    assert_eq!(given_up, 0, "the second call does not wait for the first one's end");
    let (mut latest, mut at, mut longest) = (there.tally().taken, begin, Duration::ZERO);
    let mut watch = |taken: u64| {
        if taken > latest {
            latest = taken;
            longest = longest.max(at.elapsed());
            at = Instant::now();
        }
    };
    while begin.elapsed() < HANGS {
        watch(there.tally().taken);
        sleep(Duration::from_millis(10));
    }
    // No call is answered in time: messages went on with the keys in stock, and to the last of them.
    until("messages of the keys in stock", || there.tally().taken >= go_on);
    kmes.clear_faults();
    let after = publisher.published() + SOME;
    until("messages go on", || {
        let tally = there.tally();
        watch(tally.taken);
        tally.last >= after
    });
    eprintln!("{} messages of {in_stock} keys in stock", go_on - taken);
    eprintln!("{name} and all else hang for {HANGS:?}: longest pause of the messages {longest:?}");
    let sent = publisher.stop();
    there.wait_taken(sent);
    let tally = there.tally();
    assert_eq!((tally.taken, tally.lost), (sent, 0));
}

#[test]
fn a_kme_that_hangs_for_five_seconds_loses_nothing_where_new_keys_come_from() {
    hangs_as_a_whole(0, Method::EncKeys, "enc_keys");
}

#[test]
fn a_kme_that_hangs_for_five_seconds_loses_nothing_where_keys_come_by_name() {
    hangs_as_a_whole(1, Method::DecKeys, "dec_keys");
}

/// A socket to which no connection succeeds, as behind a firewall: some connections fill its queue, and the kernel
/// drops the first packet of others.
struct Deaf {
    address: SocketAddr,
    _socket: OwnedFd,
    _queued: Vec<TcpStream>,
}

impl Deaf {
    fn new() -> Self {
        let listener = socket(AddressFamily::INET, SocketType::STREAM, None).unwrap();
        bind(&listener, &SocketAddr::from(([127, 0, 0, 1], 0))).unwrap();
        listen(&listener, 0).unwrap();
        let address = getsockname(&listener).unwrap().try_into().unwrap();
        let mut queued = Vec::new();
        while let Ok(stream) = TcpStream::connect_timeout(&address, Duration::from_millis(500)) {
            queued.push(stream);
        }
        Self { address, _socket: listener, _queued: queued }
    }
}

/// The peer takes all that there are keys for. It does not read slowly, and no topic to it is cut.
#[test]
fn a_kme_that_gives_no_keys_for_long_cuts_no_topic() {
    const STALLED: &str = "2";
    let kmes = Kmes::start();
    let more = [("AXON_QKD_KEY_MODE", "messages10"), ("AXON_LINK_STALLED_S", STALLED)];
    let hosts = Plan::new([0, 1].map(|host| kmes.settings(host, &more))).start();
    let mut there = hosts[1].subscribe(Sizes::Small);
    let mut publisher = hosts[0].publish(Sizes::Small, 1, None);
    there.wait_taken(SOME);
    kmes.plan(0, FaultPlan::new(Fault::Empty).on(Method::EncKeys));
    let sending = || hosts[0].status().keys["peers"][SAE[1]]["sending"].clone();
    let is_out = |keys: &serde_json::Value| keys["ready"] == 0 && keys["announced"] == 0;
    // A call that the fault did not reach may bring keys yet, and sealed messages are on their way.
    let mut taken = there.tally().taken;
    until("all keys are used up, and what was sealed has arrived", || {
        let before = taken;
        sleep(Duration::from_secs(1));
        taken = there.tally().taken;
        is_out(&sending()) && taken == before
    });
    // The history is full long before, and its publisher waits.
    sleep(4 * Duration::from_secs(STALLED.parse().unwrap()));
    assert!(is_out(&sending()));
    assert_eq!(there.tally().taken, taken, "without a key nothing crosses");
    kmes.clear_faults();
    let now = publisher.published();
    there.wait_taken(now + SOME);
    let sent = publisher.stop();
    there.wait_taken(sent);
    assert_eq!(there.tally().lost, 0);
    let link = hosts[0].link();
    assert_eq!(link.dropped.get("stalled"), None, "{:?}", link.dropped);
    assert_eq!(hosts[0].log_lines(&["stalled_s"]), 0);
}

#[test]
fn a_kme_that_accepts_no_connection_is_given_up_at_the_limit_for_connecting() {
    let kmes = Kmes::start();
    let deaf = Deaf::new();
    let url = format!("https://{}", deaf.address);
    // A client that waited for an answer would log that, and name that setting.
    let limits = [("AXON_KME_CONNECT_TIMEOUT", "1"), ("AXON_KME_ANSWER_TIMEOUT", "10")];
    let of_deaf = [limits[0], limits[1], ("AXON_KME_URL", url.as_str())];
    let hosts = Plan::new([kmes.settings(0, &of_deaf), kmes.settings(1, &limits)]).start();
    hosts[0].wait_log(&[
        "WARN",
        &url,
        "enc_keys",
        SAE[0],
        SAE[1],
        "fails",
        "AXON_KME_CONNECT_TIMEOUT",
    ]);
    let failures = || hosts[0].status().keys["kme"]["enc_keys"]["failures"].as_u64().unwrap();
    until("it is tried again", || failures() >= 2);
    assert_eq!(hosts[0].log_lines(&["WARN", "AXON_KME_ANSWER_TIMEOUT"]), 0, "no call got so far");
    assert!(hosts[0].is_first_daemon() && hosts[0].status().links.is_empty());
}
