//! Rules of one host or the other: what they deny and what they limit.

mod access;
mod attacks;
mod limits;
