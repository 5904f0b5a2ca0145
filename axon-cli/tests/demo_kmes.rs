//! The demo over KMEs that run in a process of their own, with SAE names of their own.

#![forbid(unsafe_code)]

mod common;

use std::{
    io::{BufRead, BufReader, Read},
    path::Path,
    process::{Child, Command, Stdio},
};

use common::{Stderr, axon};
use etsi_qkd014::sim::Network;
use serde_json::Value;

const DIR: &str = "DEMO_KMES_DIR";

/// Not a test of its own: the process of the KMEs, which ends when its standard input ends.
#[test]
#[ignore = "started by the other tests"]
#[allow(clippy::print_stdout, reason = "this is how it speaks to the test")]
fn kmes() {
    let dir = std::env::var_os(DIR).expect("a directory");
    let dir = Path::new(&dir);
    let runtime = tokio::runtime::Runtime::new().expect("a runtime");
    runtime.block_on(async {
        let network = Network::builder()
            .strict()
            .kme("kme-1", ([127, 0, 0, 1], 0).into(), ["sae-1"])
            .kme("kme-2", ([127, 0, 0, 2], 0).into(), ["sae-2"])
            .start()
            .await
            .expect("KMEs");
        network.write_files(dir).expect("files");
        for sae in network.saes() {
            let lines = sae.env(dir).into_iter().map(|(k, v)| format!("export {k}='{v}'\n"));
            let text = format!("# {}\n{}", sae.id(), lines.collect::<String>());
            std::fs::write(dir.join(format!("{}.env", sae.id())), text).expect("a file");
        }
        println!("\nready");
        let ended = tokio::task::spawn_blocking(|| std::io::stdin().read(&mut [0]));
        let _ = ended.await;
        for kme in network.kmes() {
            println!("{} gave {}", kme.id(), kme.counters().keys_to_masters);
        }
    });
}

struct Kmes {
    child: Child,
    said: BufReader<std::process::ChildStdout>,
}

impl Kmes {
    fn start(dir: &Path) -> Self {
        let this = std::env::current_exe().expect("this program");
        let mut child = Command::new(this)
            .args(["--ignored", "--exact", "kmes", "--nocapture"])
            .env(DIR, dir)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .expect("it starts");
        let mut said = BufReader::new(child.stdout.take().expect("a pipe"));
        let mut line = String::new();
        while line.trim() != "ready" {
            line.clear();
            assert!(said.read_line(&mut line).expect("text") > 0, "the KMEs did not start");
        }
        Self { child, said }
    }

    /// Ends the process, and returns its output.
    fn end(&mut self) -> String {
        drop(self.child.stdin.take());
        let mut text = String::new();
        self.said.read_to_string(&mut text).expect("text");
        text
    }
}

impl Drop for Kmes {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[test]
fn a_file_that_cannot_be_used_is_named_and_nothing_is_shown() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let whole = dir.path().join("whole.env");
    let text: String = ["KME_URL", "KME_CA", "SAE_ID", "SAE_CERT", "SAE_KEY"]
        .iter()
        .map(|name| format!("export AXON_{name}='x'\n"))
        .collect();
    std::fs::write(&whole, &text).expect("a file");
    let half = dir.path().join("half.env");
    std::fs::write(&half, text.replace("export AXON_SAE_KEY='x'\n", "")).expect("a file");
    let missing = dir.path().join("missing.env");
    for (files, named) in [
        (vec![&whole], "given 1 times"),
        (vec![&whole; 3], "given 3 times"),
        (vec![&whole, &half], "AXON_SAE_KEY is not set"),
        (vec![&missing, &whole], "missing.env"),
        (vec![&whole, &whole], "both hosts"),
    ] {
        let mut command = axon([]);
        command.arg("demo");
        for file in files {
            command.arg("--kme-env").arg(file);
        }
        let output = command.output().expect("the demo starts");
        let errors = Stderr::of(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{errors}");
        assert!(errors.contains(named) && output.stdout.is_empty(), "{errors}");
    }
}

#[test]
fn kmes_of_another_process_carry_every_route() {
    let dir = tempfile::tempdir().expect("a temporary directory");
    let mut kmes = Kmes::start(dir.path());
    let output = axon([])
        .args(["demo", "--json", "--rate", "400"])
        .arg("--kme-env")
        .arg(dir.path().join("sae-1.env"))
        .arg("--kme-env")
        .arg(dir.path().join("sae-2.env"))
        .output()
        .expect("the demo starts");
    let errors = Stderr::of(&output.stderr);
    let report: Value = serde_json::from_slice(&output.stdout)
        .unwrap_or_else(|e| panic!("no report: {e}; standard error:\n{errors}"));
    assert_eq!(report["passed"], true, "{report:#}\n{errors}");
    let routes = report["routes"].as_array().expect("routes");
    assert_eq!(routes.len(), 4);
    for route in routes {
        assert_eq!(route["messages"], 5964, "{route:#}");
        assert_eq!(route["kme_keys"], Value::Null, "KMEs elsewhere do not tell: {route:#}");
    }
    assert_eq!(report["wrong_peers"].as_array().map(Vec::len), Some(8));

    // The keys are the other process's.
    let said = kmes.end();
    let gave = said.lines().filter_map(|line| line.rsplit_once(" gave ")?.1.parse::<u64>().ok());
    let gave: u64 = gave.sum();
    assert!(gave >= 597, "{gave} keys for 5,964 messages twice: {said}");
}
