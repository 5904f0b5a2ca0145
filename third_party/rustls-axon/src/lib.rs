//! rustls-axon
