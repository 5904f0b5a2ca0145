//! Log levels are read again beside the rules.

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
    fs::write(a.dir.path().join("axon.toml"), "log = \"error\"").unwrap();
}
