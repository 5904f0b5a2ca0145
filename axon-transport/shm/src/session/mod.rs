//! A session, as its own process has it and as others see it: segments, doorbell, lanes, and what readers hold
//! of it.

pub(crate) mod attachment;
pub(crate) mod lane;
pub(crate) mod leader;
pub(crate) mod orphans;
pub(crate) mod peer;
pub(crate) mod pin_lanes;
pub(crate) mod reader_info;
pub(crate) mod segment;
pub(crate) mod segment_message;
