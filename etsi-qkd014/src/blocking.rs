//! The client without async: the same requests, errors and checks, on its own runtime.
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
/// It must not be used inside an async runtime, nor on a thread of its `spawn_blocking`: such a
/// call returns [`Error::Request`]. Use [`Client`](crate::Client) there.
#[derive(Clone, Debug)]
pub struct Client {
    client: crate::Client,
    runtime: Arc<Option<Runtime>>,
}

impl Client {
    /// Creates the client from its settings, and starts a thread that drives its connections.
    ///
    /// # Errors
    /// [`Error::Config`] as in [`ClientBuilder::build`], or if the thread cannot be started.
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
    /// The errors of [`Client::status`](crate::Client::status).
    pub fn status(&self, slave_sae: &str) -> Result<Status, Error> {
        self.block_on(self.client.status(slave_sae))
    }

    /// Requests fresh keys; `request` sets the details. See [`EncKeys::send`].
    ///
    /// # Errors
    /// The errors of [`EncKeys::send`].
    pub fn enc_keys(
        &self,
        slave_sae: &str,
        request: impl FnOnce(EncKeys<'_>) -> EncKeys<'_>,
    ) -> Result<KeyContainer, Error> {
        self.block_on(request(self.client.enc_keys(slave_sae)).send())
    }

    /// Requests keys by their IDs, which `request` sets. See [`DecKeys::send`].
    ///
    /// # Errors
    /// The errors of [`DecKeys::send`].
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

/// Shuts the runtime down without waiting for it.
impl Drop for Client {
    fn drop(&mut self) {
        // Dropping a runtime waits for it, and panics inside another runtime.
        if let Some(runtime) = Arc::get_mut(&mut self.runtime).and_then(Option::take) {
            runtime.shutdown_background();
        }
    }
}
