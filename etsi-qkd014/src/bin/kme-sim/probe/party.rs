//! An SAE as which the probe acts: the address of its KME, and its certificate and key.

use std::collections::HashMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

use etsi_qkd014::{Client, Error, Quirks, RetryPolicy};
use reqwest::Url;
use zeroize::Zeroizing;

use crate::{CommandResult, other};

/// Largest file read as a certificate or an environment, in bytes.
const MAX_FILE: u64 = 1 << 20;

pub(super) struct Party {
    pub(super) url: String,
    pub(super) sae: String,
    pub(super) kme_id: Option<String>,
    pub(super) kme_id_only: bool,
    pub(super) ca: Vec<u8>,
    pub(super) cert: Vec<u8>,
    pub(super) key: Zeroizing<Vec<u8>>,
    pub(super) timeout: Duration,
}

/// The files and names of a [`Party`].
pub(super) struct PartyFiles {
    pub(super) url: String,
    pub(super) sae: String,
    pub(super) kme_id: Option<String>,
    pub(super) kme_id_only: bool,
    pub(super) ca: PathBuf,
    pub(super) cert: PathBuf,
    pub(super) key: PathBuf,
    pub(super) timeout: Duration,
}

impl Party {
    pub(super) fn load(source: PartyFiles) -> CommandResult<Self> {
        let PartyFiles { url, sae, kme_id, kme_id_only, ca, cert, key, timeout } = source;
        let (ca, cert) = (read(&ca)?, read(&cert)?);
        let key = Zeroizing::new(read(&key)?);
        let party = Self { url, sae, kme_id, kme_id_only, ca, cert, key, timeout };
        // Errors in the settings are reported before anything is sent.
        party.client(Quirks::STRICT).map_err(other)?;
        Ok(party)
    }

    /// Returns the SAE `sae` from a file of `export NAME='value'` lines, as `kme-sim init` prints
    /// them.
    pub(super) fn from_env_file(file: &Path, sae: &str, timeout: Duration) -> CommandResult<Self> {
        let wrong = |why: String| other(format!("{}: {why}", file.display()));
        let text = String::from_utf8(read(file)?).map_err(|_| wrong("is not UTF-8".into()))?;
        let mut env = environments(&text)
            .into_iter()
            .find(|env| env.get("AXON_SAE_ID").is_some_and(|id| id == sae))
            .ok_or_else(|| wrong(format!("no environment with AXON_SAE_ID='{sae}'")))?;
        let kme_id = env.remove("AXON_KME_ID");
        let mut take = |name: &str| {
            env.remove(name).ok_or_else(|| wrong(format!("{name} is missing for {sae}")))
        };
        Self::load(PartyFiles {
            url: take("AXON_KME_URL")?,
            sae: sae.to_owned(),
            kme_id,
            kme_id_only: false,
            ca: take("AXON_KME_CA")?.into(),
            cert: take("AXON_SAE_CERT")?.into(),
            key: take("AXON_SAE_KEY")?.into(),
            timeout,
        })
    }

    /// Returns this crate's client. It never repeats a call, because the probe counts each.
    pub(super) fn client(&self, quirks: Quirks) -> Result<Client, Error> {
        let mut builder = Client::builder()
            .kme_url(&self.url)
            .ca(self.ca.clone())
            .sae_cert(self.cert.clone())
            .sae_key(Box::<[u8]>::from(self.key.as_slice()))
            .timeout(self.timeout)
            .connect_timeout(self.timeout)
            .deadline(self.timeout)
            .retry(RetryPolicy::none())
            .quirks(quirks);
        if let Some(id) = &self.kme_id {
            builder = builder.kme_id(id);
        }
        if self.kme_id_only {
            builder = builder.kme_id_replaces_name_check();
        }
        builder.build()
    }

    /// Returns the URL of a method for an SAE.
    pub(super) fn method(&self, sae: &str, method: &str) -> CommandResult<Url> {
        let mut url = Url::parse(&self.url).map_err(other)?;
        url.path_segments_mut()
            .map_err(|()| other("the URL has no path"))?
            .pop_if_empty()
            .extend(["api", "v1", "keys", sae, method]);
        Ok(url)
    }
}

fn read(path: &Path) -> CommandResult<Vec<u8>> {
    let wrong = |why: String| other(format!("{}: {why}", path.display()));
    let length = fs::metadata(path).map_err(|e| wrong(e.to_string()))?.len();
    if length > MAX_FILE {
        return Err(wrong(format!("is larger than {MAX_FILE} bytes")));
    }
    fs::read(path).map_err(|e| wrong(e.to_string()))
}

/// Splits the lines into groups of variables. A repeated name starts the next group. Other lines
/// are ignored.
fn environments(text: &str) -> Vec<HashMap<String, String>> {
    let mut all = vec![HashMap::new()];
    for line in text.lines() {
        let line = line.trim();
        let line = line.strip_prefix("export ").unwrap_or(line);
        let Some((name, value)) = line.split_once('=') else { continue };
        if !name.starts_with("AXON_") {
            continue;
        }
        if all.last().is_some_and(|last| last.contains_key(name)) {
            all.push(HashMap::new());
        }
        if let Some(last) = all.last_mut() {
            last.insert(name.to_owned(), unquoted(value));
        }
    }
    all
}

/// Removes the quoting of `kme-sim init`: single quotes, and `'\''` for a single quote.
fn unquoted(value: &str) -> String {
    let inner = value.strip_prefix('\'').and_then(|rest| rest.strip_suffix('\''));
    inner.map_or_else(|| value.to_owned(), |inner| inner.replace("'\\''", "'"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn environments_are_told_apart_and_unquoted() {
        let text = "# a\nexport AXON_SAE_ID='a'\nexport AXON_SAE_KEY='it'\\''s'\nPATH=x\n\
                    # b\nAXON_SAE_ID=b\nnothing\n";
        let all = environments(text);
        assert_eq!(all.len(), 2);
        assert_eq!(
            (all[0]["AXON_SAE_ID"].as_str(), all[0]["AXON_SAE_KEY"].as_str()),
            ("a", "it's")
        );
        assert_eq!((all[1]["AXON_SAE_ID"].as_str(), all[1].len()), ("b", 1));
    }
}
