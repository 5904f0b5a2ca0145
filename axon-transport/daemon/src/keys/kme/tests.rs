//! Tests against the simulator: real HTTP over real mutual TLS.

use std::{path::Path, time::Duration};

use axon_envelope::KeyId;
use axon_transport::config::{QkdConfig, QkdPeers};
use etsi_qkd014::sim::{Fault, Network};
use secrecy::ExposeSecret;

use super::{Kme, KmeError, RequestOrigin};
use crate::keys::{
    UsedKeys,
    request::{FailureKind, Fetched, KeyPurpose, KmeRequest},
};

async fn network() -> Network {
    let any = "127.0.0.1:0".parse().unwrap();
    let builder =
        Network::builder().strict().kme("kme-a", any, ["sae-a"]).kme("kme-b", any, ["sae-b"]);
    builder.start().await.unwrap()
}

/// Returns the settings of `sae`, with its files under `dir`.
fn config(network: &Network, sae: &str, dir: &Path) -> QkdConfig {
    network.write_files(dir).unwrap();
    let env: std::collections::HashMap<_, _> =
        network.sae(sae).unwrap().env(dir).into_iter().collect();
    let of = |name: &str| env[name].clone();
    let mut config = QkdConfig::new(
        of("AXON_SAE_ID"),
        QkdPeers::Any,
        of("AXON_KME_URL"),
        of("AXON_KME_CA"),
        of("AXON_SAE_CERT"),
        of("AXON_SAE_KEY"),
    );
    config.kme_id = env.get("AXON_KME_ID").cloned();
    (config.kme_connect_timeout, config.kme_answer_timeout) = (LONG, LONG);
    config
}

fn enc(number: u32) -> KmeRequest {
    KmeRequest::Enc { slave: "sae-b".to_owned(), number, purpose: KeyPurpose::Messages }
}

const LONG: Duration = Duration::from_secs(30);

#[tokio::test(flavor = "multi_thread")]
async fn start_up_names_the_variable_that_is_wrong() {
    let network = network().await;
    let dir = tempfile::tempdir().unwrap();
    let good = config(&network, "sae-a", dir.path());
    Kme::check(&good).unwrap();
    let junk = dir.path().join("junk.pem");
    std::fs::write(&junk, "-----BEGIN CERTIFICATE-----\njunk\n-----END CERTIFICATE-----\n")
        .unwrap();
    let absent = dir.path().join("absent.pem");
    let wrong = |change: &dyn Fn(&mut QkdConfig)| {
        let mut config = good.clone();
        change(&mut config);
        match Kme::check(&config) {
            Err(KmeError::File { variable, .. } | KmeError::Setting { variable, .. }) => variable,
            Ok(()) => "nothing",
        }
    };
    assert_eq!(wrong(&|c| c.kme_ca = absent.clone()), "AXON_KME_CA");
    assert_eq!(wrong(&|c| c.sae_cert = absent.clone()), "AXON_SAE_CERT");
    assert_eq!(wrong(&|c| c.sae_key = absent.clone()), "AXON_SAE_KEY");
    assert_eq!(wrong(&|c| c.kme_ca = junk.clone()), "AXON_KME_CA");
    assert_eq!(wrong(&|c| c.sae_cert = junk.clone()), "AXON_SAE_CERT");
    assert_eq!(wrong(&|c| c.sae_key = junk.clone()), "AXON_SAE_KEY");
    assert_eq!(wrong(&|c| c.kme_url = "http://127.0.0.1".to_owned()), "AXON_KME_URL");
    assert_eq!(wrong(&|c| c.kme_quirks = vec!["lenient".to_owned()]), "AXON_KME_QUIRKS");
}

#[tokio::test(flavor = "multi_thread")]
async fn keys_reach_both_sides_and_are_counted() {
    let network = network().await;
    let dir = tempfile::tempdir().unwrap();
    let (a, mut a_events) =
        Kme::start(&config(&network, "sae-a", dir.path()), UsedKeys::in_memory()).unwrap();
    let (b, mut b_events) =
        Kme::start(&config(&network, "sae-b", dir.path()), UsedKeys::in_memory()).unwrap();
    assert!(a.probe("sae-b").await.is_ok());

    a.submit(RequestOrigin::Sender(7), enc(3)).unwrap();
    let event = a_events.recv().await.unwrap();
    assert_eq!(event.origin, RequestOrigin::Sender(7));
    let Ok(Fetched::Keys(masters)) = event.answer.outcome else { panic!() };
    assert_eq!(masters.len(), 3);

    let key_ids: Vec<KeyId> = masters.iter().map(|(id, _)| id.clone()).collect();
    let (master, purpose) = ("sae-a".to_owned(), KeyPurpose::Accept);
    let dec = KmeRequest::Dec { master, key_ids, purpose };
    b.submit(RequestOrigin::Acceptor, dec.clone()).unwrap();
    let event = b_events.recv().await.unwrap();
    assert_eq!(event.origin, RequestOrigin::Acceptor);
    let Ok(Fetched::Keys(slaves)) = event.answer.outcome else { panic!() };
    for ((master_id, master), (slave_id, slave)) in masters.iter().zip(&slaves) {
        assert_eq!(master_id, slave_id);
        assert!(master.expose_secret() == slave.expose_secret());
    }

    let unknown = KeyId::new("00000000-0000-4000-8000-000000000000").unwrap();
    let KmeRequest::Dec { master, purpose, .. } = dec else { unreachable!() };
    let dec = KmeRequest::Dec { master, key_ids: vec![unknown], purpose };
    b.submit(RequestOrigin::Acceptor, dec).unwrap();
    let failure = b_events.recv().await.unwrap().answer.outcome.expect_err("no such key");
    assert_eq!(failure.kind, FailureKind::Refused, "{failure}");

    let (a, b) = (a.statistics(), b.statistics());
    assert_eq!((a.keys_messages, a.keys(), a.enc_keys.calls, a.status.calls), (3, 3, 1, 1));
    assert_eq!((b.keys_accept, b.dec_keys.calls, b.dec_keys.failures), (3, 2, 1));
    assert!(a.enc_keys.latency_ms.is_some());
}

#[tokio::test(flavor = "multi_thread")]
async fn failures_say_whether_keys_may_be_lost() {
    let network = network().await;
    let dir = tempfile::tempdir().unwrap();
    let settings = config(&network, "sae-a", dir.path());
    let (kme, mut events) = Kme::start(&settings, UsedKeys::in_memory()).unwrap();
    let sim = network.kme("kme-a").unwrap();
    for (fault, kind) in [
        (Fault::Empty, FailureKind::Unavailable),
        (Fault::CutAnswer, FailureKind::Ambiguous),
        (Fault::ResetAfterRequest, FailureKind::Ambiguous),
        (Fault::WrongLength, FailureKind::Ambiguous),
        (Fault::Garbage, FailureKind::Ambiguous),
    ] {
        let name = format!("{fault:?}");
        sim.inject(fault, 1);
        kme.submit(RequestOrigin::Sender(0), enc(2)).unwrap();
        let failure = events.recv().await.unwrap().answer.outcome.expect_err("a fault");
        assert_eq!(failure.kind, kind, "{name}: {failure}");
        assert_eq!(kme.statistics().last_failure, Some(failure.text));
    }
    assert_eq!(kme.statistics().keys_possibly_lost, 8);

    sim.inject(Fault::Busy(7), 1);
    kme.submit(RequestOrigin::Sender(0), enc(2)).unwrap();
    let failure = events.recv().await.unwrap().answer.outcome.expect_err("busy");
    assert_eq!(failure.kind, FailureKind::Unavailable, "{failure}");
    assert_eq!(failure.retry_after, Some(Duration::from_secs(7)));

    sim.inject(Fault::Silence, 1);
    let mut hurried = settings.clone();
    hurried.kme_answer_timeout = Duration::from_secs(1);
    let (kme, mut events) = Kme::start(&hurried, UsedKeys::in_memory()).unwrap();
    kme.submit(RequestOrigin::Sender(0), enc(2)).unwrap();
    let failure = events.recv().await.unwrap().answer.outcome.expect_err("too slow");
    assert_eq!(failure.kind, FailureKind::Ambiguous, "{failure}");

    let mut gone = settings.clone();
    gone.kme_url = "https://127.0.0.1:1".to_owned();
    let (gone, _events) = Kme::start(&gone, UsedKeys::in_memory()).unwrap();
    let failure = gone.probe("sae-b").await.unwrap_err();
    assert_eq!(failure.kind, FailureKind::Unreachable, "{failure}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_stuck_kme_holds_no_more_than_its_bounds_and_links_go_first() {
    let network = network().await;
    let dir = tempfile::tempdir().unwrap();
    let (kme, mut events) =
        Kme::start(&config(&network, "sae-a", dir.path()), UsedKeys::in_memory()).unwrap();
    let sim = network.kme("kme-a").unwrap();
    sim.inject(Fault::Silence, 16);
    for _ in 0..16 {
        kme.submit(RequestOrigin::Sender(0), enc(1)).unwrap();
    }
    // All sixteen calls for messages hang once the faults are used up. Nothing leaves the queue from then on.
    while !sim.plans().is_empty() {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    let mut queued = 0;
    let refused = loop {
        match kme.submit(RequestOrigin::Sender(4), enc(1)) {
            Ok(()) => queued += 1,
            Err(refused) => break refused,
        }
        assert!(queued <= 2000, "unbounded");
        tokio::task::yield_now().await;
    };
    assert_eq!(refused.origin, RequestOrigin::Sender(4));
    assert_eq!(refused.answer.outcome.err().unwrap().kind, FailureKind::Busy);

    // A link still gets in.
    let (slave, purpose) = ("sae-b".to_owned(), KeyPurpose::Bootstrap);
    let bootstrap = KmeRequest::Enc { slave, number: 1, purpose };
    kme.submit(RequestOrigin::Dialler, bootstrap).unwrap();
    let event = events.recv().await.unwrap();
    assert_eq!(event.origin, RequestOrigin::Dialler);
    assert!(event.answer.outcome.is_ok());
}

/// The order of the answers shows it: the first call would wait for half a minute.
#[tokio::test(flavor = "multi_thread")]
async fn request_does_not_wait_for_one_that_the_kme_never_answers() {
    let network = network().await;
    let dir = tempfile::tempdir().unwrap();
    let (kme, mut events) =
        Kme::start(&config(&network, "sae-a", dir.path()), UsedKeys::in_memory()).unwrap();
    let sim = network.kme("kme-a").unwrap();
    let (slave, purpose) = ("sae-b".to_owned(), KeyPurpose::Bootstrap);
    let for_a_link = KmeRequest::Enc { slave, number: 1, purpose };
    for request in [enc(1), for_a_link] {
        sim.inject(Fault::Silence, 1);
        kme.submit(RequestOrigin::Sender(1), request.clone()).unwrap();
        // The KME has received the request and does not answer it.
        while !sim.plans().is_empty() {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        kme.submit(RequestOrigin::Sender(2), request).unwrap();
        let event = events.recv().await.unwrap();
        assert_eq!(event.origin, RequestOrigin::Sender(2), "the first one's end was waited for");
        assert!(event.answer.outcome.is_ok());
    }
}

/// Time stands still except while the test waits for something: seconds are exact, and take none.
#[tokio::test]
async fn silent_kme_is_given_up_after_the_answer_limit_of_the_settings() {
    let network = network().await;
    let dir = tempfile::tempdir().unwrap();
    let settings = config(&network, "sae-a", dir.path());
    let sim = network.kme("kme-a").unwrap();
    for seconds in [3, 7] {
        let limit = Duration::from_secs(seconds);
        let mut settings = settings.clone();
        settings.kme_answer_timeout = limit;
        let (kme, mut events) = Kme::start(&settings, UsedKeys::in_memory()).unwrap();
        // The client has a connection already, so that the test's time does not pass while one is made.
        kme.probe("sae-b").await.unwrap();
        sim.inject(Fault::Silence, 1);
        tokio::time::pause();
        let begun = tokio::time::Instant::now();
        kme.submit(RequestOrigin::Sender(0), enc(1)).unwrap();
        let failure = events.recv().await.unwrap().answer.outcome.expect_err("silence");
        let took = begun.elapsed();
        tokio::time::resume();
        assert_eq!(failure.kind, FailureKind::Ambiguous, "{failure}");
        assert!(took.abs_diff(limit) < Duration::from_millis(50), "{took:?} and not {limit:?}");
        sim.clear_faults();
    }
}

/// As in the test above. The kernel accepts the connection, and no process speaks TLS on it.
#[tokio::test]
async fn unreachable_kme_is_given_up_after_the_connect_timeout() {
    let network = network().await;
    let dir = tempfile::tempdir().unwrap();
    let settings = config(&network, "sae-a", dir.path());
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let kme_url = format!("https://{}", listener.local_addr().unwrap());
    for seconds in [2, 5] {
        let limit = Duration::from_secs(seconds);
        let mut settings = settings.clone();
        (settings.kme_connect_timeout, settings.kme_url) = (limit, kme_url.clone());
        let (kme, _events) = Kme::start(&settings, UsedKeys::in_memory()).unwrap();
        tokio::time::pause();
        let begun = tokio::time::Instant::now();
        let failure = kme.probe("sae-b").await.unwrap_err();
        let took = begun.elapsed();
        tokio::time::resume();
        assert_eq!(failure.kind, FailureKind::Unreachable, "{failure}");
        assert!(took.abs_diff(limit) < Duration::from_millis(50), "{took:?} and not {limit:?}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn events_end_when_the_last_handle_is_dropped() {
    let network = network().await;
    let dir = tempfile::tempdir().unwrap();
    let (kme, mut events) =
        Kme::start(&config(&network, "sae-a", dir.path()), UsedKeys::in_memory()).unwrap();
    kme.submit(RequestOrigin::Dialler, enc(1)).unwrap();
    drop(kme);
    assert!(events.recv().await.is_some(), "what was asked is answered");
    assert!(events.recv().await.is_none());
}

#[tokio::test(flavor = "multi_thread")]
async fn keys_that_come_again_after_a_restart_are_not_given_out() {
    let network = network().await;
    let dir = tempfile::tempdir().unwrap();
    let settings = config(&network, "sae-a", dir.path());
    let start = || Kme::start(&settings, UsedKeys::open(Some(dir.path()), 0)).unwrap();
    network.note_state();
    let draw = async |number| {
        let (kme, mut events) = start();
        kme.submit(RequestOrigin::Sender(0), enc(number)).unwrap();
        let outcome = events.recv().await.unwrap().answer.outcome;
        // Dropping the last reference releases the file.
        drop(kme);
        assert!(events.recv().await.is_none());
        match outcome {
            Ok(Fetched::Keys(keys)) => Ok(keys.into_iter().map(|(id, _)| id).collect::<Vec<_>>()),
            Ok(other) => panic!("{other:?}"),
            Err(failure) => Err(failure),
        }
    };
    let first = draw(3).await.unwrap();
    network.set_back();
    let failure = draw(2).await.unwrap_err();
    assert_eq!(failure.kind, FailureKind::Repeated);
    assert!(failure.text.contains(&first[1].to_string()), "{failure}");
    let rest = draw(4).await.unwrap();
    assert_eq!(rest.len(), 3, "one is left of those before");
    assert!(!rest.iter().any(|key_id| first.contains(key_id)));
}

/// Without this check a daemon that waits for a pipe's writer would never start, and a file without end would take all
/// memory.
#[tokio::test]
async fn files_that_are_no_such_files_are_refused_at_once() {
    use std::os::unix::fs::PermissionsExt;

    let network = network().await;
    let dir = tempfile::tempdir().unwrap();
    let config = config(&network, "sae-a", dir.path());
    Kme::check(&config).unwrap();
    let place = |name: &str| dir.path().join(name);

    let pipe = place("pipe");
    let mode = rustix::fs::Mode::RUSR | rustix::fs::Mode::WUSR;
    rustix::fs::mknodat(rustix::fs::CWD, &pipe, rustix::fs::FileType::Fifo, mode, 0).unwrap();
    let large = place("large");
    std::fs::File::create(&large).unwrap().set_len(5 << 20).unwrap();
    std::fs::set_permissions(&large, PermissionsExt::from_mode(0o600)).unwrap();
    let open = place("open");
    std::fs::copy(&config.sae_key, &open).unwrap();
    std::fs::set_permissions(&open, PermissionsExt::from_mode(0o644)).unwrap();

    for (path, expected) in
        [(&pipe, "not a regular file"), (&large, "larger than 64 KiB"), (&open, "chmod 600")]
    {
        let mut config = config.clone();
        config.sae_key = path.clone();
        let (sender, answer) = std::sync::mpsc::channel();
        std::thread::spawn(move || sender.send(Kme::check(&config)));
        let refused = answer.recv_timeout(LONG).expect("is refused at once").unwrap_err();
        let KmeError::File { variable: "AXON_SAE_KEY", reason, .. } = refused else {
            panic!("{refused}")
        };
        assert!(reason.contains(expected), "{reason}");
    }
}

#[test]
fn every_quirk_of_the_client_can_be_set_and_no_other() {
    let of_client = etsi_qkd014::Quirks::NAMES.map(|(name, _)| name);
    let of_daemon = [QkdConfig::NO_NAME_CHECK];
    let names: Vec<_> = of_client.into_iter().chain(of_daemon).collect();
    assert_eq!(names, QkdConfig::KME_QUIRKS);
}
