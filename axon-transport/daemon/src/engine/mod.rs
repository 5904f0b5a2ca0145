//! The gateway as one state machine without I/O.

#[cfg(test)]
mod sim;
