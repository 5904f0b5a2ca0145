//! The demo's two KMEs. They are simulators in this process, with mutual TLS under their own CA, or
//! KMEs that run elsewhere.

use std::{
    ops::Sub,
    path::{Path, PathBuf},
};

use etsi_qkd014::sim;
use serde::Serialize;

use super::{DemoError, env_file};

/// The party that requests keys from a KME.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Role {
    /// Host A.
    A,
    /// Host B.
    B,
    /// The wrong peers. Host B accepts this SAE as a peer, so that each wrong peer is refused for
    /// its one defect and not for its name.
    Visitor,
}

const SAES: [&str; 3] = ["sae-a", "sae-b", "sae-visitor"];
const KMES: [&str; 2] = ["kme-a", "kme-b"];

/// Two KMEs that share keys, as the KMEs of a QKD link do.
pub(crate) enum Kmes {
    /// KMEs in this process.
    Simulated {
        /// The KMEs.
        network: Box<sim::Network>,
        /// The directory of their certificates.
        dir: PathBuf,
    },
    /// KMEs that run elsewhere, given by the variables of host A and of host B.
    External([Vec<(String, String)>; 2]),
}

/// The numbers of keys that the KMEs delivered.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub(crate) struct KeysHandedOut {
    /// Keys delivered to the SAE that asked first (enc_keys).
    pub(crate) to_masters: u64,
    /// Keys delivered to its peer, by key_ID (dec_keys).
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
    /// Starts both KMEs. `dir` holds their certificates and keys.
    pub(crate) async fn start(dir: &Path) -> Result<Self, DemoError> {
        let failed = |error: sim::Error| DemoError::Kme(error.to_string());
        let [a, b, visitor] = SAES;
        let network = sim::Network::builder()
            .strict()
            .kme(KMES[0], ([127, 0, 0, 1], 0).into(), [a, visitor])
            .kme(KMES[1], ([127, 0, 0, 2], 0).into(), [b])
            .start()
            .await
            .map_err(failed)?;
        network.write_files(dir).map_err(failed)?;
        Ok(Self::Simulated { network: Box::new(network), dir: dir.to_owned() })
    }

    /// Uses KMEs that run elsewhere, as the files of host A and of host B describe.
    pub(crate) fn external(host_a: &Path, host_b: &Path) -> Result<Self, DemoError> {
        let read = |path| env_file::read(path).map_err(DemoError::KmeEnv);
        let kmes = Self::External([read(host_a)?, read(host_b)?]);
        if kmes.sae(Role::A) == kmes.sae(Role::B) {
            let why = format!("{} is both hosts' AXON_SAE_ID", kmes.sae(Role::A));
            return Err(DemoError::KmeEnv(why));
        }
        Ok(kmes)
    }

    /// Returns the ID of an SAE. External KMEs know only two SAEs. The wrong peers then use the
    /// name of host A after host A has ended.
    pub(crate) fn sae(&self, role: Role) -> &str {
        match self {
            Self::Simulated { .. } => SAES[role as usize],
            Self::External(_) => {
                let id = self.variables(role).iter().find(|(name, _)| name == "AXON_SAE_ID");
                id.map_or("", |(_, id)| id)
            }
        }
    }

    /// Returns the variables that tell a host its KME and its identity.
    pub(crate) fn identity(&self, role: Role) -> Vec<(String, String)> {
        match self {
            Self::Simulated { network, dir } => {
                let sae = network.sae(self.sae(role)).map(|sae| sae.env(dir)).unwrap_or_default();
                sae.into_iter().map(|(name, value)| (name.to_owned(), value)).collect()
            }
            Self::External(_) => self.variables(role).to_vec(),
        }
    }

    /// Returns the SAEs that host B accepts as peers.
    pub(crate) fn peers_of_b(&self) -> String {
        match self {
            Self::Simulated { .. } => [self.sae(Role::A), self.sae(Role::Visitor)].join(";"),
            Self::External(_) => self.sae(Role::A).to_owned(),
        }
    }

    /// Returns whether the wrong peers have their own SAE.
    pub(crate) fn has_visitor(&self) -> bool {
        matches!(self, Self::Simulated { .. })
    }

    /// Returns the number of keys delivered since the start. External KMEs do not report it.
    pub(crate) fn handed_out(&self) -> Option<KeysHandedOut> {
        let Self::Simulated { network, .. } = self else { return None };
        let counters = network.kmes().iter().map(sim::Kme::counters);
        Some(counters.fold(KeysHandedOut::default(), |sum, counters| KeysHandedOut {
            to_masters: sum.to_masters + counters.keys_to_masters,
            to_slaves: sum.to_slaves + counters.keys_to_slaves,
        }))
    }

    fn variables(&self, role: Role) -> &[(String, String)] {
        match self {
            Self::External([_, b]) if role == Role::B => b,
            Self::External([a, _]) => a,
            Self::Simulated { .. } => &[],
        }
    }
}
