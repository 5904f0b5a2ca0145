//! What a derivation leaves behind in the memory of its process: its stacks, its heap and what was
//! freed. The test searches all of a child's memory for KME keys and all that is derived of them,
//! while the keys wait to be used, and when they are spent.
//!
//! A process of its own, since the test knows the keys: the child reads each from its standard input
//! straight into the block that will hold it.

#![cfg(target_os = "linux")]

mod child;
mod envelope;
