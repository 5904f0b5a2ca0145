//! Tests what a derivation leaves in the memory of its process: its stacks, its heap and freed memory. The test
//! searches all of a child's memory for KME keys and everything derived from them, while the keys wait for use, and
//! when they are spent.
//!
//! The child is a process of its own, since the test knows the keys: the child reads each from its standard input
//! straight into the block that will hold it.

#![cfg(target_os = "linux")]

mod child;
mod envelope;
