//! QUIC's events in files (`[link] qlog`).

use std::{fs, path::Path};

use axon_transport::qos::Qos;
use rustix::process::Signal;

use super::{
    load::across,
    mode::classic,
    pair::{Host, Plan, signal},
    process::{PATIENCE, until},
};

const SECRET: &[u8] = b"no file of events may have this payload";

/// Starts two hosts, each of which writes to a directory of its own, and waits until samples have crossed.
fn hosts(directory: impl Fn(&Path) -> std::path::PathBuf) -> [Host; 2] {
    let mut hosts = Plan::new([classic(&[]), classic(&[])]).prepare();
    for host in &mut hosts {
        let directory = directory(host.dir.path());
        host.set("AXON_LINK_QLOG", directory.to_str().unwrap());
        host.start();
    }
    let (publisher, subscription) = across(&hosts, "/secret", Qos::keep_all());
    let mut bytes = Vec::new();
    for sequence in 1..=100 {
        publisher.publish(SECRET).unwrap();
        assert_eq!(subscription.recv(&mut bytes, Some(PATIENCE)).unwrap().sequence, sequence);
        assert_eq!(bytes, SECRET);
    }
    hosts
}

#[test]
fn each_side_of_a_link_writes_its_events_and_no_payload() {
    let hosts = hosts(|host| host.join("qlog"));
    for host in &hosts {
        host.link();
        signal(host.status().pid, Signal::TERM);
    }
    until("the daemons end", || hosts.iter().all(|host| host.try_status().is_none()));
    for host in &hosts {
        let directory = host.dir.path().join("qlog");
        let mut events = 0;
        for entry in fs::read_dir(directory).unwrap() {
            let text = fs::read(entry.unwrap().path()).unwrap();
            assert!(!text.windows(SECRET.len()).any(|part| part == SECRET));
            for record in text.split(|byte| *byte == 0x1e).filter(|record| !record.is_empty()) {
                let record: serde_json::Value = serde_json::from_slice(record).unwrap();
                events += usize::from(record["name"] == "transport:packet_sent");
            }
        }
        assert!(events > 0, "packets were sent");
    }
}

#[test]
fn unusable_qlog_directory_is_logged_once_and_changes_nothing() {
    // There is no directory below a file.
    let hosts = hosts(|host| host.join("host.txt/qlog"));
    for host in &hosts {
        host.link();
        host.wait_log(&["could not write QUIC's events"]);
        assert_eq!(host.log_lines(&["could not write QUIC's events"]), 1);
    }
}
