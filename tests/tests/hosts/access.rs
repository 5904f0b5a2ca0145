//! Tests access rules between two hosts as real processes: denied messages never arrive, allowed ones all do, and a
//! daemon takes over changed rules without a restart.

mod flooded;
mod limits;
mod names;
mod odd_names;
mod reload;
mod users;

use std::{
    fs,
    path::PathBuf,
    time::{Duration, Instant},
};

use axon_transport::{
    EndpointSpec, Event, Publisher, Session, Subscription,
    config::DaemonLocation,
    daemon_reload_at,
    events::{EventKind, EventStatus},
    qos::{Durability, Qos},
    status::ReloadReport,
};
use rustix::process::Signal;

use super::{
    identity::authority::{self, Authority},
    mode::{Kmes, Settings, classic, pinned},
    pair::{Host, Plan, signal},
    process::{PATIENCE, until},
};

/// The rights that a robot gives its base station. `PEER` is replaced.
const ROBOT: &str = r#"
default = "deny"

[[allow]]
peer = "PEER"
publish = "/cmd_vel"
subscribe = "/scan"
call = "/set_mode"
"#;

fn spec(topic: &str) -> EndpointSpec {
    let qos = Qos::keep_all().with_durability(Durability::TransientLocal);
    EndpointSpec::new(topic, "test/Bytes", qos)
}

fn publisher(session: &Session, topic: &str) -> Publisher {
    session.create_publisher(spec(topic)).unwrap()
}

fn subscription(session: &Session, topic: &str) -> Subscription {
    session.create_subscription(spec(topic)).unwrap()
}

/// A robot with rules, which name its base station by `peer`, and the base station.
struct Hosts {
    robot: Host,
    base: Host,
    peer: &'static str,
    rules: PathBuf,
    /// The address of the robot's daemon, which its rules do not change.
    place: DaemonLocation,
    _keys: tempfile::TempDir,
}

impl Hosts {
    fn start(settings: [Settings; 2], peer: &'static str, keys: tempfile::TempDir) -> Self {
        let [mut robot, base] = Plan::new(settings).prepare();
        let rules = robot.dir.path().join("access.toml");
        robot.set("AXON_ACCESS_FILE", rules.to_str().unwrap());
        fs::write(&rules, "default = \"allow\"").unwrap();
        let place = DaemonLocation::from(&robot.config());
        let mut hosts = Self { robot, base, peer, rules, place, _keys: keys };
        hosts.write(ROBOT);
        hosts.robot.start();
        hosts.base.start();
        hosts
    }

    /// Runs the test in each way in which a peer proves its name, and in `none`, where its address counts.
    fn in_all(test: impl Fn(Self)) {
        let keys = tempfile::tempdir().unwrap();
        test(Self::start(pinned(keys.path(), [[false, true], [true, false]]), "host-1", keys));
        for key_mode in ["session", "messages10"] {
            let kmes = Kmes::start();
            let more = [("AXON_QKD_KEY_MODE", key_mode)];
            let settings = [0, 1].map(|host| kmes.settings(host, &more));
            test(Self::start(settings, "sae-b", tempfile::tempdir().unwrap()));
        }
        // DNS names are the same in any case.
        let (files, ca) = (tempfile::tempdir().unwrap(), Authority::new("the CA"));
        let own = |name: &str, serial| {
            let certificate = ca.issue(name, serial, 2100);
            authority::settings(files.path(), name, &ca.pem, &certificate, None)
        };
        test(Self::start([own("robot", 1), own("Base.Example", 2)], "base.example", files));
        let settings = [classic(&[]), classic(&[])];
        test(Self::start(settings, "address:127.*", tempfile::tempdir().unwrap()));
    }

    fn write(&self, rules: &str) {
        fs::write(&self.rules, rules.replace("PEER", self.peer)).unwrap();
    }

    fn reload(&self) -> ReloadReport {
        daemon_reload_at(&self.place).unwrap()
    }

    /// Returns whether a host shows this as denied, with this text in the reason.
    fn shows(host: &Host, what: &str, why: &str) -> bool {
        host.link().denied.get(what).is_some_and(|reason| reason.contains(why))
    }
}

fn meet(publisher: &Publisher, subscription: &Subscription) {
    until("a publisher and a subscription that rules allow meet", || {
        publisher.matched().contains(&subscription.gid())
            && subscription.matched().contains(&publisher.gid())
    });
}

#[test]
fn the_wrong_topic_never_arrives_and_the_right_one_does_in_each_mode() {
    Hosts::in_all(|hosts| {
        for relayed in [false, true] {
            let here = match relayed {
                true => hosts.robot.relayed_session("robot"),
                false => hosts.robot.session("robot"),
            };
            let there = hosts.base.session("base");
            let [drive, brake] = ["/cmd_vel", "/brake"].map(|topic| subscription(&here, topic));
            let [drives, brakes] = ["/cmd_vel", "/brake"].map(|topic| publisher(&there, topic));
            let [scan, secret] = ["/scan", "/secret"].map(|topic| publisher(&here, topic));
            let [scans, secrets] = ["/scan", "/secret"].map(|topic| subscription(&there, topic));
            let service = |name| EndpointSpec::new(name, "test/Set", Qos::keep_all());
            let [mode, reboot] =
                ["/set_mode", "/reboot"].map(|name| here.create_server(service(name)).unwrap());
            let [sets, reboots] =
                ["/set_mode", "/reboot"].map(|name| there.create_client(service(name)).unwrap());
            // Before they meet: history is a way in and out, too.
            for publisher in [&drives, &brakes, &scan, &secret] {
                publisher.publish(b"before").unwrap();
            }
            meet(&drives, &drive);
            meet(&scan, &scans);
            assert!(sets.wait_available(PATIENCE));
            for publisher in [&drives, &brakes, &scan, &secret] {
                publisher.publish(b"after").unwrap();
            }
            let mut bytes = Vec::new();
            for subscription in [&drive, &scans] {
                for expected in ["before", "after"] {
                    subscription.recv(&mut bytes, Some(PATIENCE)).expect("a sample");
                    assert_eq!(bytes, expected.as_bytes());
                }
            }
            reboots.send_request(b"now").unwrap();
            let number = sets.send_request(b"auto").unwrap();
            let asked = mode.recv_request(&mut bytes, Some(PATIENCE)).expect("a request");
            mode.send_response(asked.publisher, asked.sequence, b"done").unwrap();
            let response = sets.recv_response(&mut bytes, Some(PATIENCE)).expect("a response");
            assert_eq!((response.sequence, &*bytes), (number, &b"done"[..]));
            // All allowed messages are here. A denied message that was sent before them would be here, too.
            assert!(!brake.has_data() && !secrets.has_data());
            assert!(reboot.recv_request(&mut bytes, Some(Duration::ZERO)).is_err());
            assert!(brake.matched().is_empty() && secrets.matched().is_empty());
            assert!(!reboots.is_available());
            let seen = there.graph();
            for gid in [secret.gid(), brake.gid()] {
                assert!(!seen.endpoints.contains_key(&gid), "the base sees what it may not");
            }
            assert!(!here.graph().endpoints.contains_key(&brakes.gid()));
            until("both hosts say what is denied", || {
                Hosts::shows(
                    &hosts.robot,
                    "publish /brake (the peer's)",
                    "no [[allow]] in access.toml",
                ) && Hosts::shows(&hosts.base, "publish /brake (ours)", "by the peer: denied")
                    && Hosts::shows(&hosts.base, "subscribe /secret (ours)", "access.toml")
                    && Hosts::shows(&hosts.base, "call /reboot (ours)", "access.toml")
            });
            hosts.robot.wait_log(&["a peer's endpoints are denied by access rules", "access.toml"]);
            hosts.base.wait_log(&["access rules of a peer deny endpoints of this host", "denied"]);
            let topic =
                hosts.base.status().topics.into_iter().find(|t| t.topic == "/brake").unwrap();
            let waits = topic.refused.iter().find(|r| r.endpoint == brakes.gid().to_string());
            assert!(waits.unwrap().reason.contains("denied"), "{:?}", topic.refused);
        }
    });
}

#[test]
fn a_daemon_takes_rules_that_changed_and_refuses_those_that_are_wrong() {
    let keys = tempfile::tempdir().unwrap();
    let settings = pinned(keys.path(), [[false, true], [true, false]]);
    let hosts = Hosts::start(settings, "host-1", keys);
    let (here, there) = (hosts.robot.session("robot"), hosts.base.session("base"));
    let [drive, scans] = [subscription(&here, "/cmd_vel"), subscription(&there, "/scan")];
    let [drives, scan] = [publisher(&there, "/cmd_vel"), publisher(&here, "/scan")];
    meet(&drives, &drive);
    meet(&scan, &scans);
    assert_eq!(hosts.reload().changed, Vec::<String>::new());

    hosts.write("default = \"deny\"\n[[allow]]\npeer = \"PEER\"\nsubscribe = [\"/scan\", 3]\n");
    let report = hosts.reload();
    let error = report.error.unwrap();
    assert!(error.contains("line 4, column 23"), "{error}");
    assert!(report.changed.is_empty() && drive.matched().contains(&drives.gid()));

    hosts.write("default = \"deny\"\n[[allow]]\npeer = \"PEER\"\nsubscribe = \"/scan\"\n");
    let asked = Instant::now();
    let report = hosts.reload();
    assert_eq!((report.changed, report.error), (vec!["access rules".to_owned()], None));
    until("the pair that is not allowed any more ends on both hosts", || {
        drive.matched().is_empty() && drives.matched().is_empty()
    });
    eprintln!("the pair ends {:?} after its rules are read again", asked.elapsed());
    drives.publish(b"late").unwrap();
    scan.publish(b"still").unwrap();
    let mut bytes = Vec::new();
    scans.recv(&mut bytes, Some(PATIENCE)).expect("a sample");
    assert!(!drive.has_data());

    hosts.write(ROBOT);
    signal(hosts.robot.status().pid, Signal::HUP);
    meet(&drives, &drive);
    hosts.robot.wait_log(&["the settings were read again", "access rules"]);
    // The file is gone: rules that cannot be read change nothing.
    fs::remove_file(&hosts.rules).unwrap();
    assert!(hosts.reload().error.unwrap().contains("AXON_ACCESS_FILE"));
    assert!(drive.matched().contains(&drives.gid()));
    hosts.write(ROBOT);
}

/// Returns how often an endpoint was matched, and how often its QoS was incompatible.
fn events(matched: &Event, incompatible: &Event) -> (u64, u64) {
    let (EventStatus::Matched(matched), EventStatus::IncompatibleQos(incompatible)) =
        (matched.take(), incompatible.take())
    else {
        unreachable!()
    };
    (matched.total, incompatible.count.total)
}

#[test]
fn denied_remote_endpoint_is_visible_and_never_matched() {
    use EventKind::{
        OfferedQosIncompatible, PublicationMatched, RequestedQosIncompatible, SubscriptionMatched,
    };
    let keys = tempfile::tempdir().unwrap();
    let settings = pinned(keys.path(), [[false, true], [true, false]]);
    let hosts = Hosts::start(settings, "host-1", keys);
    let see = "default = \"deny\"\n[[allow]]\npeer = \"PEER\"\nsee = \"**\"\n\
               subscribe = \"/other\"\npublish = \"/other\"\n";
    let deny = "[[deny]]\npeer = \"PEER\"\npublish = \"/scan\"\nsubscribe = \"/scan\"\n\
                serve = \"/scan\"\ncall = \"/scan\"\n";
    let (here, there) = (hosts.robot.session("robot"), hosts.base.session("base"));
    for closed in [deny, see] {
        hosts.write(closed);
        assert_eq!(hosts.reload().error, None);
        for [from, to] in [[&here, &there], [&there, &here]] {
            let (scan, scans) = (publisher(from, "/scan"), subscription(to, "/scan"));
            let service = || EndpointSpec::new("/scan", "test/Set", Qos::keep_all());
            let (_server, client) =
                (from.create_server(service()).unwrap(), to.create_client(service()).unwrap());
            let offers = [PublicationMatched, OfferedQosIncompatible];
            let offers = offers.map(|kind| scan.event(kind).unwrap());
            let requests = [SubscriptionMatched, RequestedQosIncompatible];
            let requests = requests.map(|kind| scans.event(kind).unwrap());
            let verb = if std::ptr::eq(from, &here) { "subscribe" } else { "publish" };
            until("both hosts say what is denied", || {
                Hosts::shows(&hosts.robot, &format!("{verb} /scan (the peer's)"), "denied")
                    && Hosts::shows(&hosts.base, &format!("{verb} /scan (ours)"), "denied")
            });
            // Endpoints that were created later are matched: the others would be by now.
            meet(&publisher(from, "/other"), &subscription(to, "/other"));
            assert!(scan.matched().is_empty() && scans.matched().is_empty(), "{closed}");
            assert!(!client.is_available(), "{closed}");
            // The robot shows its endpoints: it denies only their use.
            let own = if std::ptr::eq(from, &here) { scan.gid() } else { scans.gid() };
            until("the base sees the robot's endpoint", || {
                there.graph().endpoints.contains_key(&own)
            });
            assert_eq!(events(&offers[0], &offers[1]), (0, 0), "{closed}");
            assert_eq!(events(&requests[0], &requests[1]), (0, 0), "{closed}");
            for round in 1..=2 {
                hosts.write("default = \"allow\"");
                assert_eq!(hosts.reload().error, None);
                meet(&scan, &scans);
                assert!(client.wait_available(PATIENCE));
                scan.publish(b"open").unwrap();
                scans.recv(&mut Vec::new(), Some(PATIENCE)).expect("a sample");
                hosts.write(closed);
                assert_eq!(hosts.reload().error, None);
                until("the pair ends on both hosts", || {
                    scan.matched().is_empty() && scans.matched().is_empty()
                });
                until("the server is gone", || !client.is_available());
                assert_eq!(events(&offers[0], &offers[1]), (round, 0), "{closed}");
                assert_eq!(events(&requests[0], &requests[1]), (round, 0), "{closed}");
            }
        }
    }
}

#[test]
fn a_peer_that_may_do_nothing_here_shows_no_nodes_here() {
    let keys = tempfile::tempdir().unwrap();
    let settings = pinned(keys.path(), [[false, true], [true, false]]);
    let hosts = Hosts::start(settings, "host-1", keys);
    let (here, there) = (hosts.robot.session("robot"), hosts.base.session("base"));
    let node = there.create_node("guest", "/far", "/").unwrap();
    let has_node = || here.graph().endpoints.contains_key(&node.gid());
    until("the node of a peer with rights is there", has_node);
    for nothing in [
        "[[allow]]\npeer = \"PEER\"\nsee = \"**\"",
        "[[deny]]\npeer = \"PEER\"\npublish = \"**\"\nsubscribe = \"**\"\nserve = \"**\"\ncall = \"**\"",
        "default = \"deny\"",
    ] {
        hosts.write(nothing);
        assert_eq!(hosts.reload().error, None);
        until("the node is not there", || !has_node());
        hosts.write(ROBOT);
        assert_eq!(hosts.reload().error, None);
        until("the node is there again", has_node);
    }
}

#[test]
fn rule_changes_under_load_lose_no_allowed_samples() {
    let keys = tempfile::tempdir().unwrap();
    let settings = pinned(keys.path(), [[false, true], [true, false]]);
    let hosts = Hosts::start(settings, "host-1", keys);
    let (here, there) = (hosts.robot.session("robot"), hosts.base.session("base"));
    let (scan, scans) = (publisher(&here, "/scan"), subscription(&there, "/scan"));
    let (drive, drives) = (subscription(&here, "/cmd_vel"), publisher(&there, "/cmd_vel"));
    meet(&scan, &scans);
    meet(&drives, &drive);
    let without = ROBOT.replace("publish = \"/cmd_vel\"\n", "");
    std::thread::scope(|scope| {
        let receiving = scope.spawn(|| {
            let mut bytes = Vec::new();
            for number in 1..=2000 {
                let info = scans.recv(&mut bytes, Some(PATIENCE)).expect("a sample");
                assert_eq!(info.sequence, number, "a gap in a topic that was allowed throughout");
            }
        });
        for round in 0..40 {
            hosts.write([&without, ROBOT][round % 2]);
            assert_eq!(hosts.reload().error, None);
            for _ in 0..50 {
                scan.publish(&[7; 1000]).unwrap();
            }
        }
        receiving.join().unwrap();
    });
    meet(&drives, &drive);
}

#[test]
fn a_pin_under_another_name_has_the_rights_of_that_name() {
    let keys = tempfile::tempdir().unwrap();
    let trust = keys.path().join("host-0.trust");
    let settings = pinned(keys.path(), [[false, true], [true, false]]);
    let hosts = Hosts::start(settings, "host-1", keys);
    let (here, there) = (hosts.robot.session("robot"), hosts.base.session("base"));
    let (drive, drives) = (subscription(&here, "/cmd_vel"), publisher(&there, "/cmd_vel"));
    meet(&drives, &drive);
    let pins = fs::read_to_string(&trust).unwrap();
    fs::write(&trust, pins.replace("host-1 ", "guest ")).unwrap();
    until("the link under the old name ends, and the new name may not publish", || {
        drive.matched().is_empty()
            && hosts.robot.status().links.iter().any(|link| {
                link.host == "guest" && link.denied.contains_key("publish /cmd_vel (the peer's)")
            })
    });
    fs::write(&trust, pins).unwrap();
    meet(&drives, &drive);
}
