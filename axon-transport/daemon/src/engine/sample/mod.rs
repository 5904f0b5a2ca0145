//! How a sample stands in a data stream, and what its number tells.

pub(super) mod dropped;
pub(crate) mod frames;
pub(super) mod numbers;
pub(crate) mod protection;
pub(crate) mod short_header;
pub(crate) mod stream_header;
