//! Why a gateway could not start.

use std::{io, path::PathBuf};

use axon_shm::ShmError;
use axon_transport::SessionError;

use crate::keys::KmeError;

/// Why a gateway could not start.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum GatewayError {
    /// A file that a setting names.
    #[error("{variable}: {path} cannot be used: {reason}")]
    File {
        /// The variable.
        variable: &'static str,
        /// The file.
        path: PathBuf,
        /// Why not.
        reason: String,
    },
    /// A setting that this mode needs.
    #[error("{0} is not set, and this mode needs it")]
    Missing(&'static str),
    /// TLS material.
    #[error("TLS: {0}")]
    Tls(#[from] axon_tls::Error),
    /// The KME client.
    #[error(transparent)]
    Kme(#[from] KmeError),
    /// The UDP port.
    #[error(transparent)]
    Endpoint(#[from] EndpointError),
    /// The gateway's own session with its daemon.
    #[error("the gateway's session: {0}")]
    Session(#[from] SessionError),
    /// The gateway's doorbell failed.
    #[error("the gateway's doorbell: {0}")]
    Memory(#[from] ShmError),
    /// The runtime.
    #[error("the gateway's runtime: {0}")]
    Runtime(#[from] io::Error),
    /// The control plane dropped the gateway's session.
    #[error("the control plane dropped the gateway's session; its log says why")]
    SessionLost,
    /// Called for the mode that is not in force: a defect of AXON.
    #[error("a configuration for the other security mode was asked for")]
    WrongMode,
}

/// Why no endpoint could be opened.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum EndpointError {
    /// Every port of the domain's range is taken or refused.
    #[error(
        "no QUIC port of {first}..={last} can be bound on {addresses}: {source}; another daemon \
         holds it, or AXON_BIND_ADDRS names an address that this host does not have"
    )]
    NoPort {
        /// First port tried.
        first: u16,
        /// Last port tried.
        last: u16,
        /// The addresses, for people.
        addresses: String,
        /// The error of the last attempt.
        source: io::Error,
    },
    /// quinn refused the socket.
    #[error("the QUIC endpoint could not be started: {0}")]
    Start(#[from] io::Error),
}
