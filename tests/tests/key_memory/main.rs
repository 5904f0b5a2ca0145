//! Thousands of keys leave no trace on the heap: after each thousand, drawn in batches and dropped,
//! a client, its slave and a pool have as many bytes in use as before.
//!
//! What is counted is what this process has in use by Rust's allocator, not what the system lends
//! it. The KMEs run in a process of their own, since a KME that remembers what it gave grows.
//!
//! Here and not with the crate, which forbids unsafe code: an allocator needs it.

mod live;

use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::time::Duration;

use etsi_qkd014::pool::Ledger;
use etsi_qkd014::sim::Network;
use etsi_qkd014::{Client, Key, KeyPool, RetryPolicy};
use tokio::runtime::{Builder, Runtime};

/// Tells the test binary that it is to be the KMEs, and where to write their certificates.
const VARIABLE: &str = "AXON_MEMORY_KMES";
const BATCH: u32 = 100;
const BATCHES: usize = 10;
/// Rounds until every buffer and table has found its size: hyper's for reading in the fourth, the
/// ledger's table in the sixth.
const WARM_UP: usize = 10;
const ROUNDS: usize = 20;

/// The KMEs' process.
#[test]
fn kmes() {
    let Some(dir) = std::env::var_os(VARIABLE).map(PathBuf::from) else { return };
    let runtime = Runtime::new().unwrap();
    let network = Network::builder()
        .strict()
        .kme("kme-a", "127.0.0.1:0".parse().unwrap(), ["sae-a"])
        .kme("kme-b", "127.0.0.1:0".parse().unwrap(), ["sae-b"])
        .max_keys_per_request(BATCH.into())
        .start();
    let network = runtime.block_on(network).unwrap();
    network.write_files(&dir).unwrap();
    let urls = network.kmes().iter().map(|kme| kme.url()).collect::<Vec<_>>().join(" ");
    std::io::stdout().write_all(format!("KMEs: {urls}\n").as_bytes()).unwrap();
    axon_tests::end_with_stdin();
}

struct Kmes {
    child: Child,
    _stdin: ChildStdin,
    dir: tempfile::TempDir,
    urls: Vec<String>,
}

impl Kmes {
    fn start() -> Self {
        let dir = tempfile::tempdir().unwrap();
        let mut child = Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "kmes", "--nocapture"])
            .env(VARIABLE, dir.path())
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let stdin = child.stdin.take().unwrap();
        let lines = BufReader::new(child.stdout.take().unwrap()).lines();
        let urls = lines
            .map_while(Result::ok)
            .find_map(|line| Some(line.split_once("KMEs: ")?.1.to_owned()))
            .expect("the child must say where its KMEs are");
        let urls = urls.split(' ').map(str::to_owned).collect();
        Self { child, _stdin: stdin, dir, urls }
    }

    fn client(&self, sae: &str) -> Client {
        let file = |name: &str| -> PathBuf { Path::new(self.dir.path()).join(name) };
        Client::builder()
            .kme_url(&self.urls[usize::from(sae == "sae-b")])
            .ca_file(file("ca.pem"))
            .sae_cert_file(file(&format!("{sae}.crt")))
            .sae_key_file(file(&format!("{sae}.key")))
            .retry(RetryPolicy::none())
            .build()
            .unwrap()
    }
}

impl Drop for Kmes {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Bytes in use after each round. The rounds after the warm-up must not need more than it did.
async fn no_growth(what: &str, mut round: impl AsyncFnMut()) {
    let mut used = Vec::with_capacity(WARM_UP + ROUNDS);
    for _ in 0..WARM_UP + ROUNDS {
        round().await;
        // The connections' tasks come to rest.
        tokio::time::sleep(Duration::from_millis(20)).await;
        used.push(live::bytes());
    }
    eprintln!("{what}: bytes in use after each {} keys: {used:?}", BATCH as usize * BATCHES);
    let (before, after) = used.split_at(WARM_UP);
    assert!(after.iter().max() <= before.iter().max(), "{what} grows: {used:?}");
}

/// One thread: what its tasks hold at rest is the same each time.
fn runtime() -> Runtime {
    Builder::new_current_thread().enable_all().build().unwrap()
}

#[test]
fn a_client_and_its_slave() {
    let _turn = live::turn();
    let kmes = Kmes::start();
    runtime().block_on(async {
        let (master, slave) = (kmes.client("sae-a"), kmes.client("sae-b"));
        no_growth("clients", async || {
            for _ in 0..BATCHES {
                let drawn = master.enc_keys("sae-b").number(BATCH).size(256).send().await.unwrap();
                let ids = drawn.keys.iter().map(Key::key_id);
                let same = slave.dec_keys("sae-a").key_ids(ids).size(256).send().await.unwrap();
                assert!(same.keys == drawn.keys);
            }
        })
        .await;
    });
}

#[test]
fn a_pool_with_a_ledger_that_is_full() {
    let _turn = live::turn();
    let kmes = Kmes::start();
    runtime().block_on(async {
        let held = 2 * BATCH as usize;
        let pool = KeyPool::builder(kmes.client("sae-a"), "sae-b")
            .size(256)
            .target(held)
            .batch(BATCH)
            .calls(1)
            .ledger(Ledger::memory(500))
            .build()
            .unwrap();
        no_growth("pool", async || {
            for _ in 0..BATCHES * BATCH as usize {
                let deadline = tokio::time::Instant::now() + Duration::from_secs(30);
                pool.take(deadline).await.unwrap();
            }
            while pool.status().held < held || pool.status().asked > 0 {
                tokio::time::sleep(Duration::from_millis(1)).await;
            }
        })
        .await;
    });
}
