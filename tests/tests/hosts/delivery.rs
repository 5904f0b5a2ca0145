//! A publisher on A, subscribers on A and B: everything arrives, once, in order, as it was.

use axon_tests::{Sizes, Tally};
use axon_transport::{EndpointSpec, qos::Qos};

use super::{
    mode::{Kmes, Settings, classic, pinned},
    pair::{Host, Plan},
    process::PATIENCE,
};

const MESSAGES: u64 = 300;

/// Delivers `MESSAGES` messages from the first host to both. Checks that both hosts show the negotiated key exchange
/// and cipher.
fn deliver(settings: [Settings; 2], key_exchange: &str, cipher: &str) -> [Host; 2] {
    let hosts = Plan::new(settings).start();
    let [a, b] = &hosts;
    let mut there = b.subscribe(Sizes::Mixed);
    let mut here = a.subscribe(Sizes::Mixed);
    let mut publisher = a.publish(Sizes::Mixed, 2, Some(MESSAGES));
    assert_eq!(publisher.wait_sent(), MESSAGES);
    let complete = Tally { taken: MESSAGES, first: 1, last: MESSAGES, ..Tally::default() };
    for subscriber in [&mut here, &mut there] {
        subscriber.wait_taken(MESSAGES);
        assert_eq!(subscriber.tally(), complete);
    }
    for host in &hosts {
        let link = host.link();
        assert_eq!((&*link.key_exchange, &*link.cipher), (key_exchange, cipher));
    }
    // One came too late for the last report, or again after it, if the counts differ now.
    assert_eq!(there.tally(), complete);
    for node in [publisher, here, there] {
        node.finish();
    }
    hosts
}

#[test]
fn a_publisher_that_counts_a_reader_elsewhere_reaches_it() {
    let [a, b] = Plan::new([classic(&[]), classic(&[])]).start();
    let (here, there) = (a.session("publishers"), b.session("subscription"));
    let spec = || EndpointSpec::new("/counted", "test/Bytes", Qos::default());
    let subscription = there.create_subscription(spec()).unwrap();
    // The route is there from the second one on, and its publishers are in it at once.
    for number in 0..20_u8 {
        let publisher = here.create_publisher(spec()).unwrap();
        assert!(publisher.wait_matched(1, PATIENCE));
        publisher.publish(&[number]).unwrap();
        let mut bytes = Vec::new();
        let info = subscription.recv(&mut bytes, Some(PATIENCE)).expect("what was published");
        assert_eq!((info.publisher, &bytes[..]), (publisher.gid(), &[number][..]));
    }
}

#[test]
fn classic_without_authentication() {
    let [_a, b] = deliver([classic(&[]), classic(&[])], "X25519MLKEM768", "chacha20-poly1305");
    let by = b.link().authenticated_as;
    assert!(by.starts_with("UNAUTHENTICATED"), "{by}");
}

#[test]
fn classic_with_pinned_keys() {
    let dir = tempfile::tempdir().unwrap();
    let settings = pinned(dir.path(), [[false, true], [true, false]]);
    let [a, b] = deliver(settings, "X25519MLKEM768", "chacha20-poly1305");
    for (host, peer) in [(a, "host-1 (spki-sha256:"), (b, "host-0 (spki-sha256:")] {
        let by = host.link().authenticated_as;
        assert!(by.starts_with(peer), "{by}");
    }
}

/// Delivers messages in qkd. Returns the number of keys that SAEs got as new ones, and by key_ID.
fn deliver_qkd(more: &[(&'static str, &str)], key_exchange: &str, cipher: &str) -> (u64, u64) {
    let kmes = Kmes::start();
    let settings = [0, 1].map(|host| kmes.settings(host, more));
    let [a, b] = deliver(settings, key_exchange, cipher);
    assert_eq!(a.link().sae.as_deref(), Some("sae-b"));
    assert_eq!(b.link().sae.as_deref(), Some("sae-a"));
    kmes.keys()
}

#[test]
fn qkd_session_psk_ke() {
    let mode = [("AXON_QKD_KEY_MODE", "session"), ("AXON_QKD_KEX", "psk_ke")];
    let (new, by_id) = deliver_qkd(&mode, "psk_ke", "chacha20-poly1305");
    // A key for the handshake, and one that proves the client's name.
    assert!(new >= 2 && by_id >= 2, "{new} and {by_id}");
}

#[test]
fn qkd_session_psk_dhe_ke_aes() {
    let mode = [
        ("AXON_QKD_KEY_MODE", "session"),
        ("AXON_QKD_KEX", "psk_dhe_ke"),
        ("AXON_QUIC_CIPHER", "aes-256-gcm"),
    ];
    let (new, by_id) = deliver_qkd(&mode, "psk_dhe_ke (X25519MLKEM768)", "aes-256-gcm");
    assert!(new >= 2 && by_id >= 2, "{new} and {by_id}");
}

#[test]
fn qkd_messages10() {
    let mode = [("AXON_QKD_KEY_MODE", "messages10")];
    let (new, by_id) = deliver_qkd(&mode, "psk_ke", "chacha20-poly1305");
    // Besides the handshake's, a key for every ten messages at most.
    let keys = MESSAGES.div_ceil(10) + 1;
    assert!(new >= keys && by_id >= keys, "{new} and {by_id}, {keys} needed");
}
