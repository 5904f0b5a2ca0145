//! This crate's client against a KME that shares no code with it, `python/kme.py`, written from the
//! text of the specification in Python's standard library.

mod python;

use etsi_qkd014::sim::{Layout, Pki, Site};
use etsi_qkd014::{Client, Error, KeyContainer, RefusedBy, RetryPolicy};
use python::Server;
use serde_json::json;

/// Directory with the certificates, and two KMEs that have `stored` keys to give.
struct Pair {
    dir: tempfile::TempDir,
    server: Server,
}

/// Creates the certificates. `kme-x` does not run: `sae-x` is certified, and attached to neither of the others.
fn pki() -> Pki {
    let site = |kme: &str, ip: [u8; 4], saes: &[&str]| Site {
        kme: kme.to_owned(),
        bind: (ip, 0).into(),
        saes: saes.iter().map(|&sae| sae.to_owned()).collect(),
    };
    let sites = vec![
        site("kme-a", [127, 0, 0, 1], &["sae-a", "sae-c"]),
        site("kme-b", [127, 0, 0, 2], &["sae-b"]),
        site("kme-x", [127, 0, 0, 3], &["sae-x"]),
    ];
    Pki::create(&Layout { sites }).unwrap()
}

impl Pair {
    fn start(stored: u32) -> Option<Self> {
        let dir = tempfile::tempdir().unwrap();
        pki().write(dir.path()).unwrap();
        let sites = ["kme-a=127.0.0.1=sae-a,sae-c", "kme-b=127.0.0.2=sae-b"];
        let server = Server::start(dir.path(), stored, &sites)?;
        Some(Self { dir, server })
    }

    fn client(&self, sae: &str, kme: &str) -> Client {
        self.client_with(sae, kme, self.dir.path())
    }

    fn client_with(&self, sae: &str, kme: &str, identity: &std::path::Path) -> Client {
        Client::builder()
            .kme_url(self.server.url(kme))
            .kme_id(kme)
            .ca_file(self.dir.path().join("ca.pem"))
            .sae_cert_file(identity.join(format!("{sae}.crt")))
            .sae_key_file(identity.join(format!("{sae}.key")))
            .retry(RetryPolicy::none())
            .build()
            .unwrap()
    }
}

fn failed(result: Result<KeyContainer, Error>) -> Error {
    result.err().expect("the call must fail")
}

#[tokio::test]
async fn refusals_of_the_python_kme_are_told_apart() {
    let Some(pair) = Pair::start(4) else { return };
    let (master, slave) = (pair.client("sae-a", "kme-a"), pair.client("sae-b", "kme-b"));

    // 400, with the words of the specification and its details.
    let error = failed(
        master.enc_keys("sae-b").extension_mandatory(json!({"abc_route": "direct"})).send().await,
    );
    let Error::BadRequest { message, details } = &error else { panic!("{error}") };
    assert_eq!(message, "not all extension_mandatory parameters are supported");
    assert_eq!(
        details,
        &[json!({"extension_mandatory_unsupported": "abc_route is not supported"})]
    );
    for result in [
        master.enc_keys("nobody").send().await,
        master.enc_keys("sae-b").number(129).send().await,
        master.enc_keys("sae-b").size(2048).via_get().send().await,
        slave.dec_keys("sae-a").key_id("bc490419-7d60-487f-adc1-4ddcc177c139").send().await,
    ] {
        let error = failed(result);
        assert!(matches!(error, Error::BadRequest { .. }), "{error}");
        assert!(!error.keys_may_be_consumed());
    }

    // 401, which has no body here: an SAE of no KME, one of another KME, and one that no key names.
    let outsider = pair.client("sae-x", "kme-a");
    assert!(matches!(outsider.status("sae-b").await, Err(Error::Unauthorized { .. })));
    let elsewhere = pair.client("sae-b", "kme-a");
    assert!(matches!(elsewhere.status("sae-b").await, Err(Error::Unauthorized { .. })));
    let key = master.enc_keys("sae-b").send().await.unwrap().into_single();
    let third = pair.client("sae-c", "kme-a");
    for via_get in [false, true] {
        let request = third.dec_keys("sae-a").key_id(key.key_id());
        let request = if via_get { request.via_get() } else { request };
        let error = failed(request.send().await);
        assert!(matches!(error, Error::Unauthorized { .. }), "{error}");
    }

    // 503 where the store holds less than was asked for; what it holds is still given.
    let error = failed(master.enc_keys("sae-b").number(4).send().await);
    assert!(matches!(error, Error::Unavailable { .. }), "{error}");
    assert!(error.is_transient() && !error.keys_may_be_consumed());
    master.enc_keys("sae-b").number(3).send().await.unwrap();
    assert_eq!(master.status("sae-b").await.unwrap().stored_key_count, 0);
}

#[tokio::test]
async fn a_stranger_is_refused_in_the_handshake() {
    let Some(pair) = Pair::start(1) else { return };
    let other = tempfile::tempdir().unwrap();
    pki().write(other.path()).unwrap();
    let error = pair.client_with("sae-a", "kme-a", other.path()).status("sae-b").await.unwrap_err();
    assert!(matches!(error, Error::Tls { refused_by: RefusedBy::Kme, .. }), "{error}");

    // The client refuses a KME with another id than the requested one.
    let wrong = Client::builder()
        .kme_url(pair.server.url("kme-a"))
        .kme_id("kme-b")
        .ca_file(pair.dir.path().join("ca.pem"))
        .sae_cert_file(pair.dir.path().join("sae-a.crt"))
        .sae_key_file(pair.dir.path().join("sae-a.key"))
        .build()
        .unwrap();
    let error = wrong.status("sae-b").await.unwrap_err();
    assert!(matches!(error, Error::Tls { refused_by: RefusedBy::Client, .. }), "{error}");
}

#[tokio::test]
async fn keys_go_both_ways_by_get_and_by_post() {
    let Some(pair) = Pair::start(1000) else { return };
    let (master, slave) = (pair.client("sae-a", "kme-a"), pair.client("sae-b", "kme-b"));

    let status = master.status("sae-b").await.unwrap();
    assert_eq!((status.source_kme_id.as_str(), status.target_kme_id.as_str()), ("kme-a", "kme-b"));
    assert_eq!((status.master_sae_id.as_str(), status.slave_sae_id.as_str()), ("sae-a", "sae-b"));
    assert_eq!((status.key_size, status.min_key_size, status.max_key_size), (352, 64, 1024));
    assert_eq!((status.stored_key_count, status.max_key_count), (1000, 100_000));
    assert_eq!((status.max_key_per_request, status.max_sae_id_count), (128, 2));

    // Without settings, the client gets one key of the KME's default size.
    for via_get in [false, true] {
        let request = master.enc_keys("sae-b");
        let request = if via_get { request.via_get() } else { request };
        let key = request.send().await.unwrap().into_single();
        assert_eq!(key.len(), 44);
        let request = slave.dec_keys("sae-a").key_id(key.key_id());
        let request = if via_get { request.via_get() } else { request };
        assert!(request.send().await.unwrap().into_single() == key);
        let again = slave.dec_keys("sae-a").key_id(key.key_id()).send().await;
        assert!(matches!(failed(again), Error::BadRequest { .. }));
    }
    for via_get in [false, true] {
        let request = master.enc_keys("sae-b").number(128).size(512);
        let request = if via_get { request.via_get() } else { request };
        let drawn = request.send().await.unwrap().keys;
        let ids: Vec<_> = drawn.iter().rev().map(|key| key.key_id().to_owned()).collect();
        let same = slave.dec_keys("sae-a").key_ids(&ids).size(512).send().await.unwrap();
        assert!(same.into_iter().zip(drawn.iter().rev()).all(|(a, b)| a == *b));
    }
}

#[tokio::test]
async fn multicast_and_extensions_are_understood() {
    let Some(pair) = Pair::start(10) else { return };
    let (master, slave) = (pair.client("sae-a", "kme-a"), pair.client("sae-b", "kme-b"));
    let third = pair.client("sae-c", "kme-a");
    let container = master
        .enc_keys("sae-b")
        .additional_slave_sae_ids(["sae-c"])
        .extension_mandatory(json!({"py_route_type": "direct"}))
        .extension_optional(json!({"py_unheard_of": [1, {"a": null}]}))
        .send()
        .await
        .unwrap();
    assert_eq!(container.extension, Some(json!({"py_route_type": "direct"})));
    let key = container.into_single();
    for client in [&slave, &third] {
        let same = client.dec_keys("sae-a").key_id(key.key_id()).send().await.unwrap();
        assert!(same.into_single() == key);
        assert!(client.dec_keys("sae-a").key_id(key.key_id()).send().await.is_err());
    }
}
