//! A certificate authority, and hosts with certificates of it.

use std::{fs, path::Path};

use rcgen::{
    BasicConstraints, CertificateParams, CertificateRevocationListParams, DnType, IsCa, Issuer,
    KeyIdMethod, KeyPair, KeyUsagePurpose, RevokedCertParams, SerialNumber, date_time_ymd,
};

use super::super::{mode::Settings, pair::write_key};

pub(crate) struct Authority {
    pub(crate) pem: String,
    issuer: Issuer<'static, KeyPair>,
}

/// A certificate and its key, as PEM.
pub(crate) struct Certificate {
    pub(crate) pem: String,
    pub(crate) key: String,
}

impl Authority {
    pub(crate) fn new(name: &str) -> Self {
        let mut params = CertificateParams::new([]).unwrap();
        params.distinguished_name.push(DnType::CommonName, name);
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        params.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
        let key = KeyPair::generate().unwrap();
        let pem = params.self_signed(&key).unwrap().pem();
        Self { pem, issuer: Issuer::new(params, key) }
    }

    /// Issues a certificate for one DNS name, valid until the year begins.
    pub(crate) fn issue(&self, name: &str, serial: u64, until: i32) -> Certificate {
        self.issue_for(&[name], serial, until)
    }

    /// Issues a certificate like [`issue`](Self::issue), for several DNS names.
    pub(crate) fn issue_for(&self, names: &[&str], serial: u64, until: i32) -> Certificate {
        let names: Vec<_> = names.iter().map(|name| (*name).to_owned()).collect();
        let mut params = CertificateParams::new(names).unwrap();
        params.serial_number = Some(SerialNumber::from(serial));
        params.not_before = date_time_ymd(2020, 1, 1);
        params.not_after = date_time_ymd(until, 1, 1);
        let key = KeyPair::generate().unwrap();
        let pem = params.signed_by(&key, &self.issuer).unwrap().pem();
        Certificate { pem, key: key.serialize_pem() }
    }

    /// Issues a revocation list of one certificate, valid until the year begins.
    pub(crate) fn revoke(&self, serial: u64, until: i32) -> String {
        let revoked = RevokedCertParams {
            serial_number: SerialNumber::from(serial),
            revocation_time: date_time_ymd(2020, 1, 1),
            reason_code: None,
            invalidity_date: None,
        };
        let list = CertificateRevocationListParams {
            this_update: date_time_ymd(2020, 1, 1),
            next_update: date_time_ymd(until, 1, 1),
            crl_number: SerialNumber::from(1),
            issuing_distribution_point: None,
            revoked_certs: vec![revoked],
            key_identifier_method: KeyIdMethod::Sha256,
        };
        list.signed_by(&self.issuer).unwrap().pem().unwrap()
    }
}

/// Returns the settings of host `host`, with its files in `dir`.
pub(crate) fn settings(
    dir: &Path,
    host: &str,
    roots: &str,
    own: &Certificate,
    crl: Option<&str>,
) -> Settings {
    let path = |what: &str| dir.join(format!("{host}.{what}"));
    let write = |what: &str, content: &str| {
        fs::write(path(what), content).unwrap();
        path(what).to_str().unwrap().to_owned()
    };
    write_key(&path("key"), &own.key);
    let mut settings = vec![
        ("AXON_SECURITY_MODE", "classic".to_owned()),
        ("AXON_CLASSIC_AUTH", "ca".to_owned()),
        ("AXON_CLASSIC_CA", write("ca", roots)),
        ("AXON_CLASSIC_CERT", write("cert", &own.pem)),
        ("AXON_CLASSIC_KEY", path("key").to_str().unwrap().to_owned()),
    ];
    if let Some(crl) = crl {
        settings.push(("AXON_CLASSIC_CRL", write("crl", crl)));
    }
    settings
}
