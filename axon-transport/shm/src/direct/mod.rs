//! Publishers and subscribers over a connected socket, without a daemon.

pub(crate) mod connect;
pub(crate) mod context;
pub(crate) mod publisher;
pub(crate) mod segment_channels;
pub(crate) mod subscriber;
