//! Settings that are read again beside the rules: log levels, and the peers that a daemon looks for.

use std::net::{Ipv4Addr, UdpSocket};

use super::*;

/// Two hosts without peers. Whoever is not listed is not found. The settings of the first are in its `axon.toml`.
fn unlisted() -> [Host; 2] {
    let plan = Plan { listed: false, ..Plan::new([classic(&[]), classic(&[])]) };
    let mut hosts = plan.prepare();
    for host in &mut hosts {
        host.set("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST");
    }
    hosts[0].unset("AXON_DAEMON_PEERS");
    hosts[0].unset("AXON_LOG");
    hosts
}

/// Writes `axon.toml` of a host, and has its daemon read it. Returns what changed.
fn rewrite(host: &Host, toml: &str) -> Vec<String> {
    fs::write(host.dir.path().join("axon.toml"), toml).unwrap();
    let report = daemon_reload_at(&DaemonPlace::from(&host.config())).unwrap();
    assert_eq!(report.error, None);
    report.changed
}

/// A host that listens, and says nothing.
struct Listener(UdpSocket);

impl Listener {
    fn new(beside: &Host, last: u8) -> Self {
        let [a, b, c, _] = beside.address.octets();
        let socket = UdpSocket::bind((Ipv4Addr::new(a, b, c, last), 0)).unwrap();
        socket.set_nonblocking(true).unwrap();
        Self(socket)
    }

    fn peer(&self) -> String {
        format!("\"{}\"", self.0.local_addr().unwrap())
    }

    /// How many datagrams came since the last call.
    fn heard(&self) -> usize {
        let mut bytes = [0; 2048];
        std::iter::from_fn(|| self.0.recv_from(&mut bytes).ok()).count()
    }

    fn wait(&self, datagrams: usize) {
        let mut heard = 0;
        until("a host that is listed is asked", || {
            heard += self.heard();
            heard >= datagrams
        });
    }
}

#[test]
fn peers_that_are_added_are_looked_for_and_those_that_are_removed_are_not() {
    let [mut a, mut b] = unlisted();
    let [first, second] = [7, 8].map(|last| Listener::new(&a, last));
    fs::write(a.dir.path().join("axon.toml"), format!("daemon_peers = [{}]", first.peer()))
        .unwrap();
    a.start();
    b.start();
    first.wait(1);
    assert_eq!(second.heard(), 0);
    assert_eq!(rewrite(&a, &format!("daemon_peers = [{}]", second.peer())), ["AXON_DAEMON_PEERS"]);
    second.wait(1);
    // What was on its way when the settings changed.
    first.heard();
    second.wait(4);
    assert_eq!(first.heard(), 0, "it is not listed any more");
    assert!(a.status().links.is_empty(), "nobody listed B");

    let both = format!("daemon_peers = [{}, \"{}\"]", second.peer(), b.address);
    assert_eq!(rewrite(&a, &both), ["AXON_DAEMON_PEERS"]);
    a.link();
    b.link();
    assert!(rewrite(&a, &both).is_empty());
}

#[test]
fn log_levels_follow_the_settings() {
    let [mut a, _] = unlisted();
    fs::write(a.dir.path().join("axon.toml"), "log = \"warn\"").unwrap();
    a.start();
    let uses = || {
        let session = a.session("user");
        let _publisher = publisher(&session, "/logged");
        a.status();
    };
    uses();
    assert_eq!(a.log_lines(&["DEBUG"]) + a.log_lines(&["INFO"]), 0);
    assert_eq!(rewrite(&a, "log = \"axon_daemon=debug\""), ["AXON_LOG"]);
    a.wait_log(&["INFO", "the settings were read again", "AXON_LOG"]);
    until("debug lines come", || {
        uses();
        a.log_lines(&["DEBUG"]) > 0
    });
    assert_eq!(rewrite(&a, "log = \"error\""), ["AXON_LOG"]);
    let before = a.log_bytes();
    (0..10).for_each(|_| uses());
    assert_eq!(a.log_bytes(), before, "nothing below an error");
    // A level that there is not changes nothing, and is named.
    let place = DaemonPlace::from(&a.config());
    fs::write(a.dir.path().join("axon.toml"), "log = \"axon_daemon=loud\"").unwrap();
    let error = daemon_reload_at(&place).unwrap().error.expect("why not");
    assert!(error.contains("log") && error.contains("loud"), "{error}");
}
