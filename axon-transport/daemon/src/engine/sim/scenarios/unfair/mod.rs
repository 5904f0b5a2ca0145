//! Peers that keep the protocol, and take what is not theirs: a publisher's time, the id of another daemon.

mod bounds;
mod claims;
mod floods;
mod stalls;
