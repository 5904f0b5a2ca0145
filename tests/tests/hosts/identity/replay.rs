//! The datagrams of somebody else's link, sent once more.

use std::{
    fs,
    net::{Ipv4Addr, SocketAddr, UdpSocket},
};

use axon_tls::identity::{Auth, KeyAlgorithm, SigningKey, Trust, TrustFile};

use super::super::{
    mode::pinned,
    pair::Plan,
    process::until,
    stranger::{Claim, Stranger},
    wire::Wire,
};

#[test]
fn replayed_handshake_packets_make_no_second_link() {
    let dir = tempfile::tempdir().unwrap();
    let settings = pinned(dir.path(), [[false, true], [true, false]]);
    let key = SigningKey::from_pem(&SigningKey::generate_pem_with(KeyAlgorithm::Ed25519).unwrap())
        .unwrap();
    let trust = dir.path().join("host-0.trust");
    let lines = fs::read_to_string(&trust).unwrap();
    fs::write(&trust, lines + &format!("camera {}\n", key.spki_digest())).unwrap();
    let own = SigningKey::from_pem(&fs::read_to_string(dir.path().join("host-0.key")).unwrap());
    let pins = TrustFile::parse(&format!("a {}", own.unwrap().spki_digest())).unwrap();
    let camera = Auth::Pinned { key, trust: Trust::new(pins) };

    let [a, b] = Plan::new(settings).start();
    b.link();
    let server = SocketAddr::from((a.address, a.status().port.unwrap()));
    let anywhere = SocketAddr::from((Ipv4Addr::LOCALHOST, 0));
    let wire = Wire::between(anywhere, anywhere, server);
    let stranger = Stranger::new();
    let claim = Claim::pinned("camera");
    let link = stranger.dial_at(wire.address, a.domain(), &camera, &claim).expect("a link");
    let is_camera = || a.status().links.iter().filter(|l| l.host == "camera").count();
    until("A knows the camera", || is_camera() == 1);
    let said = wire.said.lock().unwrap().clone();
    assert!(said.len() >= 4, "two Initials, a Handshake and a HELLO at least: {}", said.len());

    // The datagrams come from another address while the link stands, and from the original address when the link is
    // over.
    let elsewhere = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    for datagram in said.iter().cycle().take(5 * said.len()) {
        elsewhere.send_to(datagram, server).unwrap();
    }
    assert_eq!(is_camera(), 1);
    stranger.leave(&link);
    until("the camera has left", || is_camera() == 0);
    let refusals = a.status().refusals.len();
    for datagram in said.iter().cycle().take(5 * said.len()) {
        wire.towards.send_to(datagram, server).unwrap();
    }
    // Long enough for a second link, if there were one: the genuine one that follows is there.
    let link = stranger.dial(&a, &camera, &claim).expect("the camera itself");
    until("A knows the camera again", || is_camera() == 1);
    stranger.leave(&link);
    until("the camera has left again", || is_camera() == 0);
    let (links, after) = (a.status().links, a.status().refusals);
    assert_eq!(links.len(), 1, "B alone: {links:?}");
    assert!(after.len() >= refusals && a.is_first_daemon(), "{after:?}");
}
