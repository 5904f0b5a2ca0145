//! `axon acl learn` between two hosts: what it writes lets all go on that it saw, and nothing else.

#![forbid(unsafe_code)]

mod common;

use std::{
    fs,
    io::{BufRead as _, BufReader, Read as _},
    path::PathBuf,
    process::ChildStderr,
    time::Duration,
};

use axon_transport::{EndpointSpec, Publisher, Session, Subscription, qos::Qos};
use common::{Host, Running, eventually};
use rustix::process::{Pid, Signal, kill_process};

fn spec(topic: &str) -> EndpointSpec {
    EndpointSpec::new(topic, "test/Bytes", Qos::keep_all())
}

fn publisher(session: &Session, topic: &str) -> Publisher {
    session.create_publisher(spec(topic)).expect("a publisher")
}

fn subscription(session: &Session, topic: &str) -> Subscription {
    session.create_subscription(spec(topic)).expect("a subscription")
}

fn meet(publisher: &Publisher, subscription: &Subscription) {
    eventually("a publisher and a subscription meet", || {
        publisher.matched().contains(&subscription.gid())
            && subscription.matched().contains(&publisher.gid())
    });
}

/// Waits until a sample of the publisher arrives.
fn flows(publisher: &Publisher, subscription: &Subscription) {
    meet(publisher, subscription);
    publisher.publish(b"sample").expect("published");
    let got = subscription.recv(&mut Vec::new(), Some(Duration::from_secs(60)));
    got.expect("a sample arrives");
}

fn signal(process: &Running, signal: Signal) {
    kill_process(Pid::from_child(&process.0), signal).expect("it runs");
}

/// A robot with a file of rules, its base station, and the daemons of both.
struct Hosts {
    robot: Host,
    base: Host,
    rules: PathBuf,
    dir: tempfile::TempDir,
    daemons: Vec<Running>,
}

impl Hosts {
    fn start() -> Self {
        let dir = tempfile::tempdir().expect("directory");
        let rules = dir.path().join("access.toml");
        fs::write(&rules, "default = \"allow\"").expect("writable");
        let [robot, base] = Host::pair();
        let mut command = robot.axon(&["daemon"]);
        command.env("AXON_ACCESS_FILE", &rules);
        let daemons = vec![Running::start(command), Running::start(base.axon(&["daemon"]))];
        robot.wait_daemon();
        base.wait_daemon();
        Self { robot, base, rules, dir, daemons }
    }

    /// Starts `axon acl learn` on the robot, and waits until it watches.
    fn learn(&self, arguments: &[&str]) -> (Running, BufReader<ChildStderr>) {
        let arguments = [&["acl", "learn"], arguments].concat();
        let mut learn = Running::start(self.robot.axon(&arguments));
        let mut said = BufReader::new(learn.0.stderr.take().expect("standard error"));
        let mut line = String::new();
        while !line.contains("watching other hosts and users") {
            line.clear();
            assert!(said.read_line(&mut line).expect("text") > 0, "it ended");
        }
        (learn, said)
    }

    fn reload(&self) {
        let mut command = self.robot.axon(&["reload"]);
        let output = command.env("AXON_ACCESS_FILE", &self.rules).output().expect("runs");
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    }

    /// Returns whether the robot's rules deny this to the base station.
    fn denied(&self, what: &str) -> bool {
        let status = self.robot.status().expect("a status");
        status["links"]
            .as_array()
            .expect("links")
            .iter()
            .any(|link| !link["denied"][what].is_null())
    }
}

fn interrupt(learn: Running, mut said: BufReader<ChildStderr>) -> (std::process::Output, String) {
    signal(&learn, Signal::INT);
    let mut text = String::new();
    said.read_to_string(&mut text).expect("text");
    (learn.finish(), text)
}

#[test]
fn learned_rules_permit_the_seen_uses_and_no_other() {
    let hosts = Hosts::start();
    let (here, there) = (hosts.robot.session("robot"), hosts.base.session("base"));
    let commands = (publisher(&there, "/cmd_vel"), subscription(&here, "/cmd_vel"));
    let scan = (publisher(&here, "/scan \"left\""), subscription(&there, "/scan \"left\""));
    let unheard = publisher(&there, "/unheard");
    flows(&commands.0, &commands.1);
    flows(&scan.0, &scan.1);
    let learned = hosts.dir.path().join("learned.toml");
    let (learn, said) = hosts.learn(&["--output", learned.to_str().expect("UTF-8")]);
    // These endpoints come and go during the watch.
    let briefly = subscription(&here, "/brief");
    let brief = publisher(&there, "/brief");
    meet(&brief, &briefly);
    drop((brief, briefly));
    eventually("it has gone", || {
        let graph = here.graph();
        !graph.endpoints.values().any(|entry| entry.endpoint.topic == "/brief")
    });
    let (output, said) = interrupt(learn, said);
    assert!(output.status.success() && said.contains("saw 3 uses of 1 hosts and users"), "{said}");
    assert!(output.stdout.is_empty());

    let text = fs::read_to_string(&learned).expect("the rules");
    let file = learned.to_str().expect("UTF-8");
    let tested = hosts.robot.run(&["acl", "test", file]);
    let shown = String::from_utf8_lossy(&tested.stdout);
    assert_eq!(shown, "3 expectations, all met\n", "{text}");
    assert!(text.contains("publish = [\n  \"/brief\",\n  \"/cmd_vel\",\n]\n"), "{text}");
    assert!(text.contains("# nothing here is at the other end: publish /unheard\n"), "{text}");

    fs::write(&hosts.rules, &text).expect("writable");
    hosts.reload();
    flows(&commands.0, &commands.1);
    flows(&scan.0, &scan.1);
    let (other, heard) = (publisher(&there, "/other"), subscription(&here, "/other"));
    eventually("one more topic is denied", || hosts.denied("publish /other (the peer's)"));
    assert!(other.matched().is_empty() && heard.matched().is_empty());
    // The process that waits for a denied topic prints the reason.
    let _secret = publisher(&here, "/secret");
    let mut echo = Running::start(hosts.base.axon(&["echo", "/secret", "--type", "test/Bytes"]));
    let said = BufReader::new(echo.0.stderr.take().expect("standard error"));
    let says = |line: &str| line.contains("/secret") && line.contains("by the peer: denied");
    assert!(said.lines().any(|line| says(&line.expect("text"))), "it ended");
    // A new pair of what was seen is made.
    flows(&commands.0, &subscription(&here, "/cmd_vel"));

    // Uses that the rules in force deny stay denied.
    let again = hosts.robot.run(&["acl", "learn", "--for", "5s", "--output", file]);
    let said = String::from_utf8_lossy(&again.stderr);
    assert_eq!(again.status.code(), Some(1), "{said}");
    assert!(said.contains("it exists; --force replaces it"), "{said}");
    assert_eq!(fs::read_to_string(&learned).expect("the rules"), text);
    let again = hosts.robot.run(&["acl", "learn", "--for", "5s", "--force", "--output", file]);
    assert!(again.status.success(), "{}", String::from_utf8_lossy(&again.stderr));
    let text = fs::read_to_string(&learned).expect("the rules");
    assert!(text.contains("# denied before: publish /other (here: denied: no [[allow]]"), "{text}");
    let tested = hosts.robot.run(&["acl", "test", file]);
    assert!(tested.status.success(), "{text}");
    let expected = "publish = \"/other\"\nallowed = false\n";
    assert!(text.contains(expected) && text.contains("publish = \"/cmd_vel\"\n"), "{text}");
    assert!(fs::read_dir(hosts.dir.path()).expect("listed").count() == 2, "nothing else is left");
    drop(unheard);
}

#[test]
fn acl_learn_reports_a_daemon_exit_and_writes_rules_learned_so_far() {
    let mut hosts = Hosts::start();
    let (here, there) = (hosts.robot.session("robot"), hosts.base.session("base"));
    let commands = (publisher(&there, "/cmd_vel"), subscription(&here, "/cmd_vel"));
    flows(&commands.0, &commands.1);
    // The output of the program is a pipe that is not read any more.
    let (mut deaf, deaf_said) = hosts.learn(&[]);
    drop(deaf.0.stdout.take());
    let (learn, said) = hosts.learn(&["--see"]);
    eventually("both look at the daemon", || {
        let status = hosts.robot.status().expect("a status");
        let sessions = status["sessions"].as_array().expect("sessions").iter();
        sessions.filter(|session| session["name"] == "axon acl learn").count() == 2
    });
    // The test cannot ask what they have seen: the graph is there with the session, and the names of hosts soon after.
    std::thread::sleep(Duration::from_secs(2));
    let (output, said_there) = interrupt(deaf, deaf_said);
    assert!(output.status.success(), "{said_there}");
    drop(here);
    let daemon = hosts.daemons.remove(0);
    signal(&daemon, Signal::KILL);
    drop(daemon);
    eventually("it has gone", || hosts.robot.status().is_none());
    let (output, said) = interrupt(learn, said);
    assert!(output.status.success() && said.contains("the daemon has ended"), "{said}");
    let text = String::from_utf8(output.stdout).expect("UTF-8");
    assert!(text.contains("publish = \"/cmd_vel\"\nsee = \"**\"\n"), "{text}");
}

#[test]
fn acl_learn_writes_no_file_when_no_endpoints_were_observed() {
    let host = Host::new();
    let file = tempfile::tempdir().expect("directory");
    let file = file.path().join("access.toml");
    let arguments = ["acl", "learn", "--for", "200ms", "--output", file.to_str().expect("UTF-8")];
    let none = host.run(&arguments);
    let said = String::from_utf8_lossy(&none.stderr);
    assert!(none.status.code() == Some(1) && said.contains("no daemon listens"), "{said}");
    let _daemon = Running::start(host.axon(&["daemon"]));
    host.wait_daemon();
    let _session = host.session("alone");
    let output = host.run(&arguments);
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.code() == Some(1) && said.contains("no rules were written"), "{said}");
    assert!(!file.exists());
}
