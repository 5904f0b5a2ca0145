//! The form of a sample in a data stream, and checks of its number.

pub(super) mod dropped;
pub(crate) mod frames;
pub(super) mod numbers;
pub(crate) mod protection;
pub(crate) mod short_header;
pub(crate) mod stream_header;
