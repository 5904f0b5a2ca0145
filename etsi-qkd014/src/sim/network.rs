//! Running KMEs.

use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tokio::net::TcpListener;
use tokio::task::JoinHandle;

use super::fault::Fault;
use super::handshake::{Acceptors, TlsWitness};
use super::pki::{Layout, Pair, Pki, Sae, Site, Validity};
use super::plan::{FaultPlan, Faults};
use super::store::{FillRate, Store, Witness};
use super::{Error, server};
use crate::{Client, ClientBuilder};

/// The limits that the KMEs report in their status answers.
#[derive(Clone, Debug)]
pub(super) struct Limits {
    pub(super) key_size: u32,
    pub(super) min_key_size: u32,
    pub(super) max_key_size: u32,
    pub(super) max_stored: u64,
    pub(super) max_keys_per_request: u64,
    pub(super) max_sae_ids: u64,
}

/// Builds a [`Network`].
#[derive(Debug)]
#[must_use]
pub struct NetworkBuilder {
    layout: Layout,
    pki: Option<Pki>,
    limits: Limits,
    rate: FillRate,
    initially: Option<u64>,
    tls12_only: bool,
    strict: bool,
    witness: Witness,
    tls_witness: TlsWitness,
}

impl NetworkBuilder {
    /// Adds a KME that listens on `bind` (port 0 is any free one) and serves `saes`.
    pub fn kme<I>(mut self, id: impl Into<String>, bind: SocketAddr, saes: I) -> Self
    where
        I: IntoIterator<Item: Into<String>>,
    {
        let saes = saes.into_iter().map(Into::into).collect();
        self.layout.sites.push(Site { kme: id.into(), bind, saes });
        self
    }

    /// Uses the KMEs of a layout, with the certificates created for it.
    pub fn layout(mut self, layout: Layout, pki: Pki) -> Self {
        self.layout = layout;
        self.pki = Some(pki);
        self
    }

    /// Sets the default size of a key in bits, a multiple of 8 from 8 to 4096. Default 256.
    pub fn key_size(mut self, bits: u32) -> Self {
        self.limits.key_size = bits;
        self
    }

    /// Sets how fast each link between two KMEs makes keys. Default unlimited.
    pub fn fill_rate(mut self, rate: FillRate) -> Self {
        self.rate = rate;
        self
    }

    /// Sets the most keys that each link stores, up to 2^53. Default 10,000.
    pub fn max_stored(mut self, keys: u64) -> Self {
        self.limits.max_stored = keys;
        self
    }

    /// Sets the number of keys that each link stores at the start. Default the maximum.
    pub fn initially_stored(mut self, keys: u64) -> Self {
        self.initially = Some(keys);
        self
    }

    /// Sets the most keys in one request, 1 to 1024. Default 128.
    pub fn max_keys_per_request(mut self, keys: u64) -> Self {
        self.limits.max_keys_per_request = keys;
        self
    }

    /// Offers only TLS 1.2, like old KMEs.
    pub fn tls12_only(mut self) -> Self {
        self.tls12_only = true;
        self
    }

    /// Refuses what the specification does not list: other members of a request, `null` for an absent one, other
    /// parameters of a query, a POST of `enc_keys` with an empty body, a chunked body. Clients in the field send these,
    /// and ETSI GS QKD 014 does not forbid them, so they are accepted by default.
    pub fn strict(mut self) -> Self {
        self.strict = true;
        self
    }

    /// Calls `tell` with the key_ID and the secret of each key that a master draws, for tests that search memory for
    /// keys.
    pub fn witness(mut self, tell: impl Fn(&str, &[u8]) + Send + Sync + 'static) -> Self {
        self.witness = Witness::new(tell);
        self
    }

    /// Calls `tell` with the label (as in `SSLKEYLOGFILE`) and the value of each secret of TLS connections, for tests
    /// that search memory for them.
    pub fn tls_witness(mut self, tell: impl Fn(&str, &[u8]) + Send + Sync + 'static) -> Self {
        self.tls_witness = TlsWitness::new(tell);
        self
    }

    /// Creates the certificates, binds the sockets and starts to serve. Needs a tokio runtime, on which the KMEs run
    /// until the network is dropped.
    ///
    /// # Errors
    /// [`Error`] names the unusable ID, setting or address.
    pub async fn start(self) -> Result<Network, Error> {
        let Self { layout, pki, limits, rate, initially, tls12_only, strict, witness, tls_witness } =
            self;
        layout.check()?;
        let sizes = limits.min_key_size..=limits.max_key_size;
        if !sizes.contains(&limits.key_size) || !limits.key_size.is_multiple_of(8) {
            return Err(Error::Layout(format!(
                "key_size {} is not a multiple of 8 from {} to {}",
                limits.key_size, limits.min_key_size, limits.max_key_size
            )));
        }
        // A full answer stays below the 1 MiB that a client accepts by default.
        if !(1..=1024).contains(&limits.max_keys_per_request) {
            return Err(Error::Layout(format!(
                "max_keys_per_request {} is not from 1 to 1024",
                limits.max_keys_per_request
            )));
        }
        // Above it a status could not be exact, because stocks are counted in 64-bit floats.
        if limits.max_stored > 1 << 53 {
            return Err(Error::Layout(format!(
                "max_stored {} is more than 2^53",
                limits.max_stored
            )));
        }
        if let FillRate::PerSecond(keys) = rate
            && !(keys.is_finite() && keys >= 0.0)
        {
            return Err(Error::Layout(format!("fill_rate {keys} is not a number from 0")));
        }
        let pki = pki.map_or_else(|| Pki::create(&layout), Ok)?;
        let initially = initially.unwrap_or(limits.max_stored);
        let shared = Arc::new(NetworkShared {
            store: Mutex::new(Store::new(rate, limits.max_stored, initially).with_witness(witness)),
            layout: layout.clone(),
            limits,
            strict,
        });
        let mut kmes = Vec::new();
        for (index, site) in layout.sites.iter().enumerate() {
            let listener = TcpListener::bind(site.bind).await.map_err(Error::io(site.bind))?;
            let addr = listener.local_addr().map_err(Error::io(site.bind))?;
            let tls = Acceptors::new(&pki, &site.kme, tls12_only, &tls_witness)?;
            let state = Arc::new(KmeState {
                id: site.kme.clone(),
                index,
                saes: site.saes.iter().cloned().collect(),
                counters: Mutex::default(),
                faults: Mutex::default(),
                last_key_id: Mutex::default(),
            });
            let serving = server::serve(listener, tls, Arc::clone(&shared), Arc::clone(&state));
            let task = tokio::spawn(serving);
            kmes.push(Kme { url: format!("https://{addr}"), addr, state, task });
        }
        let mut saes = Vec::new();
        for (site, kme) in layout.sites.iter().zip(&kmes) {
            for id in &site.saes {
                let Pair { cert, key } = pki.known(id, Validity::Now)?;
                saes.push(sae(id, kme, &pki, Pair { cert: cert.clone(), key: key.clone() }));
            }
        }
        Ok(Network { kmes, saes, pki, shared })
    }
}

fn sae(id: &str, kme: &Kme, pki: &Pki, pair: Pair) -> Sae {
    Sae {
        id: id.to_owned(),
        kme_id: kme.id().to_owned(),
        kme_url: kme.url.clone(),
        ca: pki.ca_pem().to_owned(),
        pair,
    }
}

/// KMEs that run until this value is dropped.
pub struct Network {
    kmes: Vec<Kme>,
    saes: Vec<Sae>,
    pki: Pki,
    shared: Arc<NetworkShared>,
}

impl Network {
    /// Returns a builder for a network.
    pub fn builder() -> NetworkBuilder {
        NetworkBuilder {
            layout: Layout::default(),
            pki: None,
            limits: Limits {
                key_size: 256,
                min_key_size: 8,
                max_key_size: 4096,
                max_stored: 10_000,
                max_keys_per_request: 128,
                max_sae_ids: 8,
            },
            rate: FillRate::Unlimited,
            initially: None,
            tls12_only: false,
            strict: false,
            witness: Witness::default(),
            tls_witness: TlsWitness::default(),
        }
    }

    /// Returns the KMEs in the order in which they were added.
    #[must_use]
    pub fn kmes(&self) -> &[Kme] {
        &self.kmes
    }

    /// Returns a KME by its ID.
    #[must_use]
    pub fn kme(&self, id: &str) -> Option<&Kme> {
        self.kmes.iter().find(|kme| kme.id() == id)
    }

    /// Returns the SAEs of all KMEs.
    #[must_use]
    pub fn saes(&self) -> &[Sae] {
        &self.saes
    }

    /// Returns an SAE by its ID.
    #[must_use]
    pub fn sae(&self, id: &str) -> Option<&Sae> {
        self.saes.iter().find(|sae| sae.id == id)
    }

    /// Records the state of the key stores, like a backup. All keys drawn from here on are kept for
    /// [`set_back`](Self::set_back).
    pub fn note_state(&self) {
        self.shared.store().note();
    }

    /// Restores the recorded state of the key stores: the KMEs give the keys that were drawn since then once more, in
    /// the same order, and can give them to the slaves once more.
    pub fn set_back(&self) {
        self.shared.store().set_back();
    }

    /// Returns a builder for a client that acts as the SAE `sae`.
    ///
    /// # Panics
    /// The network has no such SAE.
    pub fn client_builder(&self, sae: &str) -> ClientBuilder {
        client_builder(self.sae(sae).unwrap_or_else(|| panic!("no SAE {sae:?} in this network")))
    }

    /// Creates an SAE with a certificate of the network's CA that is attached to none of its KMEs, for calls to the KME
    /// `kme`.
    ///
    /// # Errors
    /// [`Error`] if there is no such KME, or if the CA's key no longer exists.
    pub fn outsider(&self, id: &str, kme: &str) -> Result<Sae, Error> {
        let kme = self
            .kme(kme)
            .ok_or_else(|| Error::Layout(format!("no KME {kme:?} in this network")))?;
        let pair = self.pki.issue(id, None, Validity::Now)?;
        Ok(sae(id, kme, &self.pki, pair))
    }

    /// Writes the certificates and keys into `dir`; see [`Pki::write`].
    ///
    /// # Errors
    /// [`Error::Io`] names the file that cannot be written.
    pub fn write_files(&self, dir: &Path) -> Result<(), Error> {
        self.pki.write(dir)
    }
}

/// Returns a builder for a client that acts as `sae`.
pub(super) fn client_builder(sae: &Sae) -> ClientBuilder {
    Client::builder()
        .kme_url(sae.kme_url())
        .kme_id(sae.kme_id())
        .ca(sae.ca_pem())
        .sae_cert(sae.cert_pem())
        .sae_key(sae.key_pem().as_bytes().to_vec())
}

impl Sae {
    /// Returns a builder for a client that acts as this SAE.
    pub fn client_builder(&self) -> ClientBuilder {
        client_builder(self)
    }
}

/// A running KME.
pub struct Kme {
    url: String,
    addr: SocketAddr,
    state: Arc<KmeState>,
    task: JoinHandle<()>,
}

impl Kme {
    /// Returns its ID.
    #[must_use]
    pub fn id(&self) -> &str {
        &self.state.id
    }

    /// Returns its URL, `https://address:port`.
    #[must_use]
    pub fn url(&self) -> &str {
        &self.url
    }

    /// Returns the address on which it listens.
    #[must_use]
    pub fn addr(&self) -> SocketAddr {
        self.addr
    }

    /// Returns its counters.
    #[must_use]
    pub fn counters(&self) -> Counters {
        *lock(&self.state.counters)
    }

    /// Injects a fault into the next `times` requests (or connections), after the faults injected before.
    pub fn inject(&self, fault: Fault, times: u32) {
        self.plan(FaultPlan::new(fault).times(times));
    }

    /// Adds a fault that happens according to the plan, after the existing ones.
    pub fn plan(&self, plan: FaultPlan) {
        self.state.faults().push(plan);
    }

    /// Returns the faults that may still happen.
    #[must_use]
    pub fn plans(&self) -> Vec<FaultPlan> {
        self.state.faults().iter().cloned().collect()
    }

    /// Removes all faults.
    pub fn clear_faults(&self) {
        self.state.faults().clear();
    }

    /// Stops it: closes its socket and connections.
    pub fn stop(&self) {
        self.task.abort();
    }
}

impl Drop for Kme {
    fn drop(&mut self) {
        self.stop();
    }
}

/// The counters of one KME since its start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct Counters {
    /// Number of calls of `status`.
    pub status_calls: u64,
    /// Number of calls of `enc_keys`.
    pub enc_keys_calls: u64,
    /// Number of calls of `dec_keys`.
    pub dec_keys_calls: u64,
    /// Number of keys given by `enc_keys`.
    pub keys_to_masters: u64,
    /// Number of keys given by `dec_keys`.
    pub keys_to_slaves: u64,
    /// Number of requests answered with a status other than 200.
    pub refused: u64,
}

/// The state that all KMEs of a network share.
pub(super) struct NetworkShared {
    store: Mutex<Store>,
    layout: Layout,
    pub(super) limits: Limits,
    pub(super) strict: bool,
}

impl NetworkShared {
    pub(super) fn store(&self) -> MutexGuard<'_, Store> {
        lock(&self.store)
    }

    /// Returns the index of the KME to which an SAE is attached.
    pub(super) fn site_of(&self, sae: &str) -> Option<usize> {
        self.layout.sites.iter().position(|site| site.saes.iter().any(|id| id == sae))
    }

    pub(super) fn kme_id(&self, index: usize) -> &str {
        &self.layout.sites[index].kme
    }
}

/// The state of one KME.
pub(super) struct KmeState {
    pub(super) id: String,
    pub(super) index: usize,
    pub(super) saes: BTreeSet<String>,
    counters: Mutex<Counters>,
    faults: Mutex<Faults>,
    /// The key_ID of the last key that it gave to a master.
    last_key_id: Mutex<Option<String>>,
}

impl KmeState {
    pub(super) fn last_key_id(&self, change: impl FnOnce(&mut Option<String>)) {
        change(&mut lock(&self.last_key_id));
    }

    pub(super) fn count(&self, change: impl FnOnce(&mut Counters)) {
        change(&mut lock(&self.counters));
    }

    pub(super) fn faults(&self) -> MutexGuard<'_, Faults> {
        lock(&self.faults)
    }
}

/// Locks a mutex. A panic leaves no state half changed, so poisoning is ignored.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
