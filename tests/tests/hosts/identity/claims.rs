//! A peer that links under the id of another host's daemon, which anybody can read in its beacons.

use std::{sync::Arc, time::Duration};

use axon_tls::identity::{Auth, CaMaterial, SigningKey};
use axon_transport::{EndpointSpec, qos::Qos};
use tempfile::tempdir;

use super::{
    super::{
        greedy::Camera,
        mode::classic,
        pair::{Host, Plan},
        process::{PATIENCE, until},
        stranger::{Claim, Stranger},
    },
    authority::{Authority, settings},
    daemon_id,
};

/// Checks that a claim of B's id is refused while B's link stands. A claim that came first ends with B's next link. A
/// calls the peer that claims it `name`.
fn keeps_nobody_out(
    a: &mut Host,
    b: &Host,
    (stranger, auth, claim): (&Stranger, &Auth, Claim<'_>),
    name: &str,
) {
    let owner = b.status().daemon;
    until("B is linked", || a.status().links.iter().any(|link| link.peer == owner));
    let proved = a.link().authenticated_as;
    let claim = Claim { daemon: daemon_id(&owner), ..claim };
    let why = stranger.dial_as(a, auth, &claim).expect_err("it is B's");
    assert!(why.contains("that of another host"), "{why}");
    let is_told = |text: &str| {
        [name, &owner, "claims daemon id", "which proved it"].iter().all(|part| text.contains(part))
    };
    a.wait_refusal("the claim, by name", is_told);
    assert_eq!(a.link().authenticated_as, proved);

    let stopped = b.stop_daemon();
    a.kill_daemon();
    a.start();
    let mut link = stranger.dial_as(a, auth, &claim).expect("nobody else is there");
    until("it is first", || a.status().links.iter().any(|link| link.peer == owner));
    assert_ne!(a.link().authenticated_as, proved);
    drop(stopped);
    until("B is linked", || a.status().links.iter().any(|link| link.authenticated_as == proved));
    let why = stranger.hear(&mut link, |_| false).expect_err("its link is closed");
    assert!(why.contains("that of another host"), "{why}");
    a.wait_refusal("the claim, by name", is_told);
    assert_eq!(a.link().peer, owner);

    let spec = || EndpointSpec::new("/owned", "test/Text", Qos::keep_all());
    let (reader, writer) = (a.session("reader"), b.session("writer"));
    let subscription = reader.create_subscription(spec()).unwrap();
    let publisher = writer.create_publisher(spec()).unwrap();
    assert!(publisher.wait_matched(1, PATIENCE) && subscription.wait_matched(1, PATIENCE));
    let mut bytes = Vec::new();
    for number in 1..=20 {
        // The claim is made again and again.
        if number % 5 == 0 {
            stranger.dial_as(a, auth, &claim).expect_err("it is B's");
        }
        assert_eq!(publisher.publish(b"sample").unwrap(), number);
        assert_eq!(subscription.recv(&mut bytes, Some(PATIENCE)).unwrap().sequence, number);
    }
    assert!(publisher.wait_acknowledged(Duration::from_secs(30)));
}

#[test]
fn a_pinned_peer_under_the_id_of_another_host_does_not_keep_that_out() {
    let mut camera = Camera::new();
    let Camera { stranger, auth, a, b, .. } = &mut camera;
    keeps_nobody_out(a, b, (stranger, auth, Claim::pinned("camera")), "camera");
}

#[test]
fn a_certified_peer_under_the_id_of_another_host_does_not_keep_that_out() {
    let (dir, ca) = (tempdir().unwrap(), Authority::new("the CA"));
    let of = |letter: &str, serial| {
        let own = ca.issue(&format!("host-{letter}"), serial, 2100);
        settings(dir.path(), letter, &ca.pem, &own, None)
    };
    let [mut a, b] = Plan::new([of("a", 1), of("b", 2)]).start();
    let own = ca.issue("camera", 3, 2100);
    let material = CaMaterial::from_pem(&ca.pem, &own.pem, &own.key, None).unwrap();
    let auth = Auth::Ca(Arc::new(material.with_names_checked_by_application()));
    keeps_nobody_out(&mut a, &b, (&Stranger::new(), &auth, Claim::ca("camera")), "camera");
}

#[test]
fn a_host_that_proves_nothing_else_proves_its_daemons_id() {
    let [mut a, b] = Plan::new([classic(&[]), classic(&[])]).start();
    let auth = Auth::None(SigningKey::generate().unwrap());
    let claim = Claim { auth: 0, ..Claim::pinned("camera") };
    keeps_nobody_out(&mut a, &b, (&Stranger::new(), &auth, claim), "UNAUTHENTICATED");
}
