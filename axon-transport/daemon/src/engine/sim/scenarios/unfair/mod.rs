//! Tests peers that keep to the protocol but take more than their share: a publisher's time, or the id of another
//! daemon.

mod bounds;
mod claims;
mod floods;
mod stalls;
