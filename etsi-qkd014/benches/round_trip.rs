//! What the client's checks and the pool cost: round trips against the simulator on loopback, each
//! beside the same request by bare reqwest clients, and the hand-out of a pool.
//!
//! Two bare calls send the same bytes over the same kind of connection (mutual TLS, kept alive). One
//! reads the whole body and leaves it at that; the other has the keys in the end, as the client has:
//! serde_json makes the body into structs, and base64 decodes each key. Neither checks or zeroizes
//! anything. The three take turns, so that whatever else the machine does meets all; medians are
//! compared. Budgets: a ratio of 1.1, and 1 microsecond.

#![allow(clippy::print_stdout, reason = "a benchmark prints its figures")]

use std::hint::black_box;
use std::time::{Duration, Instant};

use base64::prelude::{BASE64_STANDARD, Engine};
use bytes::Bytes;
use criterion::Criterion;
use etsi_qkd014::pool::Ledger;
use etsi_qkd014::sim::Network;
use etsi_qkd014::{Client, KeyPool, RetryPolicy};
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use serde::Deserialize;
use serde_json::json;
use tokio::runtime::Runtime;

const ROUNDS: usize = 1000;
const WARM_UP: usize = 50;

struct Bed {
    network: Network,
    master: Client,
    slave: Client,
    bare: [reqwest::Client; 2],
}

impl Bed {
    async fn start() -> Self {
        let network = Network::builder()
            .strict()
            .kme("kme-a", "127.0.0.1:0".parse().unwrap(), ["sae-a"])
            .kme("kme-b", "127.0.0.2:0".parse().unwrap(), ["sae-b"])
            .start()
            .await
            .unwrap();
        let client = |sae| network.client_builder(sae).retry(RetryPolicy::none()).build().unwrap();
        let (master, slave) = (client("sae-a"), client("sae-b"));
        let bare = ["sae-a", "sae-b"].map(|sae| bare(&network, sae));
        Self { network, master, slave, bare }
    }

    fn url(&self, kme: &str, rest: &str) -> String {
        format!("{}/api/v1/keys/{rest}", self.network.kme(kme).unwrap().url())
    }
}

fn bare(network: &Network, sae: &str) -> reqwest::Client {
    let sae = network.sae(sae).unwrap();
    let mut roots = rustls::RootCertStore::empty();
    roots.add(CertificateDer::from_pem_slice(sae.ca_pem().as_bytes()).unwrap()).unwrap();
    let chain = vec![CertificateDer::from_pem_slice(sae.cert_pem().as_bytes()).unwrap()];
    let key = PrivateKeyDer::from_pem_slice(sae.key_pem().as_bytes()).unwrap();
    let provider = rustls::crypto::aws_lc_rs::default_provider();
    let tls = rustls::ClientConfig::builder_with_provider(provider.into())
        .with_safe_default_protocol_versions()
        .unwrap()
        .with_root_certificates(roots)
        .with_client_auth_cert(chain, key)
        .unwrap();
    reqwest::Client::builder().tls_backend_preconfigured(tls).no_proxy().build().unwrap()
}

async fn bare_post(client: &reqwest::Client, url: &str, body: &serde_json::Value) -> Bytes {
    let request = client.post(url).header("content-type", "application/json");
    let answer = request.body(body.to_string()).send().await.unwrap();
    assert_eq!(answer.status().as_u16(), 200);
    answer.bytes().await.unwrap()
}

#[derive(Deserialize)]
struct BareContainer {
    keys: Vec<BareKey>,
}

#[derive(Deserialize)]
struct BareKey {
    #[serde(rename = "key_ID")]
    key_id: String,
    key: String,
}

/// The IDs and keys of an answer, as they come.
fn bare_keys(body: &[u8]) -> Vec<(String, Vec<u8>)> {
    let container: BareContainer = serde_json::from_slice(body).unwrap();
    let key = |key: BareKey| (key.key_id, BASE64_STANDARD.decode(key.key).unwrap());
    container.keys.into_iter().map(key).collect()
}

fn median(mut times: Vec<Duration>) -> Duration {
    times.sort_unstable();
    times[times.len() / 2]
}

/// The times of one request: by the client, by a bare call, and by one that has the keys.
#[derive(Default)]
struct Times([Vec<Duration>; 3]);

impl Times {
    /// The order of the three in this round: a later one may profit from an earlier one.
    fn turns(round: usize) -> [usize; 3] {
        [round % 3, (round + 1) % 3, (round + 2) % 3]
    }

    fn add(&mut self, round: usize, turn: usize, time: Duration) {
        if round >= WARM_UP {
            self.0[turn].push(time);
        }
    }

    fn compare(self, what: &str) {
        let [client, bare, with_keys] = self.0.map(median);
        let against = |other: Duration| {
            let ratio = client.as_secs_f64() / other.as_secs_f64();
            let verdict = if ratio <= 1.1 { "within" } else { "OVER" };
            format!("{other:?}, ratio {ratio:.3} ({verdict} 1.1)")
        };
        let (bare, with_keys) = (against(bare), against(with_keys));
        println!("{what}: {client:?}; bare reqwest {bare}; bare with keys {with_keys}");
    }
}

async fn enc_keys(bed: &Bed, number: u32) {
    let url = bed.url("kme-a", "sae-b/enc_keys");
    let body = json!({ "number": number, "size": 256 });
    let mut times = Times::default();
    for round in 0..WARM_UP + ROUNDS {
        for turn in Times::turns(round) {
            let began = Instant::now();
            match turn {
                0 => {
                    let request = bed.master.enc_keys("sae-b").number(number).size(256);
                    drop(black_box(request.send().await.unwrap()));
                }
                1 => drop(black_box(bare_post(&bed.bare[0], &url, &body).await)),
                _ => drop(black_box(bare_keys(&bare_post(&bed.bare[0], &url, &body).await))),
            }
            times.add(round, turn, began.elapsed());
        }
    }
    times.compare(&format!("enc_keys, {number} of 256 bit"));
}

async fn dec_keys(bed: &Bed, number: u32) {
    let url = bed.url("kme-b", "sae-a/dec_keys");
    let mut times = Times::default();
    for round in 0..WARM_UP + ROUNDS {
        for turn in Times::turns(round) {
            let drawn = bed.master.enc_keys("sae-b").number(number).size(256).send().await.unwrap();
            let ids: Vec<String> = drawn.keys.iter().map(|key| key.key_id().to_owned()).collect();
            let objects: Vec<_> = ids.iter().map(|id| json!({ "key_ID": id })).collect();
            let body = json!({ "key_IDs": objects });
            let began = Instant::now();
            match turn {
                0 => {
                    let request = bed.slave.dec_keys("sae-a").key_ids(ids).size(256);
                    drop(black_box(request.send().await.unwrap()));
                }
                1 => drop(black_box(bare_post(&bed.bare[1], &url, &body).await)),
                _ => drop(black_box(bare_keys(&bare_post(&bed.bare[1], &url, &body).await))),
            }
            times.add(round, turn, began.elapsed());
        }
    }
    times.compare(&format!("dec_keys, {number} of 256 bit"));
}

/// Takes from a pool that holds enough, in runs of 256, with refills in between and the time of
/// each run alone. What a take wakes runs on another thread meanwhile, as it does in earnest.
fn hand_out(criterion: &mut Criterion, runtime: &Runtime, bed: &Bed) {
    for (name, ledger) in ledgers() {
        let builder = KeyPool::builder(bed.master.clone(), "sae-b").size(256);
        let _inside = runtime.enter();
        let pool = builder.target(1024).batch(128).ledger(ledger).build().unwrap();
        criterion.bench_function(&format!("pool hand-out, {name}"), |bencher| {
            bencher.iter_custom(|takes| {
                let (mut left, mut time) = (takes, Duration::ZERO);
                while left > 0 {
                    while pool.status().held < 512 {
                        std::thread::sleep(Duration::from_micros(200));
                    }
                    let run = left.min(256);
                    let mut taken = Vec::with_capacity(256);
                    let began = Instant::now();
                    for _ in 0..run {
                        taken.push(black_box(pool.try_take()));
                    }
                    time += began.elapsed();
                    assert!(taken.iter().all(Option::is_some));
                    left -= run;
                }
                time
            });
        });
    }
}

fn ledgers() -> Vec<(&'static str, Ledger)> {
    #[cfg(unix)]
    {
        let dir = tempfile::tempdir().unwrap();
        // The open file outlives its directory.
        let file = Ledger::file(dir.path().join("ledger")).unwrap();
        vec![("ledger in memory", Ledger::default()), ("ledger in a file", file)]
    }
    #[cfg(not(unix))]
    vec![("ledger in memory", Ledger::default())]
}

/// Memory of the process over ten times 1,000 keys in batches of 100: KME, client and all. The
/// KME forgets each key once the slave has it.
async fn memory(bed: &Bed) {
    let mut resident = Vec::new();
    for _ in 0..10 {
        for _ in 0..10 {
            let drawn = bed.master.enc_keys("sae-b").number(100).size(256).send().await.unwrap();
            let ids = drawn.keys.iter().map(|key| key.key_id());
            black_box(bed.slave.dec_keys("sae-a").key_ids(ids).send().await.unwrap());
        }
        let Ok(statm) = std::fs::read_to_string("/proc/self/statm") else { return };
        resident.push(statm.split(' ').nth(1).and_then(|pages| pages.parse::<u64>().ok()));
    }
    let pages: Vec<u64> = resident.into_iter().flatten().collect();
    println!("resident pages after each 1,000 keys: {pages:?}");
}

fn main() {
    let runtime = Runtime::new().unwrap();
    let bed = runtime.block_on(Bed::start());
    // Under `cargo test --benches` only that it runs.
    if !std::env::args().any(|argument| argument == "--bench") {
        runtime.block_on(memory(&bed));
        return;
    }
    let mut criterion = Criterion::default().configure_from_args();
    hand_out(&mut criterion, &runtime, &bed);
    criterion.final_summary();
    runtime.block_on(async {
        memory(&bed).await;
        for number in [1, 8, 100] {
            enc_keys(&bed, number).await;
            dec_keys(&bed, number).await;
        }
    });
}
