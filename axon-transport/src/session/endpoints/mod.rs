//! The handles of endpoints, for the application and for code that represents other processes. Each handle keeps its
//! session open.

mod call;
mod client;
mod event;
mod factory;
mod loan;
mod messages;
mod publisher;
mod remote_writer;
mod server;
mod service;
mod subscription;
mod trusted;

pub(in crate::session) use self::factory::EndpointFactory;
pub(crate) use self::loan::OwnedLoan;
pub use self::{
    call::CallError,
    client::Client,
    event::Event,
    loan::Loan,
    messages::Messages,
    publisher::Publisher,
    remote_writer::{RemoteWriter, Written},
    server::Server,
    subscription::Subscription,
    trusted::TrustedSubscription,
};
