//! KMEs in the same process that share key material like a QKD link. For tests and demonstrations.
//!
//! A [`Network`] contains one or more KMEs and a throw-away CA. Each KME serves ETSI GS QKD 014
//! over real mutual TLS to the SAEs attached to it. It identifies an SAE by the common name of its
//! certificate. Keys come from the system's random number generator and wait in a store that fills
//! at a set rate. Each key is given once to the master, and once to each slave that the master
//! named.
//!
//! ```
//! # #[tokio::main(flavor = "current_thread")]
//! # async fn main() -> Result<(), Box<dyn std::error::Error>> {
//! use etsi_qkd014::sim::Network;
//!
//! let network = Network::builder()
//!     .kme("kme-a", "127.0.0.1:0".parse()?, ["sae-a"])
//!     .kme("kme-b", "127.0.0.1:0".parse()?, ["sae-b"])
//!     .start()
//!     .await?;
//! let master = network.client_builder("sae-a").build()?;
//! let slave = network.client_builder("sae-b").build()?;
//!
//! let drawn = master.enc_keys("sae-b").size(256).send().await?.into_single();
//! let same = slave.dec_keys("sae-a").key_id(drawn.key_id()).send().await?.into_single();
//! assert!(drawn == same);
//! # Ok(())
//! # }
//! ```
//!
//! It is not a KME for production: its keys do not come from a quantum channel.

mod api;
mod chunks;
mod control;
mod fault;
mod handshake;
mod http;
mod network;
mod pki;
mod plan;
mod server;
mod store;

pub use control::Control;
pub use fault::Fault;
pub use network::{Counters, Kme, Network, NetworkBuilder};
pub use pki::{Layout, Pki, Sae, Site};
pub use plan::{FaultPlan, Method};
pub use store::FillRate;

/// The reason why a simulator could not be set up.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The KMEs and SAEs are inconsistent.
    #[error("{0}")]
    Layout(String),
    /// A certificate could not be created or read.
    #[error("certificates: {0}")]
    Certificates(String),
    /// A file or socket could not be used.
    #[error("{what}: {source}")]
    Io {
        /// The path or address.
        what: String,
        /// The system's reason.
        source: std::io::Error,
    },
}

impl Error {
    fn io(what: impl ToString) -> impl FnOnce(std::io::Error) -> Self {
        let what = what.to_string();
        move |source| Self::Io { what, source }
    }
}
