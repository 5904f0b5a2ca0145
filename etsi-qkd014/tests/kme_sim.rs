//! The binary `kme-sim` as a user runs it.

mod program;
mod raw;

use std::collections::{BTreeMap, HashMap};
use std::io::{BufRead, BufReader};
use std::net::TcpListener;
use std::path::Path;
use std::process::{Command, Stdio};

use etsi_qkd014::Client;
use program::{Killed, kme_sim};

#[test]
fn wrong_arguments_end_with_status_2_and_create_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path().join("certs");
    let dir = dir.to_str().unwrap();
    let wrong: [&[&str]; 8] = [
        &[],
        &["init"],
        &["init", dir, "--kme"],
        &["init", dir, "--kme", "kme-a"],
        &["init", dir, "--kme", "kme-a=localhost=sae-a"],
        &["init", dir, "--kme", "kme-a=127.0.0.1:0=sae-a"],
        &["init", dir, "--what", "ever"],
        &["--run", dir],
    ];
    for args in wrong {
        let output = kme_sim().args(args).output().unwrap();
        assert_eq!(output.status.code(), Some(2), "{args:?}");
        assert!(String::from_utf8_lossy(&output.stderr).contains("--help"), "{args:?}");
    }
    for id in ["../up", "a/b", "", "ca", ".hidden"] {
        let site = format!("{id}=127.0.0.1:1=sae-a");
        let output = kme_sim().args(["init", dir, "--kme", &site]).output().unwrap();
        assert!(!output.status.success(), "{id}");
    }
    assert!(!Path::new(dir).exists());
    assert_eq!(kme_sim().args(["run", dir]).output().unwrap().status.code(), Some(1));
}

/// Returns a port that was free a moment ago.
fn port(address: &str) -> u16 {
    TcpListener::bind((address, 0)).unwrap().local_addr().unwrap().port()
}

#[tokio::test]
async fn the_environment_it_prints_serves_a_client() {
    let dir = tempfile::tempdir().unwrap();
    let certs = dir.path().join("it's here");
    let a = format!("kme-a=127.0.0.1:{}=sae-a", port("127.0.0.1"));
    let b = format!("kme-b=127.0.0.2:{}=sae-b", port("127.0.0.2"));
    let output =
        kme_sim().arg("init").arg(&certs).args(["--kme", &a, "--kme", &b]).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let printed = String::from_utf8(output.stdout).unwrap();

    let mut run = kme_sim();
    run.arg("run")
        .arg(&certs)
        .args(["--rate", "0", "--stored", "1", "--fault", "kme-a:reset,times=1,on=enc_keys"])
        .stdout(Stdio::piped());
    let mut run = Killed(run.spawn().unwrap());
    let mut lines = BufReader::new(run.0.stdout.take().unwrap()).lines();
    for kme in ["kme-a https://", "kme-b https://"] {
        assert!(lines.next().unwrap().unwrap().starts_with(kme));
    }

    // A shell reads the environment, as a user's would.
    let env = |sae: &str| {
        let part = printed.split("# ").find(|part| part.starts_with(sae)).unwrap();
        let exports = part.split_once('\n').unwrap().1;
        let script = format!("{exports}\nenv");
        let output = Command::new("sh").args(["-c", &script]).env_clear().output().unwrap();
        let text = String::from_utf8(output.stdout).unwrap();
        let pair = |line: &str| line.split_once('=').map(|(n, v)| (n.to_owned(), v.to_owned()));
        text.lines().filter_map(pair).collect::<HashMap<_, _>>()
    };
    let client = |env: HashMap<String, String>| {
        Client::builder()
            .kme_url(&env["AXON_KME_URL"])
            .kme_id(&env["AXON_KME_ID"])
            .ca_file(&env["AXON_KME_CA"])
            .sae_cert_file(&env["AXON_SAE_CERT"])
            .sae_key_file(&env["AXON_SAE_KEY"])
            .build()
            .unwrap()
    };
    let (master, slave) = (client(env("sae-a")), client(env("sae-b")));
    master.status("sae-b").await.unwrap();
    let error = master.enc_keys("nobody").send().await.err().expect("the fault");
    assert!(error.keys_may_be_consumed(), "{error}");
    let key = master.enc_keys("sae-b").send().await.unwrap().into_single();
    let same = slave.dec_keys("sae-a").key_id(key.key_id()).send().await.unwrap().into_single();
    assert!(key == same);
    assert!(master.enc_keys("sae-b").send().await.is_err(), "one key was stored");
}

/// Runs `kme-sim init` for two KMEs at free ports, and returns its output.
fn init(certs: &Path) -> String {
    let a = format!("kme-a=127.0.0.1:{}=sae-a", port("127.0.0.1"));
    let b = format!("kme-b=127.0.0.2:{}=sae-b", port("127.0.0.2"));
    let mut init = kme_sim();
    let output = init.arg("init").arg(certs).args(["--kme", &a, "--kme", &b]).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

#[test]
fn init_replaces_no_file_unless_it_is_told_to() {
    let contents = |dir: &Path| -> BTreeMap<_, _> {
        let files = std::fs::read_dir(dir).unwrap().map(|entry| entry.unwrap().path());
        files.map(|file| (file.clone(), std::fs::read(&file).unwrap_or_default())).collect()
    };
    let dir = tempfile::tempdir().unwrap();
    let certs = dir.path().join("certs");
    init(&certs);
    let before = contents(&certs);
    for name in ["ca.pem", "layout.json", "kme-a.crt", "kme-b.key", "sae-a.crt", "sae-b.key"] {
        // One such file alone is enough.
        let other = dir.path().join(name.replace('.', "-"));
        std::fs::create_dir(&other).unwrap();
        std::fs::write(other.join(name), "theirs").unwrap();
        let of_other = contents(&other);
        let output = kme_sim().arg("init").arg(&other).output().unwrap();
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!((output.status.code(), output.stdout.len()), (Some(1), 0), "{name}: {said}");
        assert!(said.contains(name) && said.contains("--force"), "{name}: {said}");
        assert_eq!(contents(&other), of_other, "{name}");
    }
    // A link that leads nowhere is something of theirs as well.
    let linked = dir.path().join("linked");
    std::fs::create_dir(&linked).unwrap();
    std::os::unix::fs::symlink("/nowhere/ca", linked.join("ca.pem")).unwrap();
    assert_eq!(kme_sim().arg("init").arg(&linked).output().unwrap().status.code(), Some(1));

    let output = kme_sim().arg("init").arg(&certs).output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    assert_eq!(contents(&certs), before);
    let output = kme_sim().arg("init").arg(&certs).arg("--force").output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let after = contents(&certs);
    assert!(after.keys().eq(before.keys()));
    assert!(after[&certs.join("sae-a.key")] != before[&certs.join("sae-a.key")]);
    // Other files are none of its business.
    let beside = dir.path().join("beside");
    std::fs::create_dir(&beside).unwrap();
    std::fs::write(beside.join("notes.txt"), "theirs").unwrap();
    init(&beside);
    assert_eq!(std::fs::read(beside.join("notes.txt")).unwrap(), b"theirs");
}

/// The requests are of clients in the field; the specification neither lists nor forbids them.
#[tokio::test]
async fn the_program_is_lenient_unless_it_is_told_to_be_strict() {
    let head = "POST /api/v1/keys/sae-b/enc_keys HTTP/1.1\r\nHost: x\r\n\
                Content-Type: application/json\r\n";
    let chunked = "Transfer-Encoding: chunked\r\n\r\n2\r\n{}\r\n0\r\n\r\n";
    let requests = [
        (400, raw::post("sae-b/enc_keys", r#"{"number":1,"client":"field"}"#)),
        (400, raw::post("sae-b/enc_keys", r#"{"number":1,"size":null}"#)),
        (400, raw::post("sae-b/enc_keys", "")),
        (411, format!("{head}{chunked}")),
        (400, raw::get("sae-b/enc_keys?number=1&trace=on")),
    ];
    for strict in [false, true] {
        let dir = tempfile::tempdir().unwrap();
        init(dir.path());
        let mut run = kme_sim();
        run.arg("run").arg(dir.path()).args(strict.then_some("--strict")).stdout(Stdio::piped());
        let mut run = Killed(run.spawn().unwrap());
        let mut lines = BufReader::new(run.0.stdout.take().unwrap()).lines();
        let line = lines.next().unwrap().unwrap();
        let addr = line.strip_prefix("kme-a https://").unwrap().parse().unwrap();
        let file = |name: &str| std::fs::read_to_string(dir.path().join(name)).unwrap();
        let tls = raw::with_pair(&file("ca.pem"), &file("sae-a.crt"), &file("sae-a.key"));
        for (refused, request) in &requests {
            let mut connection = raw::open(&tls, addr).await.unwrap();
            connection.send(request).await.unwrap();
            let answer = connection.answer().await.expect("an answer");
            let wanted = if strict { *refused } else { 200 };
            assert_eq!(answer.status, wanted, "strict {strict}, {request}: {}", answer.body);
        }
        let mut connection = raw::open(&tls, addr).await.unwrap();
        connection.send(&raw::post("sae-b/enc_keys", "{}")).await.unwrap();
        assert_eq!(connection.answer().await.unwrap().status, 200, "strict {strict}");
    }
}
