//! axon-transport
