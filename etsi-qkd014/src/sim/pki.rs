//! A throw-away CA and the certificates of a network's KMEs and SAEs.

use std::collections::BTreeMap;
use std::fs;
use std::io::Write;
use std::net::{IpAddr, SocketAddr};
use std::path::Path;

use rcgen::{
    BasicConstraints, CertificateParams, DnType, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair,
    KeyUsagePurpose, SanType, date_time_ymd,
};
use serde::{Deserialize, Serialize};
use zeroize::Zeroizing;

use super::Error;

/// One KME and the SAEs attached to it.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Site {
    /// The KME's ID.
    pub kme: String,
    /// The address on which it listens.
    pub bind: SocketAddr,
    /// The IDs of its SAEs.
    pub saes: Vec<String>,
}

/// The KMEs of a network.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Layout {
    /// The KMEs, with their SAEs.
    pub sites: Vec<Site>,
}

impl Layout {
    pub(super) fn check(&self) -> Result<(), Error> {
        if self.sites.is_empty() {
            return Err(Error::Layout("a network needs at least one KME".into()));
        }
        let mut seen = BTreeMap::new();
        let kmes = self.sites.iter().map(|site| &site.kme);
        for id in kmes.chain(self.sites.iter().flat_map(|site| &site.saes)) {
            // IDs become file names.
            let plain = |c: u8| c.is_ascii_alphanumeric() || matches!(c, b'-' | b'_' | b'.');
            if !(1..=64).contains(&id.len()) || !id.bytes().all(plain) || id.starts_with('.') {
                return Err(Error::Layout(format!(
                    "ID {id:?}: 1 to 64 of A-Z a-z 0-9 - _ . and no leading dot"
                )));
            }
            let lower = id.to_ascii_lowercase();
            if let Some(end) = ENDINGS.into_iter().find(|end| lower.ends_with(end)) {
                return Err(Error::Layout(format!("ID {id:?}: an ID does not end in {end}")));
            }
            if seen.insert(lower, ()).is_some() || id == "ca" {
                return Err(Error::Layout(format!("ID {id:?} is used twice")));
            }
        }
        Ok(())
    }
}

/// A certificate and its key, in PEM.
pub(super) struct Pair {
    pub(super) cert: String,
    pub(super) key: Zeroizing<String>,
}

/// The validity period of a certificate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Validity {
    Now,
    Future,
    Past,
}

/// The suffixes of a KME's ID for its certificates that are not valid now.
const ENDINGS: [&str; 2] = [".not-yet-valid", ".expired"];

impl Validity {
    const ALL: [Self; 3] = [Self::Now, Self::Future, Self::Past];

    /// Returns the name of a certificate, which is also its file name.
    fn name(self, id: &str) -> String {
        match self {
            Self::Now => id.to_owned(),
            Self::Future => format!("{id}{}", ENDINGS[0]),
            Self::Past => format!("{id}{}", ENDINGS[1]),
        }
    }
}

/// The certificates of a network. The CA's key exists only as long as the `Pki` that created it.
pub struct Pki {
    ca: String,
    issuer: Option<Issuer<'static, KeyPair>>,
    /// The certificates by name; see [`Validity::name`].
    pairs: BTreeMap<String, Pair>,
}

impl Pki {
    /// Creates a CA and a certificate for each KME and SAE. Each KME also gets an expired
    /// certificate and one that is not valid yet.
    ///
    /// # Errors
    /// [`Error::Layout`] if the layout is unusable.
    pub fn create(layout: &Layout) -> Result<Self, Error> {
        layout.check()?;
        let key = KeyPair::generate().map_err(cert_error)?;
        let mut params = CertificateParams::default();
        params.distinguished_name = rcgen::DistinguishedName::new();
        // A unique name, so that a certificate of another run's CA is recognized as such.
        let name = format!("kme-sim throw-away CA {}", super::store::uuid());
        params.distinguished_name.push(DnType::CommonName, name);
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        params.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
        let ca = params.self_signed(&key).map_err(cert_error)?.pem();
        let issuer = Issuer::new(params, key);
        let mut pki = Self { ca, issuer: Some(issuer), pairs: BTreeMap::new() };
        for site in &layout.sites {
            for validity in Validity::ALL {
                let pair = pki.issue(&site.kme, Some(site.bind.ip()), validity)?;
                pki.pairs.insert(validity.name(&site.kme), pair);
            }
            for sae in &site.saes {
                let pair = pki.issue(sae, None, Validity::Now)?;
                pki.pairs.insert(sae.clone(), pair);
            }
        }
        Ok(pki)
    }

    /// Reads the files that [`write`](Self::write) wrote. It cannot issue further certificates.
    ///
    /// # Errors
    /// [`Error::Io`] names the file that cannot be read.
    pub fn load(dir: &Path, layout: &Layout) -> Result<Self, Error> {
        layout.check()?;
        let read = |name: String| {
            let path = dir.join(name);
            fs::read_to_string(&path).map_err(Error::io(path.display()))
        };
        let mut pairs = BTreeMap::new();
        let names = |site: &Site| {
            let of_kme = Validity::ALL.map(|validity| validity.name(&site.kme));
            site.saes.iter().cloned().chain(of_kme).collect::<Vec<_>>()
        };
        for name in layout.sites.iter().flat_map(names) {
            let (cert, key) = (read(format!("{name}.crt"))?, read(format!("{name}.key"))?);
            pairs.insert(name, Pair { cert, key: key.into() });
        }
        Ok(Self { ca: read("ca.pem".into())?, issuer: None, pairs })
    }

    /// Writes `ca.pem`, and `ID.crt` and `ID.key` (mode 0600) of each KME and SAE, into `dir`,
    /// which is created (mode 0700) if necessary. Also writes `ID.expired` and `ID.not-yet-valid`
    /// of each KME, which the KME shows as a [fault](super::Fault::CertificateExpired), or another
    /// server may show.
    ///
    /// # Errors
    /// [`Error::Io`] names the file that cannot be written.
    pub fn write(&self, dir: &Path) -> Result<(), Error> {
        make_dir(dir).map_err(Error::io(dir.display()))?;
        let write = |name: String, text: &str, secret: bool| {
            let path = dir.join(name);
            write_file(&path, text, secret).map_err(Error::io(path.display()))
        };
        write("ca.pem".into(), &self.ca, false)?;
        for (name, pair) in &self.pairs {
            write(format!("{name}.crt"), &pair.cert, false)?;
            write(format!("{name}.key"), &pair.key, true)?;
        }
        Ok(())
    }

    /// Returns the CA's certificate in PEM.
    #[must_use]
    pub fn ca_pem(&self) -> &str {
        &self.ca
    }

    pub(super) fn known(&self, id: &str, validity: Validity) -> Result<&Pair, Error> {
        let pair = self.pairs.get(&validity.name(id));
        pair.ok_or_else(|| Error::Certificates(format!("none was made for {id:?}")))
    }

    /// Issues a server certificate for the address `server`, or a client certificate without it.
    pub(super) fn issue(
        &self,
        id: &str,
        server: Option<IpAddr>,
        validity: Validity,
    ) -> Result<Pair, Error> {
        let issuer = self.issuer.as_ref().ok_or_else(|| {
            Error::Certificates("the CA's key was thrown away when the files were written".into())
        })?;
        let mut params = CertificateParams::default();
        params.distinguished_name = rcgen::DistinguishedName::new();
        params.distinguished_name.push(DnType::CommonName, id);
        params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
        params.use_authority_key_identifier_extension = true;
        match validity {
            Validity::Now => {}
            Validity::Future => params.not_before = date_time_ymd(2999, 1, 1),
            Validity::Past => params.not_after = date_time_ymd(2000, 1, 1),
        }
        if let Some(ip) = server {
            params.extended_key_usages = vec![ExtendedKeyUsagePurpose::ServerAuth];
            params.subject_alt_names = vec![SanType::IpAddress(ip)];
            for name in [id, "localhost"] {
                // An ID with an underscore is no host name, so it is only in the subject.
                if !name.contains('_') {
                    let name = name.try_into().map_err(cert_error)?;
                    params.subject_alt_names.push(SanType::DnsName(name));
                }
            }
        } else {
            params.extended_key_usages = vec![ExtendedKeyUsagePurpose::ClientAuth];
        }
        let key = KeyPair::generate().map_err(cert_error)?;
        let cert = params.signed_by(&key, issuer).map_err(cert_error)?.pem();
        Ok(Pair { cert, key: key.serialize_pem().into() })
    }
}

impl std::fmt::Debug for Pki {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Pki").field("names", &self.pairs.keys()).finish_non_exhaustive()
    }
}

fn cert_error(error: rcgen::Error) -> Error {
    Error::Certificates(error.to_string())
}

fn make_dir(dir: &Path) -> std::io::Result<()> {
    let mut builder = fs::DirBuilder::new();
    builder.recursive(true);
    #[cfg(unix)]
    std::os::unix::fs::DirBuilderExt::mode(&mut builder, 0o700);
    builder.create(dir)
}

/// Writes a new file. An old file is replaced, never written into, because its mode might be wider.
pub(super) fn write_file(path: &Path, text: &str, secret: bool) -> std::io::Result<()> {
    match fs::remove_file(path) {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => return Err(e),
        _ => {}
    }
    let mut options = fs::OpenOptions::new();
    options.write(true).create_new(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, if secret { 0o600 } else { 0o644 });
    #[cfg(not(unix))]
    let _ = secret;
    options.open(path)?.write_all(text.as_bytes())
}

/// The data with which an SAE calls its KME.
pub struct Sae {
    pub(super) id: String,
    pub(super) kme_id: String,
    pub(super) kme_url: String,
    pub(super) ca: String,
    pub(super) pair: Pair,
}

impl Sae {
    /// Returns the SAE's ID.
    #[must_use]
    pub fn id(&self) -> &str {
        &self.id
    }

    /// Returns the ID of its KME.
    #[must_use]
    pub fn kme_id(&self) -> &str {
        &self.kme_id
    }

    /// Returns the URL of its KME.
    #[must_use]
    pub fn kme_url(&self) -> &str {
        &self.kme_url
    }

    /// Returns the network's CA in PEM.
    #[must_use]
    pub fn ca_pem(&self) -> &str {
        &self.ca
    }

    /// Returns its certificate in PEM.
    #[must_use]
    pub fn cert_pem(&self) -> &str {
        &self.pair.cert
    }

    /// Returns its private key in PEM.
    #[must_use]
    pub fn key_pem(&self) -> &str {
        &self.pair.key
    }

    /// Returns the environment that makes a program act as this SAE, with the files that
    /// [`Network::write_files`](super::Network::write_files) writes into `dir`.
    #[must_use]
    pub fn env(&self, dir: &Path) -> Vec<(&'static str, String)> {
        env(&self.id, &self.kme_id, &self.kme_url, dir)
    }
}

pub(super) fn env(sae: &str, kme: &str, url: &str, dir: &Path) -> Vec<(&'static str, String)> {
    let file = |name: &str| dir.join(name).display().to_string();
    vec![
        ("AXON_KME_URL", url.to_owned()),
        ("AXON_KME_CA", file("ca.pem")),
        ("AXON_KME_ID", kme.to_owned()),
        ("AXON_SAE_ID", sae.to_owned()),
        ("AXON_SAE_CERT", file(&format!("{sae}.crt"))),
        ("AXON_SAE_KEY", file(&format!("{sae}.key"))),
    ]
}

impl Layout {
    /// Returns the environment of each SAE, with the files that [`Pki::write`] writes into `dir`.
    #[must_use]
    pub fn env(&self, dir: &Path) -> Vec<(String, Vec<(&'static str, String)>)> {
        let of = |site: &Site, sae: &String| {
            (sae.clone(), env(sae, &site.kme, &format!("https://{}", site.bind), dir))
        };
        self.sites.iter().flat_map(|site| site.saes.iter().map(move |sae| of(site, sae))).collect()
    }
}
