//! The demo's two KMEs: the simulator in this process, mutual TLS under a CA of its own.

use std::{
    ops::Sub,
    path::{Path, PathBuf},
};

use etsi_qkd014::sim;
use serde::Serialize;

use super::DemoError;

/// The SAE of host A.
pub(crate) const SAE_A: &str = "sae-a";
/// The SAE of host B.
pub(crate) const SAE_B: &str = "sae-b";
/// An SAE that host B takes as a peer, for the attempts of the wrong peers: theirs are refused for
/// the one thing that is wrong with them and not for their name.
pub(crate) const SAE_VISITOR: &str = "sae-visitor";

const KMES: [&str; 2] = ["kme-a", "kme-b"];

/// Two KMEs that share keys as a QKD link would let them.
pub(crate) struct Kmes {
    network: sim::Network,
    dir: PathBuf,
}

/// Keys that the KMEs handed out.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub(crate) struct KeysHandedOut {
    /// To the SAE that asked first (enc_keys).
    pub(crate) to_masters: u64,
    /// To its peer, by key_ID (dec_keys).
    pub(crate) to_slaves: u64,
}

impl Sub for KeysHandedOut {
    type Output = Self;

    fn sub(self, earlier: Self) -> Self {
        Self {
            to_masters: self.to_masters - earlier.to_masters,
            to_slaves: self.to_slaves - earlier.to_slaves,
        }
    }
}

impl Kmes {
    /// Starts both; `dir` takes certificates and keys.
    pub(crate) async fn start(dir: &Path) -> Result<Self, DemoError> {
        let network = sim::Network::builder()
            .kme(KMES[0], ([127, 0, 0, 1], 0).into(), [SAE_A, SAE_VISITOR])
            .kme(KMES[1], ([127, 0, 0, 2], 0).into(), [SAE_B])
            .start()
            .await
            .map_err(|e| DemoError::Kme(e.to_string()))?;
        network.write_files(dir).map_err(|e| DemoError::Kme(e.to_string()))?;
        Ok(Self { network, dir: dir.to_owned() })
    }

    /// What a host of `sae` is told of its KME.
    pub(crate) fn identity(&self, sae: &str) -> Vec<(String, String)> {
        let sae = self.network.sae(sae).map(|sae| sae.env(&self.dir)).unwrap_or_default();
        sae.into_iter().map(|(name, value)| (name.to_owned(), value)).collect()
    }

    /// Keys handed out since the start.
    pub(crate) fn handed_out(&self) -> KeysHandedOut {
        let counters = KMES.iter().filter_map(|id| self.network.kme(id)).map(|kme| kme.counters());
        counters.fold(KeysHandedOut::default(), |sum, counters| KeysHandedOut {
            to_masters: sum.to_masters + counters.keys_to_masters,
            to_slaves: sum.to_slaves + counters.keys_to_slaves,
        })
    }
}
