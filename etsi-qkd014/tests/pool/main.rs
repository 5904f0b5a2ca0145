//! Pools against KMEs over real TLS: what goes wrong first, then the supply of many tasks.

mod scripted;

use std::collections::HashSet;
use std::sync::atomic::Ordering;
use std::time::Duration;

use etsi_qkd014::pool::{KeyPoolBuilder, Ledger, PoolStatus};
use etsi_qkd014::sim::{Fault, FaultPlan, FillRate, Layout, Method, Network, NetworkBuilder, Pki};
use etsi_qkd014::{Client, Error, KeyPool, RetryPolicy};
use scripted::{Script, uuid};
use tokio::time::{Instant, sleep};

fn two() -> NetworkBuilder {
    Network::builder().strict().kme("kme-a", "127.0.0.1:0".parse().unwrap(), ["sae-a"]).kme(
        "kme-b",
        "127.0.0.2:0".parse().unwrap(),
        ["sae-b"],
    )
}

fn client(network: &Network) -> Client {
    network.client_builder("sae-a").retry(RetryPolicy::none()).build().unwrap()
}

fn pool(network: &Network) -> KeyPoolBuilder {
    KeyPool::builder(client(network), "sae-b").size(256)
}

fn soon() -> Instant {
    Instant::now() + Duration::from_secs(60)
}

/// Waits until the pool stands as told, for a minute at most.
async fn until(pool: &KeyPool, stands: impl Fn(&PoolStatus) -> bool) -> PoolStatus {
    let deadline = soon();
    loop {
        let status = pool.status();
        if stands(&status) {
            return status;
        }
        assert!(Instant::now() < deadline, "{status:?}: {:?}", pool.last_failure());
        sleep(Duration::from_millis(5)).await;
    }
}

// What goes wrong

#[tokio::test]
async fn a_kme_that_repeats_its_key_ids_has_each_taken_once() {
    // Six keys, over and over, the second time in upper case.
    let key_id = |n: u64| if n < 6 { uuid(n + 10) } else { uuid(n % 6 + 10).to_uppercase() };
    let kme = scripted::start(Script { stock: (1000, 4), key_id }).await;
    let pool = KeyPool::builder(kme.client(), "sae-b").target(64).build().unwrap();
    let mut seen = HashSet::new();
    for _ in 0..6 {
        let key = pool.take(soon()).await.unwrap();
        assert!(seen.insert(key.key_id().to_ascii_lowercase()));
    }
    until(&pool, |status| status.unusable >= 10).await;
    assert!(pool.try_take().is_none());
    let error = pool.take(Instant::now()).await.err().unwrap();
    assert!(error.to_string().contains("again"), "{error}");
    assert_eq!(pool.status().taken, 6);
    // It is not asked in a loop: the pauses make it about one call a second.
    let calls = kme.calls.load(Ordering::Relaxed);
    assert!(calls < 60, "{calls} calls");
}

#[tokio::test]
async fn a_key_id_of_an_earlier_run_is_refused_by_the_file() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("ledger");
    for run in 0..2 {
        let kme = scripted::start(Script { stock: (1000, 4), key_id: uuid }).await;
        let ledger = Ledger::file(&path).unwrap();
        let pool = KeyPool::builder(kme.client(), "sae-b")
            .target(4)
            .ledger(ledger.clone())
            .build()
            .unwrap();
        let key = pool.take(soon()).await.unwrap();
        let at_most = kme.keys.load(Ordering::Relaxed);
        if run == 1 {
            // The KME begins anew, and what the first run drew is not given again.
            assert!(pool.status().unusable >= 4);
            assert!(key.key_id() > uuid(3).as_str());
        }
        drop(pool);
        // The task may be recording; it lets go of the file when that is done.
        drop(ledger);
        assert!(at_most >= 4);
        let deadline = soon();
        while Ledger::file(&path).is_err() {
            assert!(Instant::now() < deadline);
            sleep(Duration::from_millis(5)).await;
        }
    }
}

#[tokio::test]
async fn an_empty_store_is_a_stall_that_says_so() {
    let network =
        two().fill_rate(FillRate::PerSecond(0.0)).initially_stored(4).start().await.unwrap();
    let pool = pool(&network).target(16).build().unwrap();
    // A quarter of four at a time, and then the last one by one: the KME says 0, which may mean
    // anything.
    let mut taken = 0;
    while pool.take(Instant::now() + Duration::from_secs(1)).await.is_ok() {
        taken += 1;
    }
    assert_eq!(taken, 4, "every key that the KME has is had");
    let status = until(&pool, |status| status.is_stalled() && status.supply.is_some()).await;
    assert!(status.failures > 0 && status.held == 0);
    let error = pool.take(Instant::now() + Duration::from_millis(50)).await.err().unwrap();
    assert!(error.to_string().contains("503") && error.peer == "sae-b", "{error}");
}

#[tokio::test]
async fn failures_of_a_kme_end_with_them() {
    let network = two().start().await.unwrap();
    let kme = network.kme("kme-a").unwrap();
    for fault in [Fault::CutAnswer, Fault::Garbage, Fault::RepeatKeyId, Fault::Empty] {
        kme.plan(FaultPlan::new(fault).times(1).on(Method::EncKeys));
    }
    kme.plan(FaultPlan::new(Fault::Status(500)).times(1).on(Method::Status));
    let pool = pool(&network).target(2).calls(1).build().unwrap();
    let status = until(&pool, |status| status.failures >= 4).await;
    assert_eq!(status.obtained, 0);
    pool.take(soon()).await.unwrap();
    assert_eq!(pool.status().failures, 0);
}

#[tokio::test]
async fn a_kme_that_is_down_and_comes_back_serves_again() {
    let ports: Vec<_> =
        (0..2).map(|_| std::net::TcpListener::bind("127.0.0.1:0").unwrap()).collect();
    let mut layout = Layout::default();
    for (listener, (kme, sae)) in ports.iter().zip([("kme-a", "sae-a"), ("kme-b", "sae-b")]) {
        layout.sites.push(scripted::site(kme, listener.local_addr().unwrap(), sae));
    }
    drop(ports);
    let dir = tempfile::tempdir().unwrap();
    Pki::create(&layout).unwrap().write(dir.path()).unwrap();
    let start = async || {
        let pki = Pki::load(dir.path(), &layout).unwrap();
        Network::builder().strict().layout(layout.clone(), pki).start().await
    };
    let network = start().await.unwrap();
    let pool = pool(&network).target(8).build().unwrap();
    let before = pool.take(soon()).await.unwrap();
    until(&pool, |status| status.held + status.asked >= 6 && status.asked == 0).await;

    drop(network);
    let mut stored = 0;
    while pool.take(Instant::now() + Duration::from_millis(300)).await.is_ok() {
        stored += 1;
        assert!(stored <= 16, "no keys come from a KME that is down");
    }
    assert!(stored >= 6, "what was there is served while the KME is down: {stored}");
    until(&pool, |status| status.is_stalled() && status.failures > 0).await;
    assert!(pool.last_failure().is_some());

    let network = loop {
        // The port may still be in the hands of the one before.
        match start().await {
            Ok(network) => break network,
            Err(_) => sleep(Duration::from_millis(20)).await,
        }
    };
    let after = pool.take(soon()).await.unwrap();
    assert_ne!(before.key_id(), after.key_id());
    assert!(!pool.status().is_stalled());
    drop(network);
}

#[tokio::test]
async fn pool_refuses_invalid_requests_at_build() {
    let network = two().start().await.unwrap();
    for builder in [
        KeyPool::builder(client(&network), ".."),
        KeyPool::builder(client(&network), ""),
        pool(&network).size(7),
        pool(&network).size(0),
    ] {
        assert!(matches!(builder.build(), Err(Error::Request { .. })));
    }
    let builder = pool(&network);
    let outside = std::thread::spawn(move || builder.build().map(drop)).join().unwrap();
    assert!(matches!(outside, Err(Error::Config { setting: "KeyPool", .. })));
}

// How much is asked

#[tokio::test]
async fn no_call_asks_for_more_than_the_kme_allows() {
    let network = two().max_keys_per_request(3).start().await.unwrap();
    let pool = pool(&network).target(64).batch(32).build().unwrap();
    until(&pool, |status| status.held == 64).await;
    let counters = network.kme("kme-a").unwrap().counters();
    assert_eq!(counters.refused, 0);
    assert!(counters.enc_keys_calls >= 22);
}

#[tokio::test]
async fn a_quarter_of_the_stock_is_held_at_most() {
    let network =
        two().fill_rate(FillRate::PerSecond(0.0)).initially_stored(40).start().await.unwrap();
    let pool = pool(&network).target(64).build().unwrap();
    let status = until(&pool, |status| status.held == 10).await;
    assert_eq!((status.target, status.asked), (10, 0));
    let counters = network.kme("kme-a").unwrap().counters();
    assert_eq!((counters.keys_to_masters, counters.refused), (10, 0));
}

#[tokio::test]
async fn zeros_in_the_status_bound_nothing() {
    let kme = scripted::start(Script { stock: (0, 0), key_id: uuid }).await;
    let pool = KeyPool::builder(kme.client(), "sae-b").target(64).build().unwrap();
    until(&pool, |status| status.held == 64).await;
    assert_eq!(kme.keys.load(Ordering::Relaxed), 64);
}

#[tokio::test]
async fn the_pool_follows_a_changed_target() {
    let network = two().start().await.unwrap();
    let pool = pool(&network).target(0).build().unwrap();
    until(&pool, |status| status.stock.is_some()).await;
    assert!(pool.try_take().is_none());
    pool.set_target(5);
    until(&pool, |status| status.held == 5).await;
    pool.set_target(1);
    for _ in 0..5 {
        assert!(pool.try_take().is_some(), "more than the target stay until they are taken");
    }
    until(&pool, |status| status.held == 1 && status.asked == 0).await;
    assert_eq!(network.kme("kme-a").unwrap().counters().keys_to_masters, 6);
}

#[tokio::test]
async fn untaken_keys_are_replaced() {
    let network = two().start().await.unwrap();
    let pool = pool(&network).target(2).max_age(Duration::from_millis(300)).build().unwrap();
    let status = until(&pool, |status| status.expired >= 4).await;
    assert_eq!(status.taken, 0);
    pool.take(soon()).await.unwrap();
}

#[tokio::test]
async fn a_pool_that_is_dropped_asks_no_more() {
    let network = two().start().await.unwrap();
    let kme = network.kme("kme-a").unwrap();
    let first = pool(&network).target(4).max_age(Duration::from_millis(20)).build().unwrap();
    let second = first.clone();
    drop(first);
    until(&second, |status| status.expired >= 8).await;
    drop(second);
    // Requests on their way are over after a moment; none follow, though keys would be too old.
    sleep(Duration::from_millis(200)).await;
    let counted = kme.counters();
    sleep(Duration::from_millis(300)).await;
    assert_eq!(kme.counters(), counted);
}

// Supply

#[tokio::test]
async fn the_rate_of_the_supply_is_seen() {
    let network =
        two().fill_rate(FillRate::PerSecond(40.0)).initially_stored(0).start().await.unwrap();
    let pool = pool(&network).target(16).build().unwrap();
    // Seen only where keys are waited for.
    let end = soon();
    while pool.status().supply.is_none() {
        pool.take(end).await.expect("a KME that is filled");
    }
    let supply = pool.status().supply.expect("it was waited for");
    assert!(supply > 0.0 && supply.is_finite(), "{supply}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn eight_tasks_take_a_thousand_keys_each_exactly_once() {
    let network = two().max_stored(20_000).start().await.unwrap();
    let pool = pool(&network).target(512).batch(64).build().unwrap();
    let tasks: Vec<_> = (0..8)
        .map(|_| {
            let pool = pool.clone();
            tokio::spawn(async move {
                let mut keys = Vec::new();
                for _ in 0..1000 {
                    keys.push(pool.take(soon()).await.unwrap());
                }
                keys
            })
        })
        .collect();
    let mut keys = Vec::new();
    for task in tasks {
        keys.extend(task.await.unwrap());
    }
    let distinct: HashSet<_> = keys.iter().map(|key| key.key_id()).collect();
    assert_eq!((keys.len(), distinct.len()), (8000, 8000));
    let status = pool.status();
    assert_eq!((status.taken, status.unusable, status.failures), (8000, 0, 0));
    // The peer has the same ones.
    let slave = network.client_builder("sae-b").build().unwrap();
    for batch in keys.chunks(128) {
        let ids = batch.iter().map(|key| key.key_id());
        let same = slave.dec_keys("sae-a").key_ids(ids).send().await.unwrap().keys;
        assert!(same.iter().zip(batch).all(|(a, b)| a == b));
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn takers_that_give_up_lose_no_key() {
    let network =
        two().fill_rate(FillRate::PerSecond(200.0)).initially_stored(0).start().await.unwrap();
    let pool = pool(&network).target(8).build().unwrap();
    let tasks: Vec<_> = (0..16u64)
        .map(|i| {
            let pool = pool.clone();
            tokio::spawn(async move {
                let mut got = 0;
                for round in 0..100 {
                    let patience = Duration::from_micros(100 * (i + 1) * (round % 7));
                    tokio::select! {
                        key = pool.take(soon()) => got += u64::from(key.is_ok()),
                        () = sleep(patience) => {}
                    }
                }
                got
            })
        })
        .collect();
    let mut got = 0;
    for task in tasks {
        got += task.await.unwrap();
    }
    let status = pool.status();
    assert_eq!(status.taken, got);
    assert_eq!(status.obtained, status.taken + status.held as u64 + status.expired);
    pool.take(soon()).await.expect("those who wait are still served");
}
