//! Publishers, subscriptions, clients and servers.

mod client;
mod endpoint;
mod loan;
mod publisher;
mod server;
mod subscription;

pub use self::{client::*, endpoint::*, loan::*, publisher::*, server::*, subscription::*};
