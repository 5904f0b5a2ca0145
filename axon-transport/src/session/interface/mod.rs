//! The interface of a session for applications: one file for each chapter.

mod create;
mod hidden;
mod node;
mod open;
mod status;
mod wait_set;

pub use self::{
    node::Node,
    wait_set::{Ready, Waitable},
};
