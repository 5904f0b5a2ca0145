//! Tests the rights of clients at a simulated KME: each SAE against each KME, and each key against each SAE.

mod raw;

use etsi_qkd014::sim::{Network, Sae};
use etsi_qkd014::{Client, Error, RetryPolicy};

/// SAE and the KME that it is attached to.
const SAES: [(&str, &str); 4] =
    [("sae-a", "kme-a"), ("sae-d", "kme-a"), ("sae-b", "kme-b"), ("sae-c", "kme-c")];
const KMES: [&str; 3] = ["kme-a", "kme-b", "kme-c"];

async fn network() -> Network {
    Network::builder()
        .kme("kme-a", "127.0.0.1:0".parse().unwrap(), ["sae-a", "sae-d"])
        .kme("kme-b", "127.0.0.2:0".parse().unwrap(), ["sae-b"])
        .kme("kme-c", "127.0.0.3:0".parse().unwrap(), ["sae-c"])
        .start()
        .await
        .unwrap()
}

/// Returns a client of an SAE for this KME, which may be its own or not.
fn at(network: &Network, sae: &Sae, kme: &str) -> Client {
    let url = network.kme(kme).unwrap().url();
    let builder = sae.client_builder().kme_url(url).kme_id(kme);
    builder.retry(RetryPolicy::none()).build().unwrap()
}

fn unauthorized<T>(result: Result<T, Error>) -> bool {
    match result {
        Ok(_) => false,
        Err(Error::Unauthorized { .. }) => true,
        Err(error) => panic!("{error}"),
    }
}

#[tokio::test]
async fn a_kme_serves_its_own_saes_only() {
    let network = network().await;
    for (sae, home) in SAES {
        let sae = network.sae(sae).unwrap();
        for kme in KMES {
            let client = at(&network, sae, kme);
            for (other, _) in SAES {
                let refused = [
                    unauthorized(client.status(other).await),
                    unauthorized(client.enc_keys(other).send().await),
                    unauthorized(client.enc_keys(other).via_get().send().await),
                ];
                assert_eq!(refused, [kme != home; 3], "{} at {kme} for {other}", sae.id());
            }
        }
    }
    // These certificates of the CA have names that belong to no SAE, or to none of this KME.
    let before: Vec<_> = network.kmes().iter().map(|kme| kme.counters().keys_to_masters).collect();
    for name in ["sae-x", "SAE-A", "sae-a.", "sae", "kme-a", "sae-a,sae-b", "*", "sae-a\u{0}", " "]
    {
        let stranger = network.outsider(name, "kme-a").unwrap();
        let client = at(&network, &stranger, "kme-a");
        assert!(unauthorized(client.status("sae-b").await), "{name:?}");
        assert!(unauthorized(client.enc_keys("sae-b").send().await), "{name:?}");
        let by_id = client.dec_keys("sae-b").key_id("bc490419-7d60-487f-adc1-4ddcc177c139");
        assert!(unauthorized(by_id.send().await), "{name:?}");
    }
    let after: Vec<_> = network.kmes().iter().map(|kme| kme.counters().keys_to_masters).collect();
    assert_eq!(before, after);
}

#[tokio::test]
async fn key_is_released_only_to_the_slaves_named_by_its_master() {
    let network = network().await;
    let client = |sae: &str, home: &str| at(&network, network.sae(sae).unwrap(), home);
    let master = client("sae-a", "kme-a");
    let multicast = master.enc_keys("sae-b").additional_slave_sae_ids(["sae-c"]);
    for (key, slaves) in [
        (master.enc_keys("sae-b").send().await.unwrap().into_single(), &["sae-b"][..]),
        // Two SAEs of one KME.
        (master.enc_keys("sae-d").send().await.unwrap().into_single(), &["sae-d"]),
        (multicast.send().await.unwrap().into_single(), &["sae-b", "sae-c"]),
    ] {
        // Refused first: none of the refusals takes the key away.
        for (sae, home) in SAES {
            for (named, _) in SAES {
                if slaves.contains(&sae) && named == "sae-a" {
                    continue;
                }
                for via_get in [false, true] {
                    let client = client(sae, home);
                    let request = client.dec_keys(named).key_id(key.key_id());
                    let request = if via_get { request.via_get() } else { request };
                    let refused = unauthorized(request.send().await);
                    assert!(refused, "{sae} in the name of {named}");
                }
            }
        }
        for (sae, home) in SAES.into_iter().filter(|(sae, _)| slaves.contains(sae)) {
            let client = client(sae, home);
            let same = client.dec_keys("sae-a").key_id(key.key_id()).send().await.unwrap();
            assert!(same.into_single() == key, "{sae}");
        }
    }
}

#[tokio::test]
async fn a_key_of_another_in_a_batch_takes_nothing_of_it() {
    let network = network().await;
    let client = |sae: &str, home: &str| at(&network, network.sae(sae).unwrap(), home);
    let (master, slave) = (client("sae-a", "kme-a"), client("sae-b", "kme-b"));
    let ours = master.enc_keys("sae-b").send().await.unwrap().into_single();
    let theirs = master.enc_keys("sae-c").send().await.unwrap().into_single();
    for both in [[ours.key_id(), theirs.key_id()], [theirs.key_id(), ours.key_id()]] {
        assert!(unauthorized(slave.dec_keys("sae-a").key_ids(both).send().await));
    }
    slave.dec_keys("sae-a").key_id(ours.key_id()).send().await.unwrap();
    let third = client("sae-c", "kme-c");
    third.dec_keys("sae-a").key_id(theirs.key_id()).send().await.unwrap();
}

#[tokio::test]
async fn a_kmes_own_certificate_makes_no_sae() {
    let network = network().await;
    let dir = tempfile::tempdir().unwrap();
    network.write_files(dir.path()).unwrap();
    let read = |name: &str| std::fs::read_to_string(dir.path().join(name)).unwrap();
    for kme in ["kme-b", "kme-a.expired"] {
        let (cert, key) = (read(&format!("{kme}.crt")), read(&format!("{kme}.key")));
        let tls = raw::with_pair(&read("ca.pem"), &cert, &key);
        let addr = network.kme("kme-a").unwrap().addr();
        // TLS 1.3 servers refuse only after the client's part of the handshake.
        if let Ok(mut connection) = raw::open(&tls, addr).await {
            let _ = connection.send(&raw::get("sae-b/status")).await;
            assert!(connection.answer().await.is_none(), "{kme}");
        }
    }
    assert_eq!(network.kme("kme-a").unwrap().counters(), Default::default());
}
