//! Tests keys that a pool drew, for each possible end of the keys.

use std::time::Duration;

use etsi_qkd014::pool::{KeyPoolBuilder, PoolStatus};
use etsi_qkd014::{Client, KeyPool};

use crate::kme::key;
use crate::kmes::Kmes;
use crate::{judge, quarantine};

/// More keys than any test here draws.
const DRAWN: u64 = 2000;
const HELD: usize = 64;

/// Judges a pool with a script's KME. `use_it` uses the pool and drops it.
fn judge_pool(
    name: &str,
    script: &str,
    settings: impl Fn(KeyPoolBuilder) -> KeyPoolBuilder,
    use_it: impl AsyncFn(KeyPool),
) {
    let _turn = quarantine::turn();
    let kmes = Kmes::start();
    let call = async |client: &Client| {
        let pool = KeyPool::builder(client.clone(), script).size(256).target(HELD).batch(16);
        use_it(settings(pool).build().unwrap()).await;
    };
    judge(name, || kmes.scripted(), call, |()| (0..DRAWN).map(|n| key(n).to_vec()).collect());
}

async fn until(pool: &KeyPool, enough: impl Fn(&PoolStatus) -> bool) {
    let status = async {
        while !enough(&pool.status()) {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    let in_time = tokio::time::timeout(Duration::from_secs(30), status).await;
    assert!(in_time.is_ok(), "{:?}, {:?}", pool.status(), pool.last_failure());
    assert!(pool.status().obtained < DRAWN, "keys that are not searched for: {:?}", pool.status());
}

#[test]
fn a_pool_dropped_with_its_keys() {
    judge_pool(
        "pool dropped",
        "new",
        |b| b,
        async |pool| {
            until(&pool, |status| status.held >= HELD).await;
        },
    );
}

#[test]
fn keys_of_a_pool_that_grow_too_old() {
    let brief = |builder: KeyPoolBuilder| builder.max_age(Duration::from_millis(300));
    judge_pool("keys too old", "new", brief, async |pool| {
        until(&pool, |status| status.held >= HELD).await;
        until(&pool, |status| status.expired >= HELD as u64).await;
    });
}

#[test]
fn keys_taken_from_a_pool_and_dropped() {
    judge_pool(
        "keys taken",
        "new",
        |b| b,
        async |pool| {
            until(&pool, |status| status.held >= HELD).await;
            let mut taken = Vec::new();
            while let Some(key) = pool.try_take() {
                taken.push(key);
            }
            // Of the two waiting calls, one is served and one gives up.
            let soon = || tokio::time::Instant::now() + Duration::from_secs(30);
            let given_up = tokio::time::timeout(Duration::from_micros(1), pool.take(soon())).await;
            drop(given_up);
            taken.push(pool.take(soon()).await.unwrap());
            assert!(taken.len() >= HELD);
            // After the pool, one of them moved out of the list.
            drop(pool);
            let last = taken.pop();
            drop(taken);
            assert_eq!(last.unwrap().len(), 32);
        },
    );
}

#[test]
fn a_pool_shut_down_with_its_calls_in_flight() {
    judge_pool(
        "calls in flight",
        "new-drip",
        |b| b,
        async |pool| {
            until(&pool, |status| status.asked > 0).await;
            // The pause gives time for the keys that come at once, and for some that come slowly.
            tokio::time::sleep(Duration::from_millis(500)).await;
            assert!(pool.status().asked > 0);
        },
    );
}

#[test]
fn keys_that_the_ledger_refuses() {
    judge_pool(
        "keys repeated",
        "whole",
        |b| b,
        async |pool| {
            until(&pool, |status| status.unusable > 0).await;
            assert!(pool.last_failure().unwrap().contains("again"));
        },
    );
}
