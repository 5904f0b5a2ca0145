//! The binary `kme-sim` as a user runs it.

mod program;

use std::collections::HashMap;
use std::io::{BufRead, BufReader};
use std::net::TcpListener;
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
    assert!(!std::path::Path::new(dir).exists());
    assert_eq!(kme_sim().args(["run", dir]).output().unwrap().status.code(), Some(1));
}

/// A port that was free a moment ago.
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
