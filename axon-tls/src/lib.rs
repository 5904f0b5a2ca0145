//! axon-tls
