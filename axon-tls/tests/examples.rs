//! Runs the examples, which assert their own claims.
#![cfg(all(feature = "hybrid", feature = "quic", feature = "tokio"))]

#[path = "../examples/http3.rs"]
mod http3;
#[path = "../examples/hybrid.rs"]
mod hybrid;
#[path = "../examples/psk.rs"]
mod psk;
#[path = "../examples/quic_psk.rs"]
mod quic_psk;

#[test]
fn hybrid_over_tcp() {
    hybrid::main().unwrap();
}

#[test]
fn http3_with_a_web_certificate() {
    http3::main().unwrap();
}

#[test]
fn psk_over_tokio() {
    psk::main().unwrap();
}

#[test]
fn psk_over_quic() {
    quic_psk::main().unwrap();
}
