//! The simulator's promises while many ask at once: keys are spent once, delivered once, and the
//! status is true all along.

use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::SeqCst};
use std::time::{Duration, Instant};

use etsi_qkd014::sim::{FillRate, Network, NetworkBuilder};
use etsi_qkd014::{Client, Error, Key, RetryPolicy};
use tokio::task::JoinSet;

fn two() -> NetworkBuilder {
    Network::builder()
        .strict()
        .kme("kme-a", "127.0.0.1:0".parse().unwrap(), ["sae-a", "sae-c"])
        .kme("kme-b", "127.0.0.2:0".parse().unwrap(), ["sae-b"])
}

fn client(network: &Network, sae: &str) -> Client {
    network.client_builder(sae).retry(RetryPolicy::none()).build().unwrap()
}

fn ids(keys: &[Key]) -> Vec<String> {
    keys.iter().map(|key| key.key_id().to_owned()).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_key_wanted_by_many_at_once_is_given_once() {
    let network = two().start().await.unwrap();
    let drawn = client(&network, "sae-a").enc_keys("sae-b").number(20).send().await.unwrap().keys;
    // Connections of their own, so that the requests meet.
    let clients: Vec<_> = (0..16).map(|_| client(&network, "sae-b")).collect();
    for key in &drawn {
        let mut tasks = JoinSet::new();
        for client in &clients {
            let (client, id) = (client.clone(), key.key_id().to_owned());
            tasks.spawn(async move { client.dec_keys("sae-a").key_id(id).send().await });
        }
        let mut given = 0;
        for result in tasks.join_all().await {
            match result {
                Ok(container) => {
                    assert!(container.into_single() == *key);
                    given += 1;
                }
                Err(error) => assert!(matches!(error, Error::BadRequest { .. }), "{error}"),
            }
        }
        assert_eq!(given, 1);
    }
    assert_eq!(network.kme("kme-b").unwrap().counters().keys_to_slaves, 20);
}

#[tokio::test(flavor = "multi_thread")]
async fn of_batches_that_overlap_each_is_given_whole_or_not_at_all() {
    let network = two().start().await.unwrap();
    let drawn = client(&network, "sae-a").enc_keys("sae-b").number(64).send().await.unwrap().keys;
    let all = ids(&drawn);
    let mut tasks = JoinSet::new();
    for start in 0..16 {
        let client = client(&network, "sae-b");
        // Eight keys each, half of them also those of the next.
        let batch: Vec<_> = (0..8).map(|n| all[(start * 4 + n) % all.len()].clone()).collect();
        tasks.spawn(async move { client.dec_keys("sae-a").key_ids(batch).send().await });
    }
    let mut given = HashMap::new();
    for container in tasks.join_all().await.into_iter().flatten() {
        assert_eq!(container.keys.len(), 8);
        for key in container.keys {
            let id = key.key_id().to_owned();
            assert!(given.insert(id, key).is_none(), "given twice");
        }
    }
    assert!(!given.is_empty());
    // Keys that no caller got are still in the store.
    let slave = client(&network, "sae-b");
    for key in &drawn {
        let same = match given.remove(key.key_id()) {
            Some(same) => same,
            None => {
                let answer = slave.dec_keys("sae-a").key_id(key.key_id()).send().await;
                answer.unwrap().into_single()
            }
        };
        assert!(same == *key);
    }
    assert_eq!(network.kme("kme-b").unwrap().counters().keys_to_slaves, 64);
}

#[tokio::test(flavor = "multi_thread")]
async fn each_slave_of_a_multicast_gets_the_key_once_while_others_ask() {
    let network = two().start().await.unwrap();
    let master = client(&network, "sae-a");
    let request = master.enc_keys("sae-b").additional_slave_sae_ids(["sae-c"]).number(10);
    let drawn = request.send().await.unwrap().keys;
    let mut tasks = JoinSet::new();
    for key in &drawn {
        for sae in ["sae-b", "sae-c"].repeat(4) {
            let (client, id) = (client(&network, sae), key.key_id().to_owned());
            tasks.spawn(async move {
                let answer = client.dec_keys("sae-a").key_id(id).send().await;
                answer.ok().map(|container| (sae, container.into_single()))
            });
        }
    }
    let given: Vec<_> = tasks.join_all().await.into_iter().flatten().collect();
    let names: BTreeSet<_> = given.iter().map(|(sae, key)| (*sae, key.key_id())).collect();
    assert_eq!((given.len(), names.len()), (20, 20));
    for (_, key) in &given {
        assert!(drawn.iter().any(|other| other == key && other.key_id() == key.key_id()));
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn the_stock_is_spent_once_and_the_status_is_true_all_along() {
    const STOCK: u64 = 400;
    let builder = two().fill_rate(FillRate::PerSecond(0.0)).initially_stored(STOCK);
    let network = builder.start().await.unwrap();
    // Keys in requests that have begun, and in answers that have come.
    let (begun, came) = (Arc::new(AtomicU64::new(0)), Arc::new(AtomicU64::new(0)));
    let over = Arc::new(AtomicBool::new(false));
    let mut watchers = JoinSet::new();
    // A link has two ends, and both tell of the same stock.
    for (sae, other) in [("sae-a", "sae-b"), ("sae-b", "sae-a"), ("sae-c", "sae-b")] {
        let client = client(&network, sae);
        let (begun, came, over) = (Arc::clone(&begun), Arc::clone(&came), Arc::clone(&over));
        watchers.spawn(async move {
            let (mut last, mut looks) = (STOCK, 0);
            while !over.load(SeqCst) {
                let most = STOCK - came.load(SeqCst);
                let stored = client.status(other).await.unwrap().stored_key_count;
                let least = STOCK.saturating_sub(begun.load(SeqCst));
                assert!((least..=most.min(last)).contains(&stored), "{least} {stored} {most}");
                (last, looks) = (stored, looks + 1);
            }
            looks
        });
    }
    let mut drawers = JoinSet::new();
    for task in 0..12_u32 {
        // Both ends draw.
        let (sae, slave) = if task % 3 == 0 { ("sae-b", "sae-a") } else { ("sae-a", "sae-b") };
        let client = client(&network, sae);
        let (begun, came) = (Arc::clone(&begun), Arc::clone(&came));
        drawers.spawn(async move {
            let mut all = Vec::new();
            for number in (1..=5).cycle().skip(task as usize) {
                begun.fetch_add(u64::from(number), SeqCst);
                match client.enc_keys(slave).number(number).send().await {
                    Ok(container) => {
                        came.fetch_add(container.keys.len() as u64, SeqCst);
                        all.extend(ids(&container.keys));
                    }
                    Err(error) => {
                        assert_eq!(error.status_code(), Some(503), "{error}");
                        // Less than was asked for may still be there.
                        begun.fetch_sub(u64::from(number), SeqCst);
                        if number == 1 {
                            return all;
                        }
                    }
                }
            }
            all
        });
    }
    let drawn: Vec<_> = drawers.join_all().await.into_iter().flatten().collect();
    over.store(true, SeqCst);
    for looks in watchers.join_all().await {
        assert!(looks > 0);
    }
    assert_eq!(drawn.len() as u64, STOCK, "all of it, and no more");
    assert_eq!(drawn.iter().collect::<BTreeSet<_>>().len(), drawn.len());
    let status = client(&network, "sae-a").status("sae-b").await.unwrap();
    assert_eq!(status.stored_key_count, 0);
    let counters = network.kmes().iter().map(|kme| kme.counters().keys_to_masters);
    assert_eq!(counters.sum::<u64>(), STOCK);
}

#[tokio::test(flavor = "multi_thread")]
async fn the_stock_grows_no_faster_than_the_rate_and_not_beyond_the_limit() {
    const RATE: f64 = 500.0;
    const LIMIT: u64 = 40;
    let builder = two().fill_rate(FillRate::PerSecond(RATE)).initially_stored(0);
    // The stock of a link counts from the first time that somebody looks.
    let start = Instant::now();
    let network = builder.max_stored(LIMIT).start().await.unwrap();
    let mut tasks = JoinSet::new();
    for _ in 0..4 {
        let client = client(&network, "sae-a");
        tasks.spawn(async move {
            let mut drawn = 0;
            while drawn < 30 {
                match client.enc_keys("sae-b").number(3).send().await {
                    Ok(container) => drawn += container.keys.len(),
                    Err(error) => assert_eq!(error.status_code(), Some(503), "{error}"),
                }
            }
            drawn
        });
    }
    let drawn: usize = tasks.join_all().await.into_iter().sum();
    let most = RATE * start.elapsed().as_secs_f64();
    assert!(drawn as f64 <= most, "{drawn} drawn, {most} made");
    let client = client(&network, "sae-a");
    loop {
        let status = client.status("sae-b").await.unwrap();
        assert_eq!(status.max_key_count, LIMIT);
        assert!(status.stored_key_count <= LIMIT);
        if status.stored_key_count == LIMIT {
            break;
        }
        assert!(start.elapsed() < Duration::from_secs(60));
    }
    // The limit of a request is above it: what is asked is more than can ever be there.
    let error = client.enc_keys("sae-b").number(41).send().await.err().unwrap();
    assert_eq!(error.status_code(), Some(503));
}

#[tokio::test]
async fn rates_and_limits_that_are_none_are_refused() {
    for rate in [f64::NAN, f64::INFINITY, -1.0] {
        let error = two().fill_rate(FillRate::PerSecond(rate)).start().await.err().unwrap();
        assert!(error.to_string().contains("fill_rate"), "{error}");
    }
    let error = two().max_stored(u64::MAX).start().await.err().unwrap();
    assert!(error.to_string().contains("max_stored"), "{error}");
}
