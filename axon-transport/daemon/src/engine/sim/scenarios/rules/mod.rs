//! Tests rules of either host: denials and limits.

mod access;
mod attacks;
mod limits;
