//! The README's example, run against a simulated KME.

use etsi_qkd014::sim::Network;
use etsi_qkd014::{Client, secrecy::ExposeSecret};

/// The text between the marks is the README's.
#[allow(clippy::print_stdout, reason = "the README prints")]
async fn example() -> Result<(), etsi_qkd014::Error> {
    // From here
    let of = |name| std::env::var(name).expect("kme-sim prints it");
    let client = Client::builder()
        .kme_url(of("AXON_KME_URL"))
        .ca_file(of("AXON_KME_CA"))
        .sae_cert_file(of("AXON_SAE_CERT"))
        .sae_key_file(of("AXON_SAE_KEY"))
        .build()?;
    let key = client.enc_keys("sae-b").size(256).send().await?.into_single();
    println!("tell sae-b: {}", key.key_id());
    let _secret: &[u8] = key.expose_secret();
    // to here.
    Ok(())
}

fn lines(text: &str) -> Vec<&str> {
    text.lines().map(str::trim).filter(|line| !line.is_empty()).collect()
}

#[test]
fn the_readme_has_the_text_that_is_run() {
    let (_, run) = include_str!("readme.rs").split_once("// From here\n").unwrap();
    let (run, _) = run.split_once("// to here.\n").unwrap();
    let (_, told) = include_str!("../README.md").split_once("etsi_qkd014::Error> {\n").unwrap();
    let (told, _) = told.split_once("    Ok(())\n}\n").unwrap();
    assert_eq!(lines(run), lines(told));
    assert_eq!(lines(told).len(), 10);
}

#[tokio::test]
async fn the_readme_example_draws_a_key_that_the_other_side_gets() {
    let network = Network::builder()
        .strict()
        .kme("kme-a", "127.0.0.1:0".parse().unwrap(), ["sae-a"])
        .kme("kme-b", "127.0.0.1:0".parse().unwrap(), ["sae-b"])
        .start()
        .await
        .unwrap();
    let dir = tempfile::tempdir().unwrap();
    network.write_files(dir.path()).unwrap();
    let child = tokio::task::spawn_blocking({
        let environment = network.sae("sae-a").unwrap().env(dir.path());
        move || {
            std::process::Command::new(std::env::current_exe().unwrap())
                .args(["--exact", "the_example_itself", "--nocapture"])
                .env("ETSI_TEST_README", "1")
                .envs(environment)
                .output()
        }
    });
    let output = child.await.unwrap().unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success(), "{text}");
    let (_, id) = text.split_once("tell sae-b: ").unwrap();
    let slave = network.client_builder("sae-b").build().unwrap();
    let key = slave.dec_keys("sae-a").key_id(id.lines().next().unwrap()).send().await.unwrap();
    assert_eq!(key.into_single().len(), 32);
}

/// Run by the test above, with its environment.
#[tokio::test]
async fn the_example_itself() {
    if std::env::var_os("ETSI_TEST_README").is_some() {
        example().await.unwrap();
    }
}
