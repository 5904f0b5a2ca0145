//! KMEs in process that share key material as a QKD link does. For tests and demonstrations.
//!
//! A [`Network`] is one or more KMEs with a throw-away CA, each serving ETSI GS QKD 014 over real
//! mutual TLS to the SAEs attached to it. Which SAE calls is read from its certificate's common
//! name. Keys come from the system's random number generator, wait in a store that fills at a set
//! rate, are given once to the master, and once to each slave that the master named.
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
//! It is no KME for production: its keys have never seen a quantum channel.

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

/// Why a simulator could not be set up.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The KMEs and SAEs do not fit together.
    #[error("{0}")]
    Layout(String),
    /// A certificate could not be made or read.
    #[error("certificates: {0}")]
    Certificates(String),
    /// A file or socket.
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
