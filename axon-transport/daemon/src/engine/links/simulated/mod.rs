//! Access for the simulator: the memory that links take, and lies for a daemon that breaks the protocol.

mod held;
mod lies;

pub(in crate::engine) use self::lies::LieAbout;
