//! The two sides of endpoints, which their handles share with the session's control thread. A publisher has a writing
//! side, a subscription has a reading side, and clients and servers have both.

mod callback;
mod calls;
mod events;
mod publisher;
mod rings;
mod source;
mod subscription;
mod wakers;

pub(in crate::session) use self::{
    callback::Callback,
    calls::ServerGone,
    events::Changes,
    publisher::PublisherInner,
    rings::{ClientLimit, RingsByClient, WriterRings},
    source::EventSource,
    subscription::{Accept, NumberKind, ServeRequest, SubscriptionInner},
};
pub use self::{
    callback::NewDataCallback,
    subscription::{Lifetime, MessageInfo, TakeLimit},
};
