//! Certificates of a CA.

use std::{fs, path::Path, sync::Arc};

use axon_tests::{Sizes, Tally};
use axon_tls::identity::{Auth, CaMaterial};

use super::{
    super::{
        pair::{Host, Plan},
        process::until,
        stranger::{Claim, Stranger},
    },
    authority::{Authority, Certificate, settings},
};

/// Serial numbers of host A, of host B and of no host.
const A: u64 = 1;
const B: u64 = 2;
const NOBODY: u64 = 9;

/// Starts two hosts with certificates of one CA; host A has a revocation list if `crl` is one.
fn start(dir: &Path, ca: &Authority, b: &Certificate, crl: Option<&str>) -> [Host; 2] {
    let a = ca.issue("host-a", A, 2100);
    let a = settings(dir, "a", &ca.pem, &a, crl);
    let b = settings(dir, "b", &ca.pem, b, None);
    Plan::new([a, b]).start()
}

/// Checks that neither host links, and that each reports the reason.
fn refused(hosts: &[Host; 2], why: &str) {
    for host in hosts {
        host.wait_refusal(why, |text| text.contains(why));
        host.wait_log(&["link refused", why]);
    }
    for host in hosts {
        let links = host.status().links;
        assert!(links.is_empty(), "{links:?}");
    }
}

#[test]
fn hosts_of_one_ca_link_and_deliver() {
    let (dir, ca) = (tempfile::tempdir().unwrap(), Authority::new("the CA"));
    let crl = ca.revoke(NOBODY, 2100);
    let hosts = start(dir.path(), &ca, &ca.issue("host-b", B, 2100), Some(&crl));
    let [a, b] = &hosts;
    let mut there = b.subscribe(Sizes::Small);
    let mut publisher = a.publish(Sizes::Small, 1, Some(100));
    there.wait_taken(100);
    assert_eq!(publisher.wait_sent(), 100);
    assert_eq!(there.tally(), Tally { taken: 100, first: 1, last: 100, ..Tally::default() });
    for (host, peer) in [(a, "host-b"), (b, "host-a")] {
        let link = host.link();
        assert_eq!(link.host, peer);
        let by = format!("{peer} (certificate, spki-sha256:");
        assert!(link.authenticated_as.starts_with(&by), "{link:?}");
    }
}

#[test]
fn a_certificate_of_another_ca_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let (ca, other) = (Authority::new("the CA"), Authority::new("another CA"));
    // Both ends decide: B would accept A.
    let b = other.issue("host-b", B, 2100);
    refused(&start(dir.path(), &ca, &b, None), "trusted");
}

#[test]
fn a_certificate_that_ran_out_is_refused() {
    let (dir, ca) = (tempfile::tempdir().unwrap(), Authority::new("the CA"));
    let hosts = start(dir.path(), &ca, &ca.issue("host-b", B, 2021), None);
    refused(&hosts, "expired");
    // The log of the host reports it, so that the owner need not ask a peer.
    hosts[1].wait_log(&["this host's own certificate is not accepted"]);
}

#[test]
fn a_revoked_certificate_is_refused() {
    let (dir, ca) = (tempfile::tempdir().unwrap(), Authority::new("the CA"));
    let crl = ca.revoke(B, 2100);
    refused(&start(dir.path(), &ca, &ca.issue("host-b", B, 2100), Some(&crl)), "revoked");
}

#[test]
fn an_expired_revocation_list_refuses_every_peer() {
    let (dir, ca) = (tempfile::tempdir().unwrap(), Authority::new("the CA"));
    let crl = ca.revoke(NOBODY, 2021);
    let [a, b] = start(dir.path(), &ca, &ca.issue("host-b", B, 2100), Some(&crl));
    a.wait_refusal("A says that its list is old", |text| text.contains("ExpiredRevocationList"));
    b.wait_refusal("B is refused", |text| text.contains("refused by the peer"));
    // With a list of today it goes on, by itself.
    fs::write(dir.path().join("a.crl"), ca.revoke(NOBODY, 2100)).unwrap();
    a.link();
    b.link();
}

#[test]
fn a_reloaded_revocation_list_ends_the_link_of_a_revoked_peer() {
    let (dir, ca) = (tempfile::tempdir().unwrap(), Authority::new("the CA"));
    let crl = dir.path().join("a.crl");
    let nobody = ca.revoke(NOBODY, 2100);
    let [a, mut b] = start(dir.path(), &ca, &ca.issue("host-b", B, 2100), Some(&nobody));
    a.link();
    b.link();

    // A revocation list of another CA is not valid: the link stays, and no new peer gets one.
    fs::write(&crl, Authority::new("another CA").revoke(NOBODY, 2100)).unwrap();
    a.wait_log(&["no new link is accepted", "AXON_CLASSIC_CRL", "none is of one of the roots"]);
    assert_eq!(a.status().links.len(), 1);
    b.kill_daemon();
    b.start();
    a.wait_refusal("why nobody is let in", |text| text.contains("AXON_CLASSIC_CRL"));
    b.wait_refusal("that nobody is let in", |text| {
        text.contains("NOT_ALLOWED") && text.contains("its log says more")
    });
    let told = b.status().refusals;
    assert!(told.iter().all(|r| !r.reason.contains("AXON_CLASSIC_CRL")), "{told:?}");

    fs::write(&crl, &nobody).unwrap();
    a.link();
    b.link();
    fs::write(&crl, ca.revoke(B, 2100)).unwrap();
    until("the link of who was revoked ends", || {
        [&a, &b].iter().all(|host| host.status().links.is_empty())
    });
    a.wait_refusal("why it ended", |text| text.contains("no longer accepted"));
    refused(&[a, b], "revoked");
}

#[test]
fn another_name_than_the_certificates_is_refused() {
    let (dir, ca) = (tempfile::tempdir().unwrap(), Authority::new("the CA"));
    let [a, b] = start(dir.path(), &ca, &ca.issue("host-b", B, 2100), None);
    b.link();
    let own = ca.issue("camera", 3, 2100);
    let material = CaMaterial::from_pem(&ca.pem, &own.pem, &own.key, None).unwrap();
    let auth = Auth::Ca(Arc::new(material.with_names_checked_by_application()));
    let stranger = Stranger::new();
    for name in ["host-b", "host-a", "", "camera.", "*", "camera\0", "localhost"] {
        let why = stranger.dial(&a, &auth, &Claim::ca(name)).expect_err(name);
        assert!(why.contains("its certificate does not name the host"), "{name:?}: {why}");
    }
    a.wait_refusal("A says so too", |text| text.contains("does not name the host \"host-b\""));
    let link = stranger.dial(&a, &auth, &Claim::ca("camera")).expect("under its own name");
    until("A knows it by that name", || {
        let links = a.status().links;
        links.iter().any(|l| l.host == "camera" && l.authenticated_as.starts_with("camera ("))
    });
    // Nor does B's daemon id make it B.
    let daemon = a.status().links.iter().find(|l| l.host == "host-b").unwrap().peer.clone();
    let claim = Claim { daemon: super::daemon_id(&daemon), ..Claim::ca("camera") };
    let why = stranger.dial(&a, &auth, &claim).expect_err("B's id");
    assert!(why.contains("that of another host"), "{why}");
    stranger.leave(&link);
}
