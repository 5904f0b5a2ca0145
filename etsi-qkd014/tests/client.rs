//! The client against simulated KMEs over real mutual TLS: refusals first, then what works.

use std::time::Duration;

use etsi_qkd014::sim::{FillRate, Network, NetworkBuilder};
use etsi_qkd014::{Client, Error, KeyContainer, Quirks, RefusedBy, RetryPolicy};
use serde_json::json;

/// A key_ID that no KME gave.
const UNKNOWN: &str = "11111111-2222-4333-8444-555555555555";

fn two() -> NetworkBuilder {
    Network::builder()
        .strict()
        .kme("kme-a", "127.0.0.1:0".parse().unwrap(), ["sae-a", "sae-c"])
        .kme("kme-b", "127.0.0.2:0".parse().unwrap(), ["sae-b"])
}

struct Pair {
    network: Network,
    master: Client,
    slave: Client,
}

async fn pair() -> Pair {
    let network = two().start().await.unwrap();
    let once = |sae| network.client_builder(sae).retry(RetryPolicy::none()).build().unwrap();
    let (master, slave) = (once("sae-a"), once("sae-b"));
    Pair { network, master, slave }
}

fn failed(result: Result<KeyContainer, Error>) -> Error {
    result.err().expect("the call must fail")
}

// Who is who

#[tokio::test]
async fn a_kme_of_another_ca_is_refused_before_any_request() {
    let Pair { network, .. } = pair().await;
    let other = two().start().await.unwrap();
    let ca = other.sae("sae-a").unwrap().ca_pem();
    let client = network.client_builder("sae-a").ca(ca).build().unwrap();
    let error = failed(client.enc_keys("sae-b").send().await);
    assert!(
        matches!(&error, Error::Tls { refused_by: RefusedBy::Client, reason, .. } if reason.contains("CA")),
        "{error}"
    );
    assert!(!error.keys_may_be_consumed());
    assert_eq!(network.kme("kme-a").unwrap().counters().enc_keys_calls, 0);
}

#[tokio::test]
async fn a_client_of_another_ca_is_refused_by_the_kme() {
    let Pair { network, .. } = pair().await;
    let other = two().start().await.unwrap();
    let sae = other.sae("sae-a").unwrap();
    let client = network
        .client_builder("sae-a")
        .sae_cert(sae.cert_pem())
        .sae_key(sae.key_pem().as_bytes().to_vec())
        .build()
        .unwrap();
    let error = failed(client.enc_keys("sae-b").send().await);
    assert!(matches!(&error, Error::Tls { refused_by: RefusedBy::Kme, .. }), "{error}");
    assert_eq!(network.kme("kme-a").unwrap().counters().enc_keys_calls, 0);
}

#[tokio::test]
async fn a_kme_with_another_id_or_name_is_refused() {
    let Pair { network, .. } = pair().await;
    let wrong_id = network.client_builder("sae-a").kme_id("kme-b").build().unwrap();
    let error = wrong_id.status("sae-b").await.unwrap_err();
    let shown = error.to_string();
    assert!(matches!(error, Error::Tls { refused_by: RefusedBy::Client, .. }), "{shown}");
    assert!(shown.contains("kme-a") && shown.contains("kme-b"), "{shown}");

    // 127.0.0.1's certificate does not name 127.0.0.3.
    let port = network.kme("kme-a").unwrap().addr().port();
    let other = two_on_all_addresses(port).await;
    let url = format!("https://127.0.0.3:{}", other.kme("kme-a").unwrap().addr().port());
    let named = || other.client_builder("sae-a").kme_url(&url);
    let error = named().build().unwrap().status("sae-b").await.unwrap_err();
    assert!(matches!(error, Error::Tls { refused_by: RefusedBy::Client, .. }), "{error}");
    let by_id = named().kme_id("kme-a").kme_id_replaces_name_check().build().unwrap();
    by_id.status("sae-b").await.unwrap();
    let by_wrong_id = named().kme_id("kme-b").kme_id_replaces_name_check().build().unwrap();
    assert!(by_wrong_id.status("sae-b").await.is_err());
}

/// Starts KMEs whose certificates name 0.0.0.0 and no address that a client could use.
async fn two_on_all_addresses(_not: u16) -> Network {
    Network::builder()
        .strict()
        .kme("kme-a", "0.0.0.0:0".parse().unwrap(), ["sae-a"])
        .kme("kme-b", "0.0.0.0:0".parse().unwrap(), ["sae-b"])
        .start()
        .await
        .unwrap()
}

#[tokio::test]
async fn a_kme_of_tls_1_2_works_and_refuses_as_well() {
    let network = two().tls12_only().start().await.unwrap();
    let other = two().start().await.unwrap();
    let stranger = other.sae("sae-a").unwrap();
    let client = network
        .client_builder("sae-a")
        .sae_cert(stranger.cert_pem())
        .sae_key(stranger.key_pem().as_bytes().to_vec())
        .build()
        .unwrap();
    let error = failed(client.enc_keys("sae-b").send().await);
    assert!(matches!(&error, Error::Tls { refused_by: RefusedBy::Kme, .. }), "{error}");
    let client = network.client_builder("sae-a").build().unwrap();
    client.enc_keys("sae-b").send().await.unwrap();
}

#[tokio::test]
async fn an_sae_of_another_kme_and_an_unknown_one_are_unauthorized() {
    let Pair { network, .. } = pair().await;
    let url = network.kme("kme-a").unwrap().url();
    let elsewhere = network.client_builder("sae-b").kme_url(url).kme_id("kme-a").build().unwrap();
    let outsider = network.outsider("sae-x", "kme-a").unwrap().client_builder().build().unwrap();
    for client in [elsewhere, outsider] {
        let error = failed(client.enc_keys("sae-a").send().await);
        assert!(matches!(error, Error::Unauthorized { .. }), "{error}");
        assert!(matches!(
            failed(client.dec_keys("sae-a").key_id(UNKNOWN).send().await),
            Error::Unauthorized { .. }
        ));
        assert!(matches!(client.status("sae-a").await, Err(Error::Unauthorized { .. })));
    }
    assert_eq!(network.kme("kme-a").unwrap().counters().keys_to_masters, 0);
}

#[tokio::test]
async fn a_certificate_without_its_key_is_refused_when_the_client_is_made() {
    let Pair { network, .. } = pair().await;
    let other = network.sae("sae-b").unwrap().cert_pem();
    let error = network.client_builder("sae-a").sae_cert(other).build().unwrap_err();
    assert!(matches!(error, Error::Config { setting: "sae_key", .. }), "{error}");
}

#[tokio::test]
async fn a_kme_that_does_not_listen_is_unreachable() {
    let Pair { network, master, .. } = pair().await;
    drop(network);
    let error = failed(master.enc_keys("sae-b").send().await);
    assert!(matches!(error, Error::Unreachable { .. }), "{error}");
    assert!(error.is_transient() && !error.keys_may_be_consumed());
}

// What is asked

#[tokio::test]
async fn requests_that_cannot_be_put_are_refused_before_they_are_sent() {
    let Pair { network, master, .. } = pair().await;
    let long = "x".repeat(256);
    let refused = [
        master.enc_keys("sae-b").number(0).send().await,
        master.enc_keys("sae-b").size(0).send().await,
        master.enc_keys("sae-b").size(7).send().await,
        master.enc_keys("").send().await,
        master.enc_keys("..").send().await,
        master.enc_keys("a\nb").send().await,
        master.enc_keys(&long).send().await,
        master.enc_keys("sae-b").extension_mandatory(json!(1)).send().await,
        master.enc_keys("sae-b").via_get().extension_optional(json!({})).send().await,
        master.enc_keys("sae-b").via_get().additional_slave_sae_ids(["sae-c"]).send().await,
        master.dec_keys("sae-b").send().await,
        master.dec_keys("sae-b").key_id("").send().await,
        master.dec_keys("sae-b").key_id("a b").send().await,
        master.dec_keys("sae-b").key_ids(["a", "A"]).send().await,
        master.dec_keys("sae-b").key_ids(["a", "b"]).via_get().send().await,
        master.dec_keys("sae-b").key_id("a").size(12).send().await,
        master.dec_keys("sae-b").key_id_with_extension("a", json!(1)).send().await,
        master.dec_keys("sae-b").key_id("a").key_ids_extension(json!([])).send().await,
        master.dec_keys("sae-b").key_id("a").key_ids_extension(json!({})).via_get().send().await,
        master.dec_keys("sae-b").key_id_with_extension("a", json!({})).via_get().send().await,
    ];
    for result in refused {
        let error = failed(result);
        assert!(matches!(error, Error::Request { .. }), "{error}");
    }
    assert_eq!(network.kme("kme-a").unwrap().counters(), Default::default());
}

#[tokio::test]
async fn a_kme_refuses_requests_beyond_its_limits() {
    let Pair { network, master, .. } = pair().await;
    let over = [
        master.enc_keys("sae-b").number(129).send().await,
        master.enc_keys("sae-b").number(129).via_get().send().await,
        master.enc_keys("sae-b").size(8192).send().await,
        master.enc_keys("nobody").send().await,
        master.enc_keys("sae-b").additional_slave_sae_ids(["nobody"]).send().await,
        master
            .enc_keys("sae-b")
            .additional_slave_sae_ids((0..9).map(|i| format!("s{i}")))
            .send()
            .await,
    ];
    for result in over {
        let error = failed(result);
        assert!(
            matches!(&error, Error::BadRequest { message, .. } if !message.is_empty()),
            "{error}"
        );
        assert_eq!(error.status_code(), Some(400));
        assert!(!error.keys_may_be_consumed());
    }
    let error = failed(
        master.enc_keys("sae-b").extension_mandatory(json!({"route_type": "direct"})).send().await,
    );
    assert!(
        matches!(&error, Error::BadRequest { details, .. } if details[0].to_string().contains("route_type")),
        "{error}"
    );
    assert_eq!(network.kme("kme-a").unwrap().counters().keys_to_masters, 0);
}

#[tokio::test]
async fn an_sae_id_with_any_characters_is_one_path_segment() {
    let Pair { network, master, .. } = pair().await;
    for id in ["sae-b/status?x=#", "a%2fb", "ü ; x", "sae-b/../sae-c"] {
        let error = master.status(id).await.unwrap_err();
        assert!(matches!(&error, Error::BadRequest { .. }), "{id}: {error}");
    }
    assert_eq!(network.kme("kme-a").unwrap().counters().status_calls, 4);
}

// Who gets which key

#[tokio::test]
async fn a_key_is_given_to_its_slave_once() {
    let Pair { network, master, slave } = pair().await;
    let key = master.enc_keys("sae-b").send().await.unwrap().into_single();
    let same = slave.dec_keys("sae-a").key_id(key.key_id()).send().await.unwrap().into_single();
    assert!(key == same);
    let error = failed(slave.dec_keys("sae-a").key_id(key.key_id()).send().await);
    assert!(
        matches!(&error, Error::BadRequest { details, .. } if details[0]["key_ID"] == key.key_id()),
        "{error}"
    );
    assert_eq!(network.kme("kme-b").unwrap().counters().keys_to_slaves, 1);
}

#[tokio::test]
async fn a_key_is_given_only_to_its_slave() {
    let Pair { network, master, slave } = pair().await;
    let third = network.client_builder("sae-c").build().unwrap();
    let key = master.enc_keys("sae-b").send().await.unwrap().into_single();
    for (client, named) in [(&third, "sae-a"), (&master, "sae-a"), (&slave, "sae-c")] {
        let error = failed(client.dec_keys(named).key_id(key.key_id()).send().await);
        assert!(matches!(error, Error::Unauthorized { .. }), "{error}");
    }
    slave.dec_keys("sae-a").key_id(key.key_id()).send().await.unwrap();
}

#[tokio::test]
async fn a_batch_with_an_unknown_id_gives_and_consumes_nothing() {
    let Pair { network: _running, master, slave } = pair().await;
    let key = master.enc_keys("sae-b").send().await.unwrap().into_single();
    let both = slave.dec_keys("sae-a").key_ids([key.key_id(), UNKNOWN]).send().await;
    assert!(matches!(failed(both), Error::BadRequest { .. }));
    slave.dec_keys("sae-a").key_id(key.key_id()).send().await.unwrap();
}

#[tokio::test]
async fn keys_of_one_store_differ_and_arrive_in_the_order_asked() {
    let Pair { network: _running, master, slave } = pair().await;
    let drawn = master.enc_keys("sae-b").number(128).size(512).send().await.unwrap().keys;
    assert_eq!(drawn.len(), 128);
    for (at, key) in drawn.iter().enumerate() {
        assert_eq!(key.len(), 64);
        assert!(drawn[..at].iter().all(|other| other != key && other.key_id() != key.key_id()));
    }
    let ids: Vec<_> = drawn.iter().rev().map(|key| key.key_id().to_ascii_uppercase()).collect();
    let same = slave.dec_keys("sae-a").key_ids(&ids).size(512).send().await.unwrap();
    for ((key, asked), original) in same.into_iter().zip(&ids).zip(drawn.iter().rev()) {
        assert_eq!(key.key_id(), asked, "the caller's spelling");
        assert!(key == *original);
    }
}

#[tokio::test]
async fn both_methods_work_by_get_too() {
    let Pair { network: _running, master, slave } = pair().await;
    let keys = master.enc_keys("sae-b").number(2).size(128).via_get().send().await.unwrap().keys;
    for key in &keys {
        let same = slave.dec_keys("sae-a").key_id(key.key_id()).via_get().send().await.unwrap();
        assert!(same.into_single() == *key);
    }
    let plain = master.enc_keys("sae-b").via_get().send().await.unwrap().into_single();
    assert_eq!(plain.len(), 32);
}

#[tokio::test]
async fn multicast_gives_a_key_to_every_slave_named_once() {
    let Pair { network, master, slave } = pair().await;
    let third = network.client_builder("sae-c").build().unwrap();
    let request = master.enc_keys("sae-b").additional_slave_sae_ids(["sae-c"]);
    let key = request.send().await.unwrap().into_single();
    for client in [&slave, &third] {
        let same = client.dec_keys("sae-a").key_id(key.key_id()).send().await.unwrap();
        assert!(same.into_single() == key);
        assert!(client.dec_keys("sae-a").key_id(key.key_id()).send().await.is_err());
    }
}

#[tokio::test]
async fn extensions_travel_both_ways() {
    let Pair { network: _running, master, .. } = pair().await;
    let echo = json!({"kme_sim_echo": {"a": [1, null]}});
    let container =
        master.enc_keys("sae-b").extension_mandatory(echo.clone()).send().await.unwrap();
    assert_eq!(container.extension, Some(echo));
    let ignored = json!({"unheard_of": 1});
    let container = master.enc_keys("sae-b").extension_optional(ignored).send().await.unwrap();
    assert_eq!(container.extension, None);
}

// What the store holds

#[tokio::test]
async fn status_is_true_and_an_empty_store_answers_503() {
    let network = two()
        .fill_rate(FillRate::PerSecond(0.0))
        .initially_stored(3)
        .max_stored(50)
        .max_keys_per_request(5)
        .start()
        .await
        .unwrap();
    let client = network.client_builder("sae-a").retry(RetryPolicy::none()).build().unwrap();
    client.enc_keys("sae-b").number(2).send().await.unwrap();
    let status = client.status("sae-b").await.unwrap();
    assert_eq!((status.source_kme_id.as_str(), status.target_kme_id.as_str()), ("kme-a", "kme-b"));
    assert_eq!((status.master_sae_id.as_str(), status.slave_sae_id.as_str()), ("sae-a", "sae-b"));
    assert_eq!((status.key_size, status.stored_key_count, status.max_key_count), (256, 1, 50));
    assert_eq!(status.max_key_per_request, 5);
    let error = failed(client.enc_keys("sae-b").number(2).send().await);
    assert!(matches!(error, Error::Unavailable { .. }), "{error}");
    assert!(error.is_transient() && !error.keys_may_be_consumed());
    client.enc_keys("sae-b").send().await.unwrap();
    // The stock of two SAEs of one KME is another one.
    assert_eq!(client.status("sae-c").await.unwrap().stored_key_count, 3);
}

#[tokio::test]
async fn a_store_fills_again() {
    let network =
        two().fill_rate(FillRate::PerSecond(200.0)).initially_stored(0).start().await.unwrap();
    let policy = RetryPolicy::none()
        .enc_keys(1000)
        .pause(Duration::from_millis(5), Duration::from_millis(5));
    let client = network.client_builder("sae-a").retry(policy).build().unwrap();
    client.enc_keys("sae-b").number(4).send().await.unwrap();
    assert_eq!(network.kme("kme-a").unwrap().counters().keys_to_masters, 4);
}

// Material

#[tokio::test]
async fn written_files_suffice_for_a_client_and_key_files_are_private() {
    let Pair { network, .. } = pair().await;
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path().join("certs");
    network.write_files(&dir).unwrap();
    let env: std::collections::HashMap<_, _> =
        network.sae("sae-a").unwrap().env(&dir).into_iter().collect();
    let client = Client::builder()
        .kme_url(&env["AXON_KME_URL"])
        .ca_file(&env["AXON_KME_CA"])
        .kme_id(&env["AXON_KME_ID"])
        .sae_cert_file(&env["AXON_SAE_CERT"])
        .sae_key_file(&env["AXON_SAE_KEY"])
        .build()
        .unwrap();
    assert_eq!(client.status("sae-b").await.unwrap().master_sae_id, env["AXON_SAE_ID"]);
    #[cfg(unix)]
    for key in ["sae-a.key", "sae-b.key", "kme-a.key", "kme-b.key"] {
        use std::os::unix::fs::PermissionsExt;
        let mode = std::fs::metadata(dir.join(key)).unwrap().permissions().mode();
        assert_eq!(mode & 0o777, 0o600, "{key}");
    }
}

#[tokio::test]
async fn material_may_be_der() {
    use rustls_pki_types::pem::PemObject;
    use rustls_pki_types::{CertificateDer, PrivateKeyDer};
    let Pair { network, .. } = pair().await;
    let sae = network.sae("sae-a").unwrap();
    let der = |pem: &str| CertificateDer::from_pem_slice(pem.as_bytes()).unwrap().to_vec();
    let key = PrivateKeyDer::from_pem_slice(sae.key_pem().as_bytes()).unwrap();
    let client = network
        .client_builder("sae-a")
        .ca(der(sae.ca_pem()))
        .sae_cert(der(sae.cert_pem()))
        .sae_key(key.secret_der().to_vec())
        .build()
        .unwrap();
    client.status("sae-b").await.unwrap();
}

#[tokio::test]
async fn nothing_secret_is_printed() {
    let Pair { network, master, .. } = pair().await;
    let sae = network.sae("sae-a").unwrap();
    let shown = format!("{master:?} {:?} {:?}", network.client_builder("sae-a"), Quirks::STRICT);
    let middle = &sae.key_pem()[60..90];
    assert!(!shown.contains(middle) && !shown.contains("BEGIN"), "{shown}");
}
