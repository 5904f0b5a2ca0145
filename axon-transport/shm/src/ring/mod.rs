//! The layout of shared memory, word by word, and the order in which it is written and read. No system calls.

pub(crate) mod inspect;
pub(crate) mod journal;
pub(crate) mod layout;
pub(crate) mod pins;
pub(crate) mod protocol;
pub(crate) mod times;
pub(crate) mod types;
pub(crate) mod window;
