//! The client without async: the same requests, errors and checks, on a runtime of its own.
//!
//! ```no_run
//! # fn example() -> Result<(), etsi_qkd014::Error> {
//! use etsi_qkd014::{Client, blocking};
//!
//! let settings = Client::builder().kme_url("https://192.0.2.1:8443");
//! let client = blocking::Client::new(settings)?;
//! let keys = client.enc_keys("sae-b", |request| request.number(4).size(256))?;
//! # let _ = keys; Ok(())
//! # }
//! ```

use std::sync::Arc;

use tokio::runtime::{Builder, Handle, Runtime};

use crate::{ClientBuilder, DecKeys, EncKeys, Error, KeyContainer, Status};

/// A blocking client of one KME. Cheap to clone; calls may be made from several threads at once.
///
/// Not for use inside an async runtime, nor on a thread of its `spawn_blocking`: a call there is
/// refused with [`Error::Request`]. Use [`Client`](crate::Client) there.
#[derive(Clone, Debug)]
pub struct Client {
    client: crate::Client,
    runtime: Arc<Option<Runtime>>,
}

impl Client {
    /// Makes the client from its settings, and a thread that drives its connections.
    ///
    /// # Errors
    /// [`Error::Config`], as [`ClientBuilder::build`], or where the thread cannot be started.
    pub fn new(settings: ClientBuilder) -> Result<Self, Error> {
        let client = settings.build()?;
        let runtime = Builder::new_multi_thread()
            .worker_threads(1)
            .thread_name("etsi-qkd014")
            .enable_all()
            .build()
            .map_err(|e| Error::Config { setting: "blocking", reason: e.to_string() })?;
        Ok(Self { client, runtime: Arc::new(Some(runtime)) })
    }

    /// See [`Client::status`](crate::Client::status).
    ///
    /// # Errors
    /// As there.
    pub fn status(&self, slave_sae: &str) -> Result<Status, Error> {
        self.block_on(self.client.status(slave_sae))
    }

    /// Asks for fresh keys; `request` sets what is asked for. See [`EncKeys::send`].
    ///
    /// # Errors
    /// As there.
    pub fn enc_keys(
        &self,
        slave_sae: &str,
        request: impl FnOnce(EncKeys<'_>) -> EncKeys<'_>,
    ) -> Result<KeyContainer, Error> {
        self.block_on(request(self.client.enc_keys(slave_sae)).send())
    }

    /// Asks for keys by their IDs; `request` names them. See [`DecKeys::send`].
    ///
    /// # Errors
    /// As there.
    pub fn dec_keys(
        &self,
        master_sae: &str,
        request: impl FnOnce(DecKeys<'_>) -> DecKeys<'_>,
    ) -> Result<KeyContainer, Error> {
        self.block_on(request(self.client.dec_keys(master_sae)).send())
    }

    fn block_on<T>(&self, call: impl Future<Output = Result<T, Error>>) -> Result<T, Error> {
        if Handle::try_current().is_ok() {
            return Err(Error::Request {
                reason: "a blocking client was used inside an async runtime; use Client".into(),
            });
        }
        self.runtime.as_ref().as_ref().expect("taken only by drop").block_on(call)
    }
}

/// Owns nothing but the order of shutting down.
impl Drop for Client {
    fn drop(&mut self) {
        // A plain drop of a runtime waits for it, and panics inside another runtime.
        if let Some(runtime) = Arc::get_mut(&mut self.runtime).and_then(Option::take) {
            runtime.shutdown_background();
        }
    }
}
