//! Faults of a KME that are not in one answer: certificates out of their time, and key_IDs that come
//! again.

use std::collections::HashSet;
use std::time::Duration;

use etsi_qkd014::pool::Ledger;
use etsi_qkd014::sim::{Fault, FaultPlan, Layout, Method, Network, NetworkBuilder, Pki, Site};
use etsi_qkd014::{Client, Error, KeyPool, RefusedBy, RetryPolicy};
use tokio::time::Instant;

fn two() -> NetworkBuilder {
    Network::builder().strict().kme("kme-a", "127.0.0.1:0".parse().unwrap(), ["sae-a"]).kme(
        "kme-b",
        "127.0.0.2:0".parse().unwrap(),
        ["sae-b"],
    )
}

fn client(network: &Network, sae: &str) -> Client {
    network.client_builder(sae).retry(RetryPolicy::none()).build().unwrap()
}

/// The certificates outside their validity, and the client's error for each.
const CERTIFICATES: [(Fault, &str); 2] = [
    (Fault::CertificateExpired, "the KME's certificate has expired"),
    (Fault::CertificateNotYetValid, "the KME's certificate is not valid yet; check this machine's"),
];

#[tokio::test]
async fn certificates_out_of_their_time_are_refused_until_the_fault_is_over() {
    for builder in [two(), two().tls12_only()] {
        let network = builder.start().await.unwrap();
        let kme = network.kme("kme-a").unwrap();
        for (fault, said) in CERTIFICATES {
            // Clients of their own, since a connection that is open already is not met.
            let client = client(&network, "sae-a");
            kme.inject(fault.clone(), 2);
            let before = kme.counters();
            for result in
                [client.status("sae-b").await.err(), client.enc_keys("sae-b").send().await.err()]
            {
                let error = result.expect("the certificate must be refused");
                let Error::Tls { refused_by: RefusedBy::Client, reason, .. } = &error else {
                    panic!("{fault:?}: {error:?}");
                };
                assert!(reason.contains(said), "{fault:?}: {reason}");
                assert!(!error.keys_may_be_consumed() && !error.is_transient(), "{error}");
            }
            assert_eq!(kme.counters(), before, "nothing was asked of it");
            assert!(kme.plans().is_empty());
            client.enc_keys("sae-b").send().await.unwrap();
            // Existing connections stay.
            kme.inject(fault, 1);
            client.status("sae-b").await.unwrap();
            kme.clear_faults();
        }
    }
}

#[tokio::test]
async fn the_other_kmes_of_a_network_keep_their_certificates() {
    let network = two().start().await.unwrap();
    network.kme("kme-a").unwrap().plan(FaultPlan::new(Fault::CertificateExpired));
    client(&network, "sae-b").status("sae-a").await.unwrap();
    assert!(client(&network, "sae-a").status("sae-b").await.is_err());
}

#[tokio::test]
async fn files_hold_the_certificates_out_of_their_time() {
    let dir = tempfile::tempdir().unwrap();
    let site = |kme: &str, ip: [u8; 4], sae: &str| Site {
        kme: kme.to_owned(),
        bind: (ip, 0).into(),
        saes: vec![sae.to_owned()],
    };
    let layout = Layout {
        sites: vec![site("kme-a", [127, 0, 0, 1], "sae-a"), site("kme-b", [127, 0, 0, 2], "sae-b")],
    };
    Pki::create(&layout).unwrap().write(dir.path()).unwrap();
    for (fault, said) in CERTIFICATES {
        for end in ["crt", "key"] {
            let name = fault.to_string().replace("certificate-", "kme-a.");
            assert!(dir.path().join(format!("{name}.{end}")).exists(), "{name}.{end}");
        }
        // A KME that lives from the files alone has them too.
        let pki = Pki::load(dir.path(), &layout).unwrap();
        let network =
            Network::builder().strict().layout(layout.clone(), pki).start().await.unwrap();
        network.kme("kme-a").unwrap().inject(fault, 1);
        let client = client(&network, "sae-a");
        let error = client.status("sae-b").await.unwrap_err();
        assert!(error.to_string().contains(said), "{error}");
        client.status("sae-b").await.unwrap();
    }
    std::fs::remove_file(dir.path().join("kme-b.expired.key")).unwrap();
    let error = Pki::load(dir.path(), &layout).unwrap_err();
    assert!(error.to_string().contains("kme-b.expired.key"), "{error}");

    for id in ["sae.expired", "SAE.Not-Yet-Valid"] {
        let layout = Layout { sites: vec![site("kme-a", [127, 0, 0, 1], id)] };
        let error = Pki::create(&layout).unwrap_err();
        assert!(error.to_string().contains(id), "its file could be another's: {error}");
    }
}

// key_IDs that come again

#[tokio::test]
async fn repeated_key_id_is_found_by_the_ledger() {
    let network = two().start().await.unwrap();
    let kme = network.kme("kme-a").unwrap();
    let (master, slave) = (client(&network, "sae-a"), client(&network, "sae-b"));
    let ledger = Ledger::memory(1000);
    let draw = async |number| master.enc_keys("sae-b").number(number).send().await.unwrap().keys;

    // No key was given out before, so there is none to repeat.
    kme.inject(Fault::ReuseKeyId, 1);
    let first = draw(2).await;
    assert!(ledger.record(first.iter().map(|key| key.key_id())).unwrap() == [true, true]);
    kme.inject(Fault::ReuseKeyId, 2);
    for _ in 0..2 {
        let again = draw(1).await;
        assert_eq!(again[0].key_id(), first[1].key_id());
        assert!(again[0] != first[1], "another key under the same key_ID");
        assert_eq!(ledger.record([again[0].key_id()]).unwrap(), [false]);
    }
    // Within an answer of several it is the first one.
    kme.inject(Fault::ReuseKeyId, 1);
    let batch = draw(3).await;
    let new = ledger.record(batch.iter().map(|key| key.key_id())).unwrap();
    assert_eq!(new, [false, true, true]);
    // The slave gets the key that the key_ID stood for at first.
    let same = slave.dec_keys("sae-a").key_id(first[1].key_id()).send().await.unwrap();
    assert!(same.into_single() == first[1]);
}

#[tokio::test]
async fn a_pool_hands_out_no_key_id_twice_however_often_the_kme_does() {
    let dir = tempfile::tempdir().unwrap();
    let network = two().start().await.unwrap();
    let kme = network.kme("kme-a").unwrap();
    kme.plan(FaultPlan::new(Fault::ReuseKeyId).on(Method::EncKeys));
    let mut taken = HashSet::new();
    let mut unusable = 0;
    for (batch, ledger) in [
        (1, Ledger::memory(1000)),
        (4, Ledger::memory(1000)),
        (4, Ledger::file(dir.path().join("ledger")).unwrap()),
    ] {
        let pool = KeyPool::builder(client(&network, "sae-a"), "sae-b")
            .size(256)
            .target(8)
            .batch(batch)
            .calls(1)
            .ledger(ledger.clone())
            .build()
            .unwrap();
        let patience = Duration::from_secs(if batch == 1 { 2 } else { 60 });
        let mut here = HashSet::new();
        while here.len() < 12 {
            match pool.take(Instant::now() + patience).await {
                Ok(key) => assert!(here.insert(key.key_id().to_owned()), "handed out twice"),
                // One at a time, all have the key_ID of the first.
                Err(error) => {
                    assert!(batch == 1 && error.to_string().contains("again"), "{error}");
                    break;
                }
            }
        }
        assert!(here.len() == if batch == 1 { 1 } else { 12 });
        // The ledger contains all keys that were given out, and keys that came again.
        assert!(ledger.record(&here).unwrap().iter().all(|is_new| !is_new));
        unusable += pool.status().unusable;
        taken.extend(here);
    }
    assert!(unusable >= 3, "{unusable}");
    assert!(taken.len() >= 24);
}

#[tokio::test]
async fn a_wrong_key_differs_from_the_other_saes_and_its_neighbours_do_not() {
    let network = two().start().await.unwrap();
    let (master, slave) = (client(&network, "sae-a"), client(&network, "sae-b"));
    for wrong in ["kme-a", "kme-b"] {
        network.kme(wrong).unwrap().inject(Fault::WrongKey, 1);
        let theirs = master.enc_keys("sae-b").number(3).send().await.unwrap().keys;
        let ids: Vec<_> = theirs.iter().map(|key| key.key_id().to_owned()).collect();
        let ours = slave.dec_keys("sae-a").key_ids(ids).send().await.unwrap().keys;
        let same: Vec<bool> = theirs.iter().zip(&ours).map(|(one, other)| one == other).collect();
        assert_eq!(same, [false, true, true], "{wrong}");
        assert!(theirs.iter().zip(&ours).all(|(one, other)| one.key_id() == other.key_id()));
    }
}
