//! A session, from the view of its own process and of other sessions: segments, doorbell, lanes, and pinned samples.

pub(crate) mod activity;
pub(crate) mod attachment;
pub(crate) mod known_peers;
pub(crate) mod lane;
pub(crate) mod leader;
pub(crate) mod orphans;
pub(crate) mod peer;
pub(crate) mod pin_lanes;
pub(crate) mod reader_info;
pub(crate) mod segment;
pub(crate) mod segment_message;
