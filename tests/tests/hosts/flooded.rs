//! A stranger whose handshakes are refused, again and again.

use std::time::Instant;

use axon_daemon::internal::link::{GraphUpdate, LinkMessage};
use axon_tls::identity::{Auth, KeyAlgorithm, SigningKey, Trust, TrustFile};
use axon_transport::{
    Session, SessionOptions,
    config::QuicCipher,
    graph::{Endpoint, EndpointKind},
    ids::{Gid, SessionId},
};

use super::{
    greedy::Camera,
    mode::pinned,
    pair::Plan,
    stranger::{Claim, Stranger},
};

const HANDSHAKES: u64 = 400;

#[test]
fn refused_handshakes_leave_few_lines_in_the_log() {
    let dir = tempfile::tempdir().unwrap();
    let settings = pinned(dir.path(), [[true; 2]; 2]);
    let own = std::fs::read_to_string(dir.path().join("host-0.key")).unwrap();
    let own = SigningKey::from_pem(&own).unwrap().spki_digest();
    let [mut host, _] = Plan::new(settings).prepare();
    host.set("AXON_LOG", "info");
    host.start();
    let pem = SigningKey::generate_pem_with(KeyAlgorithm::Ed25519).unwrap();
    let pins = TrustFile::parse(&format!("a {own}")).unwrap();
    let auth = Auth::Pinned { key: SigningKey::from_pem(&pem).unwrap(), trust: Trust::new(pins) };
    let (stranger, port) = (Stranger::new(), host.status().port.unwrap());
    let before = host.log_lines(&[]);
    let bytes = host.log_bytes();
    let begin = Instant::now();
    for _ in 0..HANDSHAKES {
        let to = (host.address, port).into();
        let dialled = stranger.dial_at(to, host.domain(), &auth, &Claim::pinned("stranger"));
        assert!(dialled.is_err(), "nobody pinned it");
    }
    host.wait_refusal("the last is shown", |text| text.contains("trust"));
    let (bytes, lines) = (host.log_bytes() - bytes, (host.log_lines(&[]) - before) as u64);
    let (refused, took) = (host.log_lines(&["trust"]) as u64, begin.elapsed());
    eprintln!(
        "{HANDSHAKES} refused handshakes in {took:?}: {lines} lines, {:.0} bytes a second",
        bytes as f64 / took.as_secs_f64()
    );
    // Ten at once, and then one a second.
    let most = 10 + took.as_secs() + 1;
    assert!(lines <= most + 2, "{lines} lines in {took:?}");
    assert!(refused > 0 && lines < HANDSHAKES / 2, "{refused} and {lines}");
}

#[test]
fn flood_of_unknown_peers_hides_no_other_refusal() {
    let camera = Camera::new();
    let host = &camera.a;
    let mut link = camera.link(0xff);
    let Auth::Pinned { trust, .. } = &camera.auth else { panic!("it is pinned") };
    let pem = SigningKey::generate_pem_with(KeyAlgorithm::Ed25519).unwrap();
    let auth = Auth::Pinned { key: SigningKey::from_pem(&pem).unwrap(), trust: trust.clone() };
    let to = (host.address, host.status().port.unwrap()).into();
    let stranger = Stranger::new();
    let flood = |handshakes| {
        for _ in 0..handshakes {
            let dialled = stranger.dial_at(to, host.domain(), &auth, &Claim::pinned("stranger"));
            assert!(dialled.is_err(), "nobody pinned it");
        }
    };
    flood(60);
    for name in ["one", "two", "three", "four"] {
        let mut config = host.config();
        config.cipher = match config.cipher {
            QuicCipher::Aes256Gcm => QuicCipher::ChaCha20Poly1305,
            _ => QuicCipher::Aes256Gcm,
        };
        let options = SessionOptions::new(format!("differs_{name}"));
        assert!(Session::open(&config, options).is_err(), "AXON_QUIC_CIPHER differs");
        flood(10);
    }
    let gid = Gid::new(SessionId([7; 16]), 1);
    let claim = Endpoint::new(gid, EndpointKind::Publisher, "/claimed", "test/Text");
    let graph = GraphUpdate { version: 1, added: vec![claim], ..GraphUpdate::default() };
    camera.stranger.say(&mut link, &LinkMessage::Graph(graph));
    camera.a.wait_refusal("the claim", |text| text.contains("did not prove"));
    flood(60);
    let strangers = |text: &str| text.contains("trust");
    host.wait_refusal("the last stranger", strangers);
    let refusals = host.status().refusals;
    let texts: Vec<_> =
        refusals.iter().map(|r| format!("{} {} {}", r.peer, r.what, r.reason)).collect();
    let has =
        |parts: &[&str]| texts.iter().any(|text| parts.iter().all(|part| text.contains(part)));
    for name in ["one", "two", "three", "four"] {
        let name = format!("differs_{name}");
        assert!(has(&[&name, "AXON_QUIC_CIPHER"]), "{texts:?}");
        assert_eq!(host.log_lines(&["refused", &name, "AXON_QUIC_CIPHER"]), 1, "{name}");
    }
    assert!(has(&["camera", "did not prove"]), "{texts:?}");
    assert!(host.log_lines(&["refused", "camera", "did not prove"]) >= 1);
    let of_strangers = texts.iter().filter(|text| strangers(text)).count();
    assert!((1..=8).contains(&of_strangers), "{texts:?}");
}
