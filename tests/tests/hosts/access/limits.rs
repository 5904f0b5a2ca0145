//! Limits between two hosts. Two samples of each topic may pass, and the next one after a hundred seconds or once the limit
//! is gone.

use axon_transport::status::LimitStatus;

use super::*;

const LIMITS: &str = r#"default = "allow"
[[limit]]
peer = "PEER"
publish = "/cmd_vel"
rate = 0.01
burst = 2

[[limit]]
peer = "PEER"
subscribe = "/scan"
rate = 0.01
burst = 2
over = "hold"

[[limit]]
peer = "PEER"
call = "/set_mode"
rate = 0.01
burst = 2
over = "hold"
"#;

const SAMPLES: u64 = 200;

fn publish(publisher: &Publisher) {
    for number in 1..=SAMPLES {
        publisher.publish(&number.to_be_bytes()).unwrap();
    }
}

/// Takes the next sample, and returns its number.
fn next(subscription: &Subscription) -> u64 {
    let mut bytes = Vec::new();
    subscription.recv(&mut bytes, Some(PATIENCE)).expect("a sample");
    u64::from_be_bytes(bytes.try_into().unwrap())
}

/// Returns the limit of a topic in the robot's current status.
fn limit(hosts: &Hosts, name: &str) -> LimitStatus {
    let limits = hosts.robot.link().limits;
    limits.into_iter().find(|limit| limit.name == name).unwrap_or_default()
}

#[test]
fn samples_beyond_a_limit_wait_or_count_as_dropped_in_each_mode() {
    Hosts::in_all(|hosts| {
        hosts.write(LIMITS);
        assert_eq!(hosts.reload().error, None);
        let (here, there) = (hosts.robot.session("robot"), hosts.base.session("base"));
        let (drive, drives) = (subscription(&here, "/cmd_vel"), publisher(&there, "/cmd_vel"));
        let (scan, scans) = (publisher(&here, "/scan"), subscription(&there, "/scan"));
        let service = || EndpointSpec::new("/set_mode", "test/Set", Qos::keep_all());
        let (mode, sets) =
            (here.create_server(service()).unwrap(), there.create_client(service()).unwrap());
        meet(&drives, &drive);
        meet(&scan, &scans);
        assert!(sets.wait_available(PATIENCE));
        publish(&drives);
        publish(&scan);
        let numbers: Vec<_> = (0..5).map(|n| sets.send_request(&[n]).unwrap()).collect();
        // The first two pass. The others are dropped as they come, or wait where they are held.
        assert_eq!([next(&drive), next(&drive)], [1, 2]);
        until("what is beyond the limit is counted", || {
            limit(&hosts, "/cmd_vel").dropped == SAMPLES - 2
        });
        assert_eq!([next(&scans), next(&scans)], [1, 2]);
        let (mut bytes, mut asked) = (Vec::new(), Vec::new());
        for _ in 0..2 {
            asked.push(mode.recv_request(&mut bytes, Some(PATIENCE)).expect("a request"));
        }
        until("the robot shows both limits", || limit(&hosts, "/scan").passed == 2);
        assert!(!drive.has_data() && !scans.has_data());
        assert!(mode.recv_request(&mut bytes, Some(Duration::ZERO)).is_err());
        let (drives_limit, scan_limit) = (limit(&hosts, "/cmd_vel"), limit(&hosts, "/scan"));
        assert_eq!((&*drives_limit.verb, drives_limit.passed), ("publish", 2));
        assert_eq!((&*scan_limit.verb, scan_limit.passed, scan_limit.dropped), ("subscribe", 2, 0));
        assert_eq!(scan_limit.place, "line 8 of access.toml");
        assert_eq!(scan_limit.limit, "0.01 a second, 2 at once, hold");
        until("the link's status has the cause", || {
            hosts.robot.link().dropped.get("limit") == Some(&(SAMPLES - 2))
        });

        hosts.write("default = \"allow\"");
        let error = hosts.reload().error.unwrap();
        assert!(error.contains("is no [[limit]] any more"), "{error}");
        hosts
            .write("default = \"allow\"\n[[limit]]\npeer = \"PEER\"\ntopic = \"/other\"\nrate = 1");
        assert_eq!(hosts.reload().error, None);
        drives.publish(&(SAMPLES + 1).to_be_bytes()).unwrap();
        assert_eq!(next(&drive), SAMPLES + 1);
        assert_eq!(drive.lost(), SAMPLES - 2);
        for number in 3..=SAMPLES {
            assert_eq!(next(&scans), number);
        }
        assert_eq!((scans.lost(), drive.has_data(), scans.has_data()), (0, false, false));
        assert!(scan.wait_acknowledged(PATIENCE));
        assert!(
            !drives.wait_acknowledged(PATIENCE),
            "the publisher is told of those that were dropped"
        );
        while asked.len() < numbers.len() {
            asked.push(mode.recv_request(&mut bytes, Some(PATIENCE)).expect("a request"));
        }
        for (number, asked) in numbers.iter().zip(asked) {
            mode.send_response(asked.publisher, asked.sequence, b"done").unwrap();
            let response = sets.recv_response(&mut bytes, Some(PATIENCE)).expect("a response");
            assert_eq!(response.sequence, *number);
        }
        assert!(mode.recv_request(&mut bytes, Some(Duration::ZERO)).is_err());
        until("limits that are gone are not shown", || hosts.robot.link().limits.is_empty());
    });
}

/// Bytes of each sample in the tests of limits on bytes.
const LENGTH: usize = 10_000;

fn publish_long(publisher: &Publisher) {
    // The payload does not compress, so a slow link carries all of its bytes.
    let noise = noise(LENGTH);
    for number in 1..=SAMPLES {
        let mut sample = noise.clone();
        sample[..8].copy_from_slice(&number.to_be_bytes());
        publisher.publish(&sample).unwrap();
    }
}

/// Returns bytes that no compressor makes shorter.
fn noise(length: usize) -> Vec<u8> {
    let mut state = 1_u64;
    let mut next = || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        state as u8
    };
    (0..length).map(|_| next()).collect()
}

/// Takes the next long sample, and returns its number.
fn next_long(subscription: &Subscription) -> u64 {
    let mut bytes = Vec::new();
    subscription.recv(&mut bytes, Some(PATIENCE)).expect("a sample");
    assert_eq!(bytes.len(), LENGTH);
    u64::from_be_bytes(bytes[..8].try_into().unwrap())
}

#[test]
fn bytes_beyond_a_limit_are_dropped_or_wait_in_both_directions() {
    // The next sample may pass after ten thousand seconds.
    const BYTES: &str = "default = \"allow\"\n\
        [[limit]]\npeer = \"PEER\"\npublish = \"/cmd_vel\"\nbytes = \"1 B/s\"\n\
        [[limit]]\npeer = \"PEER\"\nsubscribe = \"/scan\"\nbytes = \"1 B/s\"\nover = \"hold\"\n";
    let keys = tempfile::tempdir().unwrap();
    let settings = pinned(keys.path(), [[false, true], [true, false]]);
    let hosts = Hosts::start(settings, "host-1", keys);
    hosts.write(BYTES);
    assert_eq!(hosts.reload().error, None);
    let (here, there) = (hosts.robot.session("robot"), hosts.base.session("base"));
    let (drive, drives) = (subscription(&here, "/cmd_vel"), publisher(&there, "/cmd_vel"));
    let (scan, scans) = (publisher(&here, "/scan"), subscription(&there, "/scan"));
    meet(&drives, &drive);
    meet(&scan, &scans);
    publish_long(&drives);
    publish_long(&scan);
    assert_eq!((next_long(&drive), next_long(&scans)), (1, 1));
    until("what is beyond the limit is counted", || {
        limit(&hosts, "/cmd_vel").dropped == SAMPLES - 1
    });
    assert_eq!((limit(&hosts, "/cmd_vel").passed, limit(&hosts, "/scan").passed), (1, 1));
    assert_eq!(limit(&hosts, "/scan").dropped, 0);
    assert!(!drive.has_data() && !scans.has_data());

    hosts.write("default = \"allow\"\n[[limit]]\npeer = \"PEER\"\ntopic = \"/other\"\nrate = 1");
    assert_eq!(hosts.reload().error, None);
    for number in 2..=SAMPLES {
        assert_eq!(next_long(&scans), number, "what was held is not lost");
    }
    drives.publish(&[&(SAMPLES + 1).to_be_bytes()[..], &[0; LENGTH - 8]].concat()).unwrap();
    assert_eq!(next_long(&drive), SAMPLES + 1);
    assert_eq!((drive.lost(), scans.lost()), (SAMPLES - 1, 0));
}

#[test]
fn an_egress_limit_slows_samples_and_loses_none() {
    egress_is_limited("peer = \"PEER\"", "(all packets)");
}

/// `max_hz` is of `[[topic]]`, in the settings' file of the host that sends.
#[test]
fn topic_crosses_at_max_hz_and_a_reload_changes_it() {
    let [mut robot, mut base] = Plan::new([classic(&[]), classic(&[])]).prepare();
    let file = robot.dir.path().join("axon.toml");
    let write = |hz: &str| {
        fs::write(&file, format!("[[topic]]\nname = \"/scan\"\nmax_hz = {hz}\n")).unwrap();
    };
    write("0.01");
    robot.set("AXON_CONFIG", file.to_str().unwrap());
    robot.start();
    base.start();
    let (here, there) = (robot.session("robot"), base.session("base"));
    let (scan, scans) = (publisher(&here, "/scan"), subscription(&there, "/scan"));
    let (log, logs) = (publisher(&here, "/log"), subscription(&there, "/log"));
    meet(&scan, &scans);
    meet(&log, &logs);
    for publisher in [&scan, &log] {
        for number in 1..=SAMPLES {
            publisher.publish(&number.to_be_bytes()).unwrap();
        }
    }
    (1..=SAMPLES).for_each(|number| assert_eq!(next(&logs), number));
    let dropped = || robot.link().dropped.get("max_hz").copied().unwrap_or_default();
    until("the robot counts what does not cross", || dropped() > 0);
    // The next one would cross after a hundred seconds.
    write("1000");
    let report = daemon_reload_at(&DaemonLocation::from(&robot.config())).unwrap();
    assert_eq!((report.changed, report.error), (vec!["[[topic]]".to_owned()], None));
    scan.publish(&(SAMPLES + 1).to_be_bytes()).unwrap();
    let mut crossed = 0;
    while next(&scans) <= SAMPLES {
        crossed += 1;
    }
    assert!(crossed < SAMPLES / 2, "{crossed} of {SAMPLES} crossed");
}

/// In each mode. Each other sample becomes shorter, and all arrive as they were published, in order.
#[test]
fn a_link_that_a_limit_slows_carries_compressed_samples() {
    Hosts::in_all(|hosts| {
        let (here, there) = (hosts.robot.session("robot"), hosts.base.session("base"));
        let (scan, scans) = (publisher(&here, "/scan"), subscription(&there, "/scan"));
        meet(&scan, &scans);
        let limited = "default = \"allow\"\n[[limit]]\npeer = \"PEER\"\negress = \"500 kB/s\"\n";
        hosts.write(limited);
        assert_eq!(hosts.reload().error, None);
        let (text, noise) = (b"a line of a log\n".repeat(LENGTH / 16), noise(LENGTH));
        let sample = |number: u64| {
            let mut sample = if number.is_multiple_of(2) { text.clone() } else { noise.clone() };
            sample[..8].copy_from_slice(&number.to_be_bytes());
            sample
        };
        for number in 1..=SAMPLES {
            scan.publish(&sample(number)).unwrap();
        }
        let mut bytes = Vec::new();
        for number in 1..=SAMPLES {
            scans.recv(&mut bytes, Some(PATIENCE)).expect("a sample");
            assert!(bytes == sample(number), "number {number} of {SAMPLES}");
        }
        until("status shows what was compressed", || {
            let compressed = hosts.robot.link().compressed;
            compressed.samples > 0 && compressed.bytes_sent < compressed.bytes / 2
        });
    });
}

#[test]
fn an_egress_limit_of_an_interface_slows_samples_and_loses_none() {
    egress_is_limited("interface = \"lo\"", "(all packets by lo)");
}

/// Tests a limit on the robot's outgoing packets, by peer or interface. Status shows the limit as `name`.
fn egress_is_limited(whose: &str, name: &str) {
    // All samples take two hundred seconds.
    let rules = format!("default = \"allow\"\n[[limit]]\n{whose}\negress = \"10 kB/s\"\n");
    let keys = tempfile::tempdir().unwrap();
    let settings = pinned(keys.path(), [[false, true], [true, false]]);
    let hosts = Hosts::start(settings, "host-1", keys);
    let (here, there) = (hosts.robot.session("robot"), hosts.base.session("base"));
    let (drive, drives) = (subscription(&here, "/cmd_vel"), publisher(&there, "/cmd_vel"));
    let (scan, scans) = (publisher(&here, "/scan"), subscription(&there, "/scan"));
    meet(&drives, &drive);
    meet(&scan, &scans);
    hosts.write(&rules);
    assert_eq!(hosts.reload().error, None);
    publish_long(&scan);
    // Incoming packets are not limited.
    publish(&drives);
    for number in 1..=SAMPLES {
        assert_eq!(next(&drive), number);
    }
    assert_eq!(next_long(&scans), 1);
    // A link's status is renewed each second.
    until("the robot shows the limit, and that the rest waits", || {
        let link = hosts.robot.link();
        link.waiting_bytes > 0 && limit(&hosts, name).passed > 0
    });
    let egress = hosts.robot.link().limits;
    let [egress] = &egress[..] else { panic!("{egress:?}") };
    assert_eq!((&*egress.verb, &*egress.name, egress.dropped), ("egress", name, 0));
    assert!(!scan.wait_acknowledged(Duration::ZERO));

    hosts.write("default = \"allow\"\n[[limit]]\npeer = \"PEER\"\ntopic = \"/other\"\nrate = 1");
    assert_eq!(hosts.reload().error, None);
    for number in 2..=SAMPLES {
        assert_eq!(next_long(&scans), number);
    }
    assert_eq!(scans.lost(), 0);
}
