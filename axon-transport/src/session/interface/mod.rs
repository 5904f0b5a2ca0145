//! What an application asks of a session: one file for each chapter of the interface.

mod announce;
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
