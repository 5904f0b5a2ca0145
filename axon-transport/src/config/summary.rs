//! The security settings in force, in a form that two processes can compare.

use std::{fmt::Write, path::Path};

use sha2::{Digest, Sha256};

use super::{ClassicAuth, Config, ConfigError, Files, KeyMode, OsFiles, QkdPeers, Security};

/// Returns the security settings that a session reports to its daemon: each setting in force with its
/// value, including defaults, in a fixed order.
///
/// Certificates, pins and revocation lists appear as `sha256:` and the digest of their file. Two paths to
/// the same certificate therefore agree, and a changed file does not. The access file appears as its path.
/// Private keys do not appear. Each call reads the files again, which costs a few system calls, and fails
/// if a file is gone.
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
    // The content may change: the daemon reads the file again.
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
    /// Returns the value of `AXON_CLASSIC_AUTH`.
    pub const fn name(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Pinned => "pinned",
            Self::Ca => "ca",
        }
    }
}

impl KeyMode {
    /// Returns the value of `AXON_QKD_KEY_MODE`.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Session => "session",
            Self::Messages10 => "messages10",
        }
    }
}

impl std::fmt::Display for QkdPeers {
    /// Writes the value of `AXON_QKD_PEERS`, with the SAE IDs in alphabetical order.
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
