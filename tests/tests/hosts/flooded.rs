//! A stranger whose handshakes are refused, again and again.

use std::time::Instant;

use axon_tls::identity::{Auth, KeyAlgorithm, SigningKey, Trust, TrustFile};

use super::{
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
    // Of each kind ten at once, and then one a second; a refusal is of two kinds at most.
    let most = 10 + took.as_secs() + 1;
    assert!(lines <= 2 * most, "{lines} lines in {took:?}");
    assert!(refused > 0 && lines < HANDSHAKES / 2, "{refused} and {lines}");
}
