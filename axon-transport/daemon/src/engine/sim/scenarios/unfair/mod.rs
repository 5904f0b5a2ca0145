//! Peers that keep the protocol, and take what is not theirs: a publisher's time.

mod stalls;
