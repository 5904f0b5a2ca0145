//! Certificates: who is accepted, in either direction, and for which host.
#![cfg(feature = "hybrid")]

use std::sync::Arc;

use axon_tls::identity::{Auth, CaMaterial};
use axon_tls::{CaPart, Cipher, Error, hybrid};
use rcgen::{
    BasicConstraints, CertificateParams, CertificateRevocationListParams, DnType,
    ExtendedKeyUsagePurpose, IsCa, Issuer, KeyIdMethod, KeyPair, KeyUsagePurpose,
    RevokedCertParams, SerialNumber, date_time_ymd,
};
use rustls::pki_types::CertificateDer;
use rustls::{ClientConnection, ServerConnection};

/// A CA, as its PEM and what signs with it.
struct Ca {
    pem: String,
    issuer: Issuer<'static, KeyPair>,
}

/// A certificate with its key.
struct Host {
    der: CertificateDer<'static>,
    cert: String,
    key: String,
}

impl Ca {
    fn new() -> Self {
        Self::named("the CA")
    }

    fn named(name: &str) -> Self {
        let mut params = CertificateParams::new([]).unwrap();
        params.distinguished_name.push(DnType::CommonName, name);
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        params.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
        let key = KeyPair::generate().unwrap();
        let pem = params.self_signed(&key).unwrap().pem();
        Self { pem, issuer: Issuer::new(params, key) }
    }

    fn host(&self, names: &[&str], usages: &[ExtendedKeyUsagePurpose], serial: u64) -> Host {
        let names: Vec<_> = names.iter().map(|name| (*name).to_owned()).collect();
        let mut params = CertificateParams::new(names).unwrap();
        params.extended_key_usages = usages.to_vec();
        params.serial_number = Some(SerialNumber::from(serial));
        let key = KeyPair::generate().unwrap();
        let cert = params.signed_by(&key, &self.issuer).unwrap();
        Host { der: cert.der().clone(), cert: cert.pem(), key: key.serialize_pem() }
    }

    fn crl(&self, revoked: u64, until_year: i32) -> String {
        CertificateRevocationListParams {
            this_update: date_time_ymd(2020, 1, 1),
            next_update: date_time_ymd(until_year, 1, 1),
            crl_number: SerialNumber::from(1),
            issuing_distribution_point: None,
            revoked_certs: vec![RevokedCertParams {
                serial_number: SerialNumber::from(revoked),
                revocation_time: date_time_ymd(2020, 1, 1),
                reason_code: None,
                invalidity_date: None,
            }],
            key_identifier_method: KeyIdMethod::Sha256,
        }
        .signed_by(&self.issuer)
        .unwrap()
        .pem()
        .unwrap()
    }

    fn material(&self, host: &Host, crl: Option<&str>) -> CaMaterial {
        CaMaterial::from_pem(&self.pem, &host.cert, &host.key, crl).unwrap()
    }

    /// Returns the credentials for a protocol in which both ends state their names.
    fn auth(&self, host: &Host, crl: Option<&str>) -> Auth {
        Auth::Ca(Arc::new(self.material(host, crl).with_names_checked_by_application()))
    }
}

/// Runs a handshake in memory, to its end or the first error of either side.
fn handshake(client: &Auth, server: &Auth) -> Result<(), rustls::Error> {
    let config = hybrid::client_config(client, Cipher::default(), b"").unwrap();
    let name = "whatever.example".try_into().unwrap();
    let mut client = ClientConnection::new(Arc::new(config), name).unwrap();
    let config = hybrid::server_config(server, Cipher::default(), b"").unwrap();
    let mut server = ServerConnection::new(Arc::new(config)).unwrap();
    while client.is_handshaking() || server.is_handshaking() {
        let mut bytes = Vec::new();
        while client.wants_write() {
            client.write_tls(&mut bytes).unwrap();
        }
        let mut unread = &bytes[..];
        while !unread.is_empty() {
            server.read_tls(&mut unread).unwrap();
            server.process_new_packets()?;
        }
        let mut bytes = Vec::new();
        while server.wants_write() {
            server.write_tls(&mut bytes).unwrap();
        }
        let mut unread = &bytes[..];
        while !unread.is_empty() {
            client.read_tls(&mut unread).unwrap();
            client.process_new_packets()?;
        }
    }
    Ok(())
}

/// Returns the results of both directions: with `peer` as the server, and as the client.
fn both(us: &Auth, peer: &Auth) -> [Result<(), String>; 2] {
    [handshake(us, peer), handshake(peer, us)].map(|r| r.map_err(|error| format!("{error:?}")))
}

fn refused_for(us: &Auth, peer: &Auth, why: &str) {
    for said in both(us, peer) {
        let said = said.unwrap_err();
        assert!(said.contains(why), "{why} expected: {said}");
    }
}

#[test]
fn a_stranger_is_refused_in_both_directions() {
    let (ca, other) = (Ca::new(), Ca::new());
    let us = ca.auth(&ca.host(&["a"], &[], 1), None);
    let stranger = other.host(&["b"], &[], 2);
    // it trusts our CA, so only we can refuse
    let peer = ca.auth(&stranger, None);
    // the two CAs have the same name, so only the signature distinguishes them
    refused_for(&us, &peer, "BadSignature");
}

#[test]
fn a_revoked_certificate_is_refused_in_both_directions() {
    let ca = Ca::new();
    let crl = ca.crl(2, 2100);
    let us = ca.auth(&ca.host(&["a"], &[], 1), Some(&crl));
    refused_for(&us, &ca.auth(&ca.host(&["b"], &[], 2), None), "Revoked");
    assert_eq!(both(&us, &ca.auth(&ca.host(&["c"], &[], 3), None)), [Ok(()), Ok(())]);
}

#[test]
fn an_expired_revocation_list_refuses_every_peer() {
    let ca = Ca::new();
    let crl = ca.crl(2, 2021);
    let us = ca.auth(&ca.host(&["a"], &[], 1), Some(&crl));
    refused_for(&us, &ca.auth(&ca.host(&["c"], &[], 3), None), "ExpiredRevocationList");
}

#[test]
fn of_two_lists_of_an_issuer_both_are_heeded() {
    let ca = Ca::new();
    let (revoked, other) = (ca.crl(2, 2100), ca.crl(9, 2100));
    for lists in [format!("{other}{revoked}"), format!("{revoked}{other}")] {
        let us = ca.auth(&ca.host(&["a"], &[], 1), Some(&lists));
        refused_for(&us, &ca.auth(&ca.host(&["b"], &[], 2), None), "Revoked");
        assert_eq!(both(&us, &ca.auth(&ca.host(&["c"], &[], 3), None)), [Ok(()), Ok(())]);
    }
}

#[test]
fn a_list_that_no_root_issued_is_refused_where_it_is_read() {
    let (ca, other) = (Ca::new(), Ca::named("another CA"));
    let host = ca.host(&["a"], &[], 1);
    let read = |crl: &str| CaMaterial::from_pem(&ca.pem, &host.cert, &host.key, Some(crl));
    let theirs = other.crl(2, 2100);
    let not_der = "-----BEGIN X509 CRL-----\nAAAA\n-----END X509 CRL-----\n";
    let half = &theirs[..theirs.len() / 2];
    for (crl, said) in
        [(&*theirs, "none is of one of the roots"), (not_der, ""), (half, ""), ("", "X509 CRL")]
    {
        let error = read(crl).err().expect(crl);
        let Error::Certificates { part, reason } = &error else { panic!("{error}") };
        assert_eq!(*part, CaPart::RevocationLists);
        assert!(reason.contains(said), "{error}");
    }
    // Beside one of ours it is merely of no use.
    assert!(read(&(theirs + &ca.crl(2, 2100))).is_ok());
}

#[test]
fn a_revocation_list_of_a_namesake_ca_refuses_every_peer() {
    let (ca, impostor) = (Ca::new(), Ca::new());
    let crl = impostor.crl(9, 2100);
    let us = ca.auth(&ca.host(&["a"], &[], 1), Some(&crl));
    let peer = ca.auth(&ca.host(&["c"], &[], 3), None);
    refused_for(&us, &peer, "InvalidCertRevocationList(BadSignature)");
}

#[test]
fn later_ca_material_rechecks_an_already_accepted_chain() {
    let (ca, other) = (Ca::new(), Ca::named("another CA"));
    let (us, peer) = (ca.host(&["a"], &[], 1), ca.host(&["b"], &[], 2));
    let chain = [peer.der.clone()];
    let accepts = |material: &CaMaterial| {
        let [client, server] = [material.accepts_client(&chain), material.accepts_server(&chain)];
        assert_eq!(client.is_ok(), server.is_ok());
        client.map_err(|error| error.to_string())
    };
    assert_eq!(accepts(&ca.material(&us, None)), Ok(()));
    assert_eq!(accepts(&ca.material(&us, Some(&ca.crl(9, 2100)))), Ok(()));
    for (material, why) in [
        (ca.material(&us, Some(&ca.crl(2, 2100))), "revoked"),
        (ca.material(&us, Some(&ca.crl(9, 2021))), "expired"),
        (other.material(&other.host(&["a"], &[], 1), None), "UnknownIssuer"),
    ] {
        let said = accepts(&material).unwrap_err().to_lowercase();
        assert!(said.contains(&why.to_lowercase()), "{why} expected: {said}");
    }
    assert!(ca.material(&us, None).accepts_client(&[]).is_err());
    let one_role = ca.host(&["b"], &[ExtendedKeyUsagePurpose::ClientAuth], 2);
    let chain = [one_role.der.clone()];
    assert!(ca.material(&us, None).accepts_client(&chain).is_ok());
    assert!(ca.material(&us, None).accepts_server(&chain).is_err());
}

#[test]
fn accepts_us_predicts_the_peers_verdict() {
    let ca = Ca::new();
    let us = ca.host(&["a"], &[], 1);
    assert!(ca.material(&us, Some(&ca.crl(9, 2100))).accepts_us().is_ok());
    assert!(ca.material(&us, Some(&ca.crl(1, 2100))).accepts_us().is_err());
    assert!(ca.material(&us, Some(&ca.crl(9, 2021))).accepts_us().is_err());
    let client = ca.host(&["a"], &[ExtendedKeyUsagePurpose::ClientAuth], 1);
    assert!(ca.material(&client, None).accepts_us().is_err());
}

#[test]
fn a_server_of_another_name_is_refused_unless_the_application_checks() {
    let ca = Ca::new();
    let (a, b) = (ca.host(&["a"], &[], 1), ca.host(&["b"], &[], 2));
    let server = ca.auth(&b, None);
    let error = handshake(&Auth::Ca(Arc::new(ca.material(&a, None))), &server).unwrap_err();
    assert!(format!("{error:?}").contains("NotValidForName"), "{error:?}");
    let called = ca.auth(&ca.host(&["whatever.example"], &[], 3), None);
    assert_eq!(handshake(&Auth::Ca(Arc::new(ca.material(&a, None))), &called), Ok(()));
    assert_eq!(handshake(&ca.auth(&a, None), &server), Ok(()));
}

#[test]
fn a_certificate_for_one_role_is_no_good_for_the_other() {
    let ca = Ca::new();
    let us = ca.auth(&ca.host(&["a"], &[], 1), None);
    let client = ca.auth(&ca.host(&["b"], &[ExtendedKeyUsagePurpose::ClientAuth], 2), None);
    let server = ca.auth(&ca.host(&["b"], &[ExtendedKeyUsagePurpose::ServerAuth], 3), None);
    assert!(handshake(&us, &client).is_err(), "dialled, it is the server");
    assert_eq!(handshake(&client, &us), Ok(()));
    assert!(handshake(&server, &us).is_err(), "dialling, it is the client");
    assert_eq!(handshake(&us, &server), Ok(()));
}

#[test]
fn a_certificate_is_for_the_hosts_that_it_names() {
    let ca = Ca::new();
    let host = ca.host(&["arm-2.example", "10.0.0.1"], &[], 1);
    assert!(CaMaterial::is_for_host(&host.der, "arm-2.example"));
    assert!(CaMaterial::is_for_host(&host.der, "ARM-2.example"));
    for other in
        ["arm-3.example", "arm-2", "example", "", "10.0.0.1", "arm-2.example\0", "*", "x y"]
    {
        assert!(!CaMaterial::is_for_host(&host.der, other), "{other:?}");
    }
    assert!(!CaMaterial::is_for_host(&CertificateDer::from(vec![0x30, 0]), "arm-2.example"));
}

#[test]
fn a_wildcard_is_no_host() {
    let ca = Ca::new();
    let host = ca.host(&["*.example"], &[], 1);
    for name in ["arm-2.example", "*.example"] {
        assert!(!CaMaterial::is_for_host(&host.der, name), "{name}");
    }
    let material = CaMaterial::from_pem(&ca.pem, &host.cert, &host.key, None).unwrap();
    assert!(material.our_hosts().is_empty());
}

#[test]
fn a_key_of_another_certificate_is_refused() {
    let ca = Ca::new();
    let (a, b) = (ca.host(&["a"], &[], 1), ca.host(&["b"], &[], 2));
    for (roots, cert, key, wrong) in [
        (&*ca.pem, &*a.cert, &*b.key, CaPart::Key),
        (&ca.pem, &a.cert, "", CaPart::Key),
        (&ca.pem, "", &a.key, CaPart::Chain),
        ("", &a.cert, &a.key, CaPart::Roots),
    ] {
        match CaMaterial::from_pem(roots, cert, key, None) {
            Err(Error::Certificates { part, .. }) => assert_eq!(part, wrong),
            Err(other) => panic!("{other}"),
            Ok(_) => panic!("accepted without a good {wrong}"),
        }
    }
}
