//! The security settings in force, in a form that two processes can compare.

use std::{fmt::Write, path::Path};

use sha2::{Digest, Sha256};

use super::{ClassicAuth, Config, ConfigError, Files, KeyMode, OsFiles, QkdPeers, Security};

/// What a session tells its daemon about the security it was started with: each setting in force
/// with its value, defaults included, in a fixed order.
///
/// Files appear as `sha256:` and the digest of their content, so that two paths to the same
/// certificate agree and a changed file does not; private keys do not appear at all. Files are read
/// anew at each call, which costs a few system calls and may fail when one has gone since.
pub fn security_settings(config: &Config) -> Result<Vec<(String, String)>, ConfigError> {
    let mut settings = Settings(Vec::new());
    match &config.security {
        Security::Classic(classic) => {
            settings.add("AXON_SECURITY_MODE", "classic");
            settings.add("AXON_CLASSIC_AUTH", classic.auth.name());
            settings.add_digest("AXON_CLASSIC_TRUST", classic.trust.as_deref())?;
            settings.add_digest("AXON_CLASSIC_CA", classic.ca.as_deref())?;
            settings.add_digest("AXON_CLASSIC_CERT", classic.cert.as_deref())?;
            settings.add_digest("AXON_CLASSIC_CRL", classic.crl.as_deref())?;
        }
        Security::Qkd(qkd) => {
            settings.add("AXON_SECURITY_MODE", "qkd");
            settings.add("AXON_QKD_KEY_MODE", qkd.key_mode.name());
            settings.add("AXON_QKD_KEX", qkd.kex.name());
            settings.add("AXON_QKD_PEERS", &qkd.peers.to_string());
            settings.add("AXON_QKD_SESSION_MAX_AGE", &qkd.session_max_age.as_secs().to_string());
            settings.add("AXON_KME_URL", &qkd.kme_url);
            settings.add("AXON_KME_ID", qkd.kme_id.as_deref().unwrap_or(""));
            settings.add("AXON_KME_QUIRKS", &qkd.kme_quirks.join(","));
            settings.add_digest("AXON_KME_CA", Some(&qkd.kme_ca))?;
            settings.add("AXON_SAE_ID", &qkd.sae_id);
            settings.add_digest("AXON_SAE_CERT", Some(&qkd.sae_cert))?;
        }
    }
    settings.add("AXON_QUIC_CIPHER", config.cipher.name());
    // Its content may change, and the daemon reads it again.
    if let Some(file) = &config.access_file {
        settings.add("AXON_ACCESS_FILE", &file.to_string_lossy());
    }
    Ok(settings.0)
}

struct Settings(Vec<(String, String)>);

impl Settings {
    fn add(&mut self, name: &str, value: &str) {
        self.0.push((name.to_owned(), value.to_owned()));
    }

    fn add_digest(&mut self, name: &str, path: Option<&Path>) -> Result<(), ConfigError> {
        let Some(path) = path else { return Ok(()) };
        let bytes = OsFiles.read(path).map_err(|error| {
            let accepted = format!("a file that can be read ({error})");
            ConfigError::value(name, &path.to_string_lossy(), accepted)
        })?;
        let mut value = "sha256:".to_owned();
        for byte in Sha256::digest(&bytes) {
            let _ = write!(value, "{byte:02x}");
        }
        self.add(name, &value);
        Ok(())
    }
}

impl ClassicAuth {
    /// As `AXON_CLASSIC_AUTH` spells it.
    pub const fn name(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Pinned => "pinned",
            Self::Ca => "ca",
        }
    }
}

impl KeyMode {
    /// As `AXON_QKD_KEY_MODE` spells it.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Session => "session",
            Self::Messages10 => "messages10",
        }
    }
}

impl std::fmt::Display for QkdPeers {
    /// As `AXON_QKD_PEERS` spells them, in alphabetical order.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Any => f.write_str("*"),
            Self::Listed(saes) => {
                let mut saes: Vec<&str> = saes.iter().map(String::as_str).collect();
                saes.sort_unstable();
                f.write_str(&saes.join(";"))
            }
        }
    }
}
