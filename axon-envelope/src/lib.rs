//! axon-envelope
