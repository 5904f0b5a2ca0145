//! `kme-sim probe` against KMEs that hold to the specification and KMEs that do not.

mod probing;

use std::path::Path;
use std::process::Command;

use etsi_qkd014::sim::Network;

struct Site {
    network: Network,
    dir: tempfile::TempDir,
}

async fn site() -> Site {
    let any = "127.0.0.1:0".parse().unwrap();
    let builder = Network::builder().kme("kme-a", any, ["sae-a"]).kme("kme-b", any, ["sae-b"]);
    let network = builder.start().await.unwrap();
    let dir = tempfile::tempdir().unwrap();
    network.write_files(dir.path()).unwrap();
    Site { network, dir }
}

/// Runs the probe. Returns whether it reported success, and its table.
fn probe(env: &[(&str, String)], args: &[&str]) -> (bool, String) {
    let probed = probing::probe(env, args);
    (probed.passed, probed.text)
}

impl Site {
    fn env(&self, sae: &str) -> Vec<(&'static str, String)> {
        self.network.sae(sae).unwrap().env(self.dir.path())
    }

    /// Runs the probe with `faults` at the master's KME.
    fn probe(&self, faults: &[&str], args: &[&str]) -> (bool, String) {
        let kme = self.network.kme("kme-a").unwrap();
        kme.clear_faults();
        faults.iter().for_each(|plan| kme.plan(plan.parse().unwrap()));
        probe(&self.env("sae-a"), args)
    }
}

/// Returns the lines of a table that end with this verdict.
fn verdicts<'t>(table: &'t str, verdict: &str) -> Vec<&'t str> {
    table.lines().filter(|line| line.trim_end().ends_with(verdict)).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn the_simulator_passes_and_gives_no_key() {
    let site = site().await;
    let (passed, table) = site.probe(&[], &[]);
    assert!(passed, "{table}");
    assert!(table.contains(", 0 failed, 0 tolerated"), "{table}");
    assert!(verdicts(&table, "pass").len() > 25, "{table}");
    for kme in site.network.kmes() {
        let counters = kme.counters();
        assert_eq!(counters.enc_keys_calls + counters.keys_to_slaves, 0);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn arguments_say_the_same_as_the_environment() {
    let site = site().await;
    let env = site.env("sae-a");
    let of = |name: &str| env.iter().find(|(known, _)| *known == name).unwrap().1.as_str();
    let (passed, table) = probe(
        &[],
        &[
            of("AXON_KME_URL"),
            "--ca",
            of("AXON_KME_CA"),
            "--cert",
            of("AXON_SAE_CERT"),
            "--key",
            of("AXON_SAE_KEY"),
            "--sae",
            of("AXON_SAE_ID"),
        ],
    );
    assert!(passed, "{table}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_faulty_kme_fails_where_it_is_at_fault() {
    let site = site().await;
    for (fault, clause, row) in [
        ("garbage,on=status", "5.1", "a JSON object"),
        ("status=500,on=status", "5.2", "status answered 200"),
        ("status=404,on=dec_keys", "6.4", "dec_keys of an unknown key_ID by POST"),
        ("cut,on=status", "5.2", "status answered 200"),
        ("handshake-refused", "5.1", "certificate of the CA given"),
    ] {
        let (passed, table) = site.probe(&[fault], &["--timeout", "2"]);
        let failed = verdicts(&table, "FAIL");
        let named = failed.iter().any(|line| line.starts_with(clause) && line.contains(row));
        assert!(!passed && named, "{fault}: {table}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_deviation_with_a_quirk_is_named_by_it() {
    let site = site().await;
    for (fault, quirk) in [("media-type,on=status", "any-media-type"), ("http-1.0", "http-1.0")] {
        let (passed, table) = site.probe(&[fault], &[]);
        let tolerated = verdicts(&table, &format!("tolerated by quirk {quirk}"));
        assert!(!passed && tolerated.len() == 2, "{fault}: {table}");
        assert!(verdicts(&table, "FAIL").is_empty(), "{fault}: {table}");
    }
}

impl Site {
    /// Returns the slave's environment as `kme-sim init` prints it.
    fn slave_env(&self) -> String {
        probing::env_file(self.dir.path(), &["sae-a", "sae-b"].map(|sae| self.env(sae)))
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn the_simulator_passes_with_its_keys_drawn_at_both_ends() {
    let site = site().await;
    let (passed, table) = site.probe(&[], &["--consume-keys", "--slave-env", &site.slave_env()]);
    assert!(passed, "{table}");
    assert!(table.contains("dec_keys by POST: the same 3 keys"), "{table}");
    let [master, slave] = [0, 1].map(|at| site.network.kmes()[at].counters());
    assert_eq!((master.keys_to_masters, slave.keys_to_slaves), (5, 4), "{table}");
    // One end is enough for most of it.
    let (passed, table) = site.probe(&[], &["--consume-keys"]);
    assert!(passed && table.contains("skipped: no --slave-env"), "{table}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_kme_that_gives_keys_wrongly_fails_where_it_is_at_fault() {
    let site = site().await;
    let args = ["--consume-keys", "--slave-env", &site.slave_env(), "--timeout", "2"];
    for (fault, clause, row) in [
        ("wrong-length,on=enc_keys", "6.3", "enc_keys by POST: 3 keys of 256 bits"),
        ("repeat-key-id,on=enc_keys", "6.3", "enc_keys by POST: 3 keys of 256 bits"),
        ("key-missing,on=enc_keys", "6.3", "enc_keys by GET: 1 key of 256 bits"),
        ("garbage,on=enc_keys", "6.3", "enc_keys by GET: 1 key of 256 bits"),
        ("status=500,on=enc_keys", "6.2", "number of another type: 400"),
        ("reset,on=enc_keys", "6.2", "unsupported extension_mandatory: 400"),
        ("other-ids,on=enc_keys", "5.4", "dec_keys by GET: the same key"),
    ] {
        let (passed, table) = site.probe(&[fault], &args);
        let failed = verdicts(&table, "FAIL");
        let named = failed.iter().any(|line| line.starts_with(clause) && line.contains(row));
        assert!(!passed && named, "{fault}: {table}");
    }
    let (passed, table) = site.probe(&["media-type,on=enc_keys"], &args);
    let tolerated = verdicts(&table, "tolerated by quirk any-media-type");
    assert!(!passed && tolerated.len() == 2 && verdicts(&table, "FAIL").is_empty(), "{table}");

    // The slave's KME is at fault.
    let slave = site.network.kme("kme-b").unwrap();
    for (fault, row) in [
        ("wrong-length", "dec_keys by GET: the same key"),
        ("other-ids", "dec_keys by POST: the same 3 keys"),
        ("cut,on=dec_keys", "dec_keys by GET: the same key"),
        ("empty", "dec_keys of the same key again: 400"),
    ] {
        slave.clear_faults();
        slave.plan(fault.parse().unwrap());
        let (passed, table) = site.probe(&[], &args);
        let failed = verdicts(&table, "FAIL");
        assert!(!passed && failed.iter().any(|line| line.contains(row)), "{fault}: {table}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn another_kme_than_the_one_named_is_not_asked_further() {
    let site = site().await;
    let (passed, table) = site.probe(&[], &["--kme-id", "kme-b"]);
    assert!(!passed && table.contains("0 passed, 1 failed"), "{table}");
    assert_eq!(site.network.kme("kme-a").unwrap().counters().status_calls, 0);
}

#[test]
fn settings_that_cannot_work_are_said_before_anything_is_sent() {
    let output = Command::new(env!("CARGO_BIN_EXE_kme-sim"))
        .args(["probe", "https://127.0.0.1:1", "--slave-sae", "sae-b"])
        .env_clear()
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(2));
    let dir = tempfile::tempdir().unwrap();
    let file = |name: &str| dir.path().join(name).display().to_string();
    for name in ["ca", "cert", "key"] {
        std::fs::write(Path::new(&file(name)), "no PEM").unwrap();
    }
    let (passed, text) = probe(
        &[],
        &[
            "https://127.0.0.1:1",
            "--sae",
            "sae-a",
            "--ca",
            &file("ca"),
            "--cert",
            &file("cert"),
            "--key",
            &file("key"),
        ],
    );
    assert!(!passed && text.contains("no usable CA"), "{text}");
}
