//! The ways in which two hosts may be set up.

use std::{
    fs,
    path::Path,
    sync::{Arc, Mutex},
};

use axon_tls::identity::SigningKey;
use etsi_qkd014::{secrecy::ExposeSecret, sim};

use super::pair::write_key;

/// Variables and their values.
pub(crate) type Settings = Vec<(&'static str, String)>;

/// Keys by their key_ID, as they were drawn; or secrets of TLS by their labels.
pub(crate) type Drawn = Vec<(String, Vec<u8>)>;

pub(crate) const SAE: [&str; 2] = ["sae-a", "sae-b"];

/// The KMEs of the two hosts, and the keys that they gave the SAEs.
pub(crate) struct Kmes {
    network: sim::Network,
    dir: tempfile::TempDir,
    runtime: tokio::runtime::Runtime,
    drawn: Arc<Mutex<Drawn>>,
    tls: Arc<Mutex<Drawn>>,
}

impl Kmes {
    pub(crate) fn start() -> Self {
        let runtime =
            tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build();
        let runtime = runtime.unwrap();
        let network = sim::Network::builder()
            .strict()
            .kme("kme-a", ([127, 0, 0, 1], 0).into(), [SAE[0]])
            .kme("kme-b", ([127, 0, 0, 2], 0).into(), [SAE[1]]);
        let [drawn, tls] = [(); 2].map(|()| Arc::new(Mutex::new(Drawn::new())));
        let into = |all: &Arc<Mutex<Drawn>>| {
            let all = Arc::clone(all);
            move |name: &str, secret: &[u8]| {
                all.lock().unwrap().push((name.to_owned(), secret.to_vec()));
            }
        };
        let network = network.witness(into(&drawn)).tls_witness(into(&tls));
        let network = runtime.block_on(network.start()).unwrap();
        let dir = tempfile::tempdir().unwrap();
        network.write_files(dir.path()).unwrap();
        Self { network, dir, runtime, drawn, tls }
    }

    /// Returns settings of host 0 or 1 in qkd.
    pub(crate) fn settings(&self, host: usize, more: &[(&'static str, &str)]) -> Settings {
        let mut settings = self.network.sae(SAE[host]).unwrap().env(self.dir.path());
        settings.push(("AXON_SECURITY_MODE", "qkd".into()));
        settings.push(("AXON_QKD_PEERS", SAE[1 - host].into()));
        set(&mut settings, more);
        settings
    }

    /// Returns each key that was drawn so far, and its key_ID.
    pub(crate) fn drawn(&self) -> Drawn {
        self.drawn.lock().unwrap().clone()
    }

    /// Draws a key as the SAE of host 0 or 1, for the other one: its key_ID, and the key.
    pub(crate) fn draw(&self, host: usize) -> (String, Vec<u8>) {
        let client = self.network.client_builder(SAE[host]).build().unwrap();
        let call = client.enc_keys(SAE[1 - host]).number(1).size(256).send();
        let key = self.runtime.block_on(call).unwrap().keys.remove(0);
        (key.key_id().to_owned(), key.expose_secret().to_vec())
    }

    /// Returns the secrets of all TLS connections of the KMEs so far, with their labels.
    pub(crate) fn tls_secrets(&self) -> Drawn {
        self.tls.lock().unwrap().clone()
    }

    /// Makes the KME of host 0 or 1 fail as `plan` says.
    pub(crate) fn plan(&self, host: usize, plan: sim::FaultPlan) {
        self.network.kmes()[host].plan(plan);
    }

    /// Ends the failures of all KMEs.
    pub(crate) fn clear_faults(&self) {
        self.network.kmes().iter().for_each(sim::Kme::clear_faults);
    }

    /// Stores the state of the KMEs, as a backup does.
    pub(crate) fn note_state(&self) {
        self.network.note_state();
    }

    /// Restores the stored state of the KMEs: they give the keys since then again.
    pub(crate) fn set_back(&self) {
        self.network.set_back();
    }

    /// Returns the URL of the KME of host 0 or 1.
    pub(crate) fn url(&self, host: usize) -> String {
        self.network.kmes()[host].url().to_owned()
    }

    /// Calls that the KMEs had.
    pub(crate) fn calls(&self) -> u64 {
        let calls = |c: sim::Counters| c.status_calls + c.enc_keys_calls + c.dec_keys_calls;
        self.network.kmes().iter().map(|kme| calls(kme.counters())).sum()
    }

    /// Calls of this method that the KME of host 0 or 1 had.
    pub(crate) fn calls_of(&self, host: usize, method: sim::Method) -> u64 {
        let counters = self.network.kmes()[host].counters();
        match method {
            sim::Method::Status => counters.status_calls,
            sim::Method::EncKeys => counters.enc_keys_calls,
            sim::Method::DecKeys => counters.dec_keys_calls,
        }
    }

    /// Returns the number of keys that SAEs got as new ones, and by key_ID.
    pub(crate) fn keys(&self) -> (u64, u64) {
        let counters = self.network.kmes().iter().map(|kme| kme.counters());
        counters.fold((0, 0), |(masters, slaves), c| {
            (masters + c.keys_to_masters, slaves + c.keys_to_slaves)
        })
    }
}

fn set(settings: &mut Settings, more: &[(&'static str, &str)]) {
    for (name, value) in more {
        settings.retain(|(n, _)| n != name);
        settings.push((name, (*value).into()));
    }
}

/// Returns settings of a host in classic.
pub(crate) fn classic(more: &[(&'static str, &str)]) -> Settings {
    let mut settings = vec![("AXON_SECURITY_MODE", "classic".into())];
    set(&mut settings, more);
    settings
}

/// Returns the settings of two hosts with keys of their own. Each trusts the hosts in its row: `trusts[0][1]` says
/// whether host 0 trusts host 1.
pub(crate) fn pinned(dir: &Path, trusts: [[bool; 2]; 2]) -> [Settings; 2] {
    let pems = [0, 1].map(|_| SigningKey::generate_pem().unwrap());
    let pins: Vec<_> =
        pems.iter().map(|p| SigningKey::from_pem(p).unwrap().spki_digest()).collect();
    // A trust file names somebody, even where it is not the other host.
    let stranger = SigningKey::generate().unwrap().spki_digest();
    [0, 1].map(|host| {
        let key = dir.join(format!("host-{host}.key"));
        write_key(&key, &pems[host]);
        let mut lines = format!("stranger {stranger}\n");
        for (peer, pin) in pins.iter().enumerate().filter(|(peer, _)| trusts[host][*peer]) {
            lines += &format!("host-{peer} {pin}\n");
        }
        let trust = dir.join(format!("host-{host}.trust"));
        fs::write(&trust, lines).unwrap();
        let path = |path: &Path| path.to_str().unwrap().to_owned();
        vec![
            ("AXON_SECURITY_MODE", "classic".to_owned()),
            ("AXON_CLASSIC_AUTH", "pinned".to_owned()),
            ("AXON_CLASSIC_KEY", path(&key)),
            ("AXON_CLASSIC_TRUST", path(&trust)),
        ]
    })
}
