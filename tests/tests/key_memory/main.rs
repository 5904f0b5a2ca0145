//! Thousands of keys leave no trace on the heap: after each thousand, drawn in batches and dropped,
//! a client, its slave and a pool have as many bytes in use as before.
//!
//! The test counts the bytes in use by Rust's allocator in this process, not the memory that the system gives the
//! process. The KMEs run in a process of their own, since a KME that remembers its keys grows.
//!
//! The tests are here and not with the crate, which forbids unsafe code: an allocator needs it.

#[path = "../kmes/mod.rs"]
mod kmes;
mod live;

use std::time::Duration;

use etsi_qkd014::pool::Ledger;
use etsi_qkd014::{Client, Key, KeyPool};
use kmes::Kmes;
use tokio::runtime::{Builder, Runtime};

const BATCH: u32 = 100;
const BATCHES: usize = 10;
/// Rounds until every buffer and table has found its size: hyper's for reading in the fourth, the
/// ledger's table in the sixth.
const WARM_UP: usize = 10;
const ROUNDS: usize = 20;

/// The KMEs' process.
#[test]
fn kmes() {
    kmes::serve_if_asked(BATCH.into(), |_| None);
}

fn client(kmes: &Kmes, sae: &str) -> Client {
    kmes.simulated(sae).build().unwrap()
}

/// Checks the bytes in use after each round. The rounds after the warm-up must not need more than the warm-up did.
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

/// Creates a runtime with one thread, so that its tasks hold the same memory at rest each time.
fn runtime() -> Runtime {
    Builder::new_current_thread().enable_all().build().unwrap()
}

#[test]
fn a_client_and_its_slave() {
    let _turn = live::turn();
    let kmes = Kmes::start();
    runtime().block_on(async {
        let (master, slave) = (client(&kmes, "sae-a"), client(&kmes, "sae-b"));
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
        let pool = KeyPool::builder(client(&kmes, "sae-a"), "sae-b")
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
