//! Certificates.

use std::sync::Arc;

use axon_tls::identity::{Auth, CaMaterial};

/// A certificate authority that signs end entities with the SAN that the tests connect with.
pub(crate) struct Authority {
    pub(crate) pem: String,
    issuer: rcgen::Issuer<'static, rcgen::KeyPair>,
}

impl Authority {
    pub(crate) fn new() -> Self {
        let key = rcgen::KeyPair::generate().unwrap();
        let mut params = rcgen::CertificateParams::new([]).unwrap();
        params.is_ca = rcgen::IsCa::Ca(rcgen::BasicConstraints::Unconstrained);
        params.key_usages =
            vec![rcgen::KeyUsagePurpose::KeyCertSign, rcgen::KeyUsagePurpose::CrlSign];
        let pem = params.self_signed(&key).unwrap().pem();
        Self { pem, issuer: rcgen::Issuer::new(params, key) }
    }

    /// Issues a certificate for `san` with its key.
    pub(crate) fn certify(&self, serial: u64, san: &str) -> (rcgen::Certificate, rcgen::KeyPair) {
        let key = rcgen::KeyPair::generate().unwrap();
        let mut params = rcgen::CertificateParams::new([san.to_owned()]).unwrap();
        params.serial_number = Some(serial.into());
        (params.signed_by(&key, &self.issuer).unwrap(), key)
    }

    /// Creates an end that trusts `roots` and shows a certificate of this authority.
    pub(crate) fn member(&self, serial: u64, san: &str, roots: &Self, crl: Option<&str>) -> Auth {
        let (certificate, key) = self.certify(serial, san);
        let material =
            CaMaterial::from_pem(&roots.pem, &certificate.pem(), &key.serialize_pem(), crl);
        Auth::Ca(Arc::new(material.unwrap()))
    }

    pub(crate) fn revoke(&self, serial: u64) -> String {
        let year = |year| rcgen::date_time_ymd(year, 1, 1);
        let params = rcgen::CertificateRevocationListParams {
            this_update: year(2024),
            next_update: year(2200),
            crl_number: 1.into(),
            issuing_distribution_point: None,
            revoked_certs: vec![rcgen::RevokedCertParams {
                serial_number: serial.into(),
                revocation_time: year(2024),
                reason_code: None,
                invalidity_date: None,
            }],
            key_identifier_method: rcgen::KeyIdMethod::Sha256,
        };
        params.signed_by(&self.issuer).unwrap().pem().unwrap()
    }
}
