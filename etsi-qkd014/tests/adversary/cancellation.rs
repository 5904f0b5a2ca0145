//! A call that is dropped at any of its waits leaves a client that works.

use std::future::poll_fn;
use std::pin::pin;
use std::task::Poll;
use std::time::Duration;

use etsi_qkd014::RetryPolicy;
use etsi_qkd014::sim::{Fault, Network};

/// Polls a call at most `most` times. Returns the outcome, or `None` if the call was dropped before.
async fn polled<T>(call: impl Future<Output = T>, most: usize) -> Option<T> {
    let mut call = pin!(call);
    let mut left = most;
    poll_fn(|context| {
        if left == 0 {
            return Poll::Ready(None);
        }
        left -= 1;
        call.as_mut().poll(context).map(Some)
    })
    .await
}

async fn each_wait(faults: &[Fault]) {
    let network = Network::builder()
        .strict()
        .kme("kme-a", "127.0.0.1:0".parse().unwrap(), ["sae-a"])
        .kme("kme-b", "127.0.0.1:0".parse().unwrap(), ["sae-b"])
        .start()
        .await
        .unwrap();
    let kme = network.kme("kme-a").unwrap();
    let policy = RetryPolicy::none()
        .enc_keys(3)
        .enc_keys_after_ambiguous_failure(true)
        .pause(Duration::from_millis(1), Duration::from_millis(1));
    let settings = || network.client_builder("sae-a").retry(policy.clone());
    let warm = settings().build().unwrap();
    let mut most = 0;
    loop {
        // With a connection to be made, and with one that is there.
        let cold = settings().build().unwrap();
        let mut done = true;
        for client in [&cold, &warm] {
            kme.clear_faults();
            faults.iter().for_each(|fault| kme.inject(fault.clone(), 1));
            let before = kme.counters().enc_keys_calls;
            let call = client.enc_keys("sae-b").number(100).size(256).send();
            match polled(call, most).await {
                Some(result) => drop(result.unwrap()),
                None => done = false,
            }
            if most == 0 {
                assert_eq!(kme.counters().enc_keys_calls, before, "nothing is sent unpolled");
            }
            kme.clear_faults();
            client.enc_keys("sae-b").number(100).size(256).send().await.unwrap();
        }
        if done {
            break;
        }
        most += 1;
    }
    assert!(most > 3, "it waits for something");
}

#[tokio::test]
async fn a_call_may_be_dropped_at_each_of_its_waits() {
    each_wait(&[]).await;
}

#[tokio::test]
async fn a_call_that_is_repeated_may_be_dropped_at_each_of_its_waits() {
    each_wait(&[Fault::Empty, Fault::CutAnswer]).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_call_may_be_dropped_while_its_connection_is_driven_by_another_thread() {
    each_wait(&[Fault::CutAnswer]).await;
}
