//! System calls that need `unsafe` or care: descriptors of other processes, forks, signals, clocks, the heap, and a
//! lock with priority inheritance.

pub(crate) mod atfork;
pub(crate) mod clock;
pub(crate) mod closer;
pub(crate) mod descriptors;
pub(crate) mod fork;
pub(crate) mod heap;
pub(crate) mod inherited;
pub(crate) mod peer_process;
pub(crate) mod per_process;
pub(crate) mod pi_mutex;
pub(crate) mod signals;
