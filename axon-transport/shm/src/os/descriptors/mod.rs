//! Descriptors that processes pass to each other, and the way in which received descriptors are closed.
//!
//! The sender of a descriptor can make its close block for an arbitrary time: a TCP socket that lingers over unsent
//! data, a file of a user's own file system, or a unix socket with either of them in its queue. Therefore only
//! threads that have no other work close such descriptors.

mod capacity;
mod packet;
mod passed;
#[cfg(test)]
pub(crate) mod tests;

pub(crate) use self::packet::receive_whole;
pub use self::{
    capacity::{
        FEW_DESCRIPTORS, close_queue_is_full, is_clogged, is_scarce, is_tight, limit, open, share,
    },
    packet::{SocketPacket, carries_descriptors, look, receive, receive_few},
    passed::PassedFd,
};
