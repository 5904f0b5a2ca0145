//! The simulator under an SAE pair that shares no code with this crate, `python/sae.py`, written
//! from the text of the specification in Python's standard library.

mod python;

use etsi_qkd014::sim::{Fault, FaultPlan, Method, Network};
use serde_json::{Value, json};

async fn network() -> Network {
    Network::builder()
        .kme("kme-a", "127.0.0.1:0".parse().unwrap(), ["sae-a", "sae-c"])
        .kme("kme-b", "127.0.0.2:0".parse().unwrap(), ["sae-b"])
        .strict()
        .start()
        .await
        .unwrap()
}

/// Runs `sae.py` through the network. Returns its output, or `None` without Python.
async fn walk(network: &Network) -> Option<Result<String, String>> {
    let dir = tempfile::tempdir().unwrap();
    network.write_files(dir.path()).unwrap();
    let role = |id: &str| -> Value {
        let sae = network.sae(id).unwrap();
        let file = |name: String| dir.path().join(name);
        json!({
            "id": id,
            "url": sae.kme_url(),
            "kme": sae.kme_id(),
            "ca": file("ca.pem".into()),
            "cert": file(format!("{id}.crt")),
            "key": file(format!("{id}.key")),
        })
    };
    let settings =
        json!({ "master": role("sae-a"), "slave": role("sae-b"), "third": role("sae-c") });
    let file = dir.path().join("settings.json");
    std::fs::write(&file, settings.to_string()).unwrap();
    let run = tokio::task::spawn_blocking(move || python::sae(&file));
    let output = run.await.unwrap()?;
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    Some(if output.status.success() { Ok(text(output.stdout)) } else { Err(text(output.stderr)) })
}

#[tokio::test(flavor = "multi_thread")]
async fn a_python_sae_finds_the_simulator_as_specified() {
    let network = network().await;
    let Some(outcome) = walk(&network).await else { return };
    let checks: u32 = outcome.unwrap().trim().parse().unwrap();
    assert!(checks > 600, "{checks} checks only");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_python_sae_detects_kme_faults() {
    for (fault, found) in [
        (Fault::WrongLength, "the size asked for"),
        (Fault::KeyMissing, "the number of keys"),
        (Fault::OtherIds, "5.4: the same key"),
        (Fault::WrongMediaType, "5.1: content type"),
    ] {
        let network = network().await;
        network.kme("kme-b").unwrap().plan(FaultPlan::new(fault.clone()).on(Method::DecKeys));
        let Some(outcome) = walk(&network).await else { return };
        let said = outcome.unwrap_err();
        assert!(said.contains(found), "{fault:?}: {said}");
    }
}
